"""The rooms: imports go one way between them, and what pyproject.toml installs is what is there."""

import ast
import tomllib
from collections.abc import Iterator
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
LEVELS = (
    ("interrupts",),
    ("state", "arrays", "checks", "registry", "machine", "collector"),
    ("progress", "deferred"),
    ("files",),
    ("parallel",),
    ("tracks",),
    ("vision",),
    ("dynamics",),
    ("pages",),
    ("simulation", "factors"),
    ("prediction",),
    ("estimation",),
    ("live", "learning"),
    ("diagnosis", "importing"),
    ("front",),
    ("benchmarks", "cli"),
)
"""Rooms from the first to the last; a module imports from its own room and from earlier levels only."""
COMMANDS = {"ballfg.learning.cli", "ballfg.learning.__main__", "ballfg.benchmarks.cli"}
"""Commands that live in their room: they may import from `ballfg.cli` what all commands share."""
SETUPTOOLS = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["tool"]["setuptools"]


def folder_of(package: str) -> Path:
    """Where a package's files lie."""
    for parent in sorted(SETUPTOOLS["package-dir"], key=len, reverse=True):
        if package == parent or package.startswith(parent + "."):
            rest = package.removeprefix(parent).strip(".").replace(".", "/")
            return ROOT / SETUPTOOLS["package-dir"][parent] / rest
    raise AssertionError(f"no folder is named for {package}")


MODULES = {
    f"{package}.{path.stem}".removesuffix(".__init__"): path
    for package in SETUPTOOLS["packages"]
    for path in sorted(folder_of(package).glob("*.py"))
}


def room_of(module: str) -> str:
    return module.split(".")[1]


def level_of(room: str) -> int:
    found = [i for i, rooms in enumerate(LEVELS) if room in rooms]
    assert found, f"room '{room}' has no place: add it to LEVELS here and to docs/map.md"
    return found[0]


def imported(module: str, path: Path) -> Iterator[tuple[int, str]]:
    """Line and name of every import of the package's own modules, those inside functions too."""
    package = module if path.name == "__init__.py" else module.rpartition(".")[0]
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        names: list[str] = []
        if isinstance(node, ast.Import):
            names = [alias.name for alias in node.names]
        elif isinstance(node, ast.ImportFrom) and node.level:
            base = ".".join(package.split(".")[: len(package.split(".")) - node.level + 1])
            names = [f"{base}.{node.module or node.names[0].name}"]
        elif isinstance(node, ast.ImportFrom) and node.module == "ballfg":
            names = [f"ballfg.{alias.name}" for alias in node.names]
        elif isinstance(node, ast.ImportFrom):
            names = [node.module or ""]
        yield from ((node.lineno, name) for name in names if name.startswith("ballfg."))


@pytest.mark.parametrize("module", [name for name in MODULES if name != "ballfg"])
def test_imports_go_one_way(module: str) -> None:
    room = room_of(module)
    for line, name in imported(module, MODULES[module]):
        other = room_of(name)
        allowed = other == room or level_of(other) < level_of(room) or (module in COMMANDS and other == "cli")
        assert allowed, f"{MODULES[module].relative_to(ROOT)}:{line}: {room} must not import from {other}"


def test_installed_packages_are_the_folders_with_modules() -> None:
    roots = {SETUPTOOLS["package-dir"][name]: name for name in SETUPTOOLS["package-dir"]}
    there = {
        ".".join([name, *path.parent.relative_to(ROOT / root).parts])
        for root, name in roots.items()
        for path in (ROOT / root).rglob("*.py")
    }
    assert set(SETUPTOOLS["packages"]) == there
    for package in there:
        assert (folder_of(package) / "__init__.py").is_file(), f"{package} has no __init__.py"


def test_installed_data_files_are_there() -> None:
    for package, names in SETUPTOOLS["package-data"].items():
        for name in names if package != "*" else ():
            assert any(folder_of(package).glob(name)), f"{package} lists {name}, which is not there"
    assert "*.pyi" in SETUPTOOLS["package-data"]["*"], "rooms read their public names from their stubs"


def test_rooms_stand_in_the_map() -> None:
    text = (ROOT / "docs" / "map.md").read_text(encoding="utf-8")
    for room in {room_of(module) for module in MODULES if module != "ballfg"}:
        level_of(room)
        assert f"{room}/" in text or f"{room}.py" in text, f"docs/map.md does not name {room}"
