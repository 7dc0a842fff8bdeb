"""The documents import from the front door and the rooms only, and folders keep to docs/conventions.md."""

from __future__ import annotations

import ast
import importlib
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.test_layout import MODULES, ROOT, folder_of
from tests.test_readme import DOCUMENTS

SOURCES = sorted({path.parent for path in MODULES.values()})
MOST_MODULES = 15
KINDS = ("Track", "Observation", "Estimator", "Smoother", "Online", "Filter", "Sightings", "Reading")
"""Endings of the names of classes that code must use by their interface."""
BLIND = ("estimation", "factors", "prediction", "learning", "diagnosis")
"""Rooms that must not ask which of those classes they hold."""
SENTENCES = [path for path in MODULES.values() if path.stat().st_size]
NOUN_AND_GLOSS = re.compile(r"[^\s:]+: |(?![A-Z][a-z]+s )(?:[^\s:]+ ){1,3}[^\s:]+: ")
"""A colon after at most four words, unless the first is a verb such as `Reads`."""
CLAUSE = re.compile(r"(?:What|Where|Whether|How|Which|Why|When|From|By|Of|Between|Beside|Do|Does) ")
TEST_FOLDERS = [folder for folder in (ROOT / "tests").iterdir() if f"ballfg.{folder.name}" in MODULES]


def imports(document: Path) -> Iterator[tuple[int, str, list[str]]]:
    """Line, module and names of every import of the package in the code blocks of a document."""
    text = document.read_text(encoding="utf-8")
    for block in re.finditer(r"^[ \t]*```\w*\n(.*?)^[ \t]*```", text, flags=re.DOTALL | re.MULTILINE):
        first = text.count("\n", 0, block.start(1)) + 1
        for found in re.finditer(r"^[ \t>]*from (ballfg[\w.]*) import (\([^)]*\)|.*)", block[1], flags=re.MULTILINE):
            names = re.sub(r"#.*|[()]", "", found[2]).split(",")
            line = first + block[1].count("\n", 0, found.start())
            yield line, found[1], [name.split(" as ")[0].strip() for name in names if name.strip()]
        for found in re.finditer(r"^[ \t>]*import (ballfg[\w.]*)", block[1], flags=re.MULTILINE):
            yield first + block[1].count("\n", 0, found.start()), found[1], []


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_documents_import_from_rooms(document: Path) -> None:
    wrong = [
        f"{document.relative_to(ROOT)}:{line}: {module}"
        for line, module, _ in imports(document)
        if module.count(".") > 1
    ]
    assert not wrong, "deeper than one room:\n" + "\n".join(wrong)


def test_files_and_functions_in_explanations_of_the_code_are_there() -> None:
    files, wrong = [*MODULES.values(), *(ROOT / "tests").rglob("*.py")], list[str]()
    for document in (ROOT / "docs" / "map.md", *(ROOT / "docs" / "derivations").glob("*.md")):
        for name, function in re.findall(r"`([\w/]+\.py)(?:: (\w+))?", document.read_text(encoding="utf-8")):
            texts = [path.read_text(encoding="utf-8") for path in files if path.as_posix().endswith(f"/{name}")]
            if not any(re.search(rf"\b(?:def|class) {function}" if function else "", text) for text in texts):
                wrong.append(f"{document.name}: {name} {function}")
    assert not wrong


@pytest.mark.parametrize("document", DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_names_in_documents_are_public(document: Path) -> None:
    for line, module, names in imports(document):
        room = importlib.import_module(module)
        missing = set(names) - set(getattr(room, "__all__", None) or vars(room))
        assert not missing, f"{document.relative_to(ROOT)}:{line}: {module} hands out no {', '.join(sorted(missing))}"


def test_modules_say_in_a_sentence_what_they_do() -> None:
    firsts = {path: (ast.get_docstring(ast.parse(path.read_text("utf-8"))) or "").split("\n")[0] for path in SENTENCES}
    wrong = [
        f"{path.relative_to(ROOT)}: {first}"
        for path, first in firsts.items()
        if not first.endswith(".") or NOUN_AND_GLOSS.match(first) or CLAUSE.match(first)
    ]
    assert not wrong, "no sentence, a `Noun: gloss`, or a clause without a verb:\n" + "\n".join(wrong)


def test_folders_are_small() -> None:
    counts = {folder: len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) for folder in SOURCES}
    wrong = [f"{folder.relative_to(ROOT)}: {count} modules" for folder, count in counts.items() if count > MOST_MODULES]
    assert not wrong, f"at most {MOST_MODULES}:\n" + "\n".join(wrong)


def asked(tree: ast.AST) -> Iterator[tuple[int, str]]:
    """Line and name of every class that `isinstance`, `issubclass` or a `case` asks for."""
    for node in ast.walk(tree):
        place: ast.AST | None = None
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and len(node.args) == 2:
            place = node.args[1] if node.func.id in ("isinstance", "issubclass") else None
        elif isinstance(node, ast.MatchClass):
            place = node.cls
        for part in ast.walk(place) if place is not None else ():
            if isinstance(part, ast.Name | ast.Attribute):
                yield part.lineno, part.id if isinstance(part, ast.Name) else part.attr


@pytest.mark.parametrize("room", BLIND)
def test_interfaces_are_used_and_not_classes(room: str) -> None:
    wrong = [
        f"{path.relative_to(ROOT)}:{line}: {name}"
        for module, path in MODULES.items()
        if f"{module}.".startswith(f"ballfg.{room}.")
        for line, name in asked(ast.parse(path.read_text(encoding="utf-8")))
        if name.endswith(KINDS)
    ]
    assert not wrong, "asks for a class instead of calling a method of its interface:\n" + "\n".join(wrong)


@pytest.mark.parametrize("tests", TEST_FOLDERS, ids=lambda path: path.name)
def test_tests_mirror_the_rooms(tests: Path) -> None:
    room = folder_of(f"ballfg.{tests.name}")
    for folder in (path for path in tests.rglob("*") if path.is_dir() and "__pycache__" not in path.parts):
        assert (room / folder.relative_to(tests)).is_dir(), f"{folder.relative_to(ROOT)} tests no folder of the room"
