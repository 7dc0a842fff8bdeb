"""Which tests reach a line: from one recorded run of the suite, and through names where lines are not seen."""

from __future__ import annotations

import ast
import hashlib
import json
import os
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Final

from coverage import CoverageData

from tests.mutants.recorder import FOLDER, SETUP
from tests.mutants.sources import module_of, source_files
from tests.places import ROOT

ABOUT: Final = "about.json"


def digest(name: str) -> str:
    """Of a file's content."""
    return hashlib.sha256((ROOT / name).read_bytes()).hexdigest()[:16]


def record(folder: Path, tests: Sequence[str], jobs: int) -> None:
    """Run tests of the suite once, each process writing what it saw into the folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for old in folder.iterdir():
        if old.name.startswith(("lines.", "tests.")) or old.name == ABOUT:
            old.unlink()
    command = [sys.executable, "-m", "pytest", "-q", "-p", "tests.mutants.recorder", "-p", "no:cacheprovider", *tests]
    if jobs > 1:
        command += ["-n", str(jobs), "--dist", "worksteal"]
    code = subprocess.run(command, cwd=ROOT, env={**os.environ, FOLDER: str(folder.resolve())}).returncode
    if code not in (0, 1):
        raise SystemExit(f"the run of the tests ended with pytest's exit status {code}; see above")
    about = {"tests": list(tests), "sources": {name: digest(name) for name in source_files()}}
    (folder / ABOUT).write_text(json.dumps(about), encoding="utf-8")


def recorded_tests(folder: Path) -> list[str] | None:
    """The tests that a recording was asked for; None where there is none."""
    path = folder / ABOUT
    return json.loads(path.read_text(encoding="utf-8"))["tests"] if path.exists() else None


class Recording:
    """A recorded run.

    Attributes:
        seconds: of each test that passed.
        failed: those that failed or were skipped, which judge nothing.
    """

    def __init__(self, folder: Path) -> None:
        found: dict[str, dict[str, float]] = {}
        for path in sorted(folder.glob("tests.*.json")):
            found.update(json.loads(path.read_text(encoding="utf-8")))
        self.seconds = {name: test["seconds"] for name, test in found.items() if test["passed"]}
        self.failed = sorted(set(found) - set(self.seconds))
        self._kept = json.loads((folder / ABOUT).read_text(encoding="utf-8"))["sources"]
        self._data = [CoverageData(str(path)) for path in sorted(folder.glob("lines.*"))]
        for data in self._data:
            data.read()
        self._of_file: defaultdict[str, set[str]] = defaultdict(set)
        for name in self.seconds:
            self._of_file[name.split("::")[0]].add(name)
        self._lines: dict[str, dict[int, set[str]]] = {}
        self.known = Names()

    def lines(self, name: str) -> dict[int, set[str]]:
        """The tests by line of a file; empty where the file has changed since.

        What a test asks for is set up once for several of its file: all of them reach those lines.
        """
        if name not in self._lines:
            found: defaultdict[int, set[str]] = defaultdict(set)
            if self._kept.get(name) == digest(name):
                for data in self._data:
                    for line, contexts in data.contexts_by_lineno(str(ROOT.resolve() / name)).items():
                        found[line] |= self._tests(contexts)
            self._lines[name] = {line: tests for line, tests in found.items() if tests}
        return self._lines[name]

    def _tests(self, contexts: Iterable[str]) -> set[str]:
        found = set()
        for context in contexts:
            if context.endswith(SETUP):
                found |= self._of_file[context.split("::")[0]]
            elif context in self.seconds:
                found.add(context)
        return found

    def unreached(self, name: str) -> list[int]:
        """First lines of the statements within a file's functions that no test reaches in its own process."""
        seen = self.lines(name)
        inside = (f for f in ast.walk(self.known.trees[name]) if isinstance(f, ast.FunctionDef))
        found = {part for f in inside for top in f.body for part in ast.walk(top) if isinstance(part, ast.stmt)}
        return sorted(
            part.lineno
            for part in found
            if not isinstance(part, ast.Continue | ast.Pass)  # which Python leaves out where it can
            and not (isinstance(part, ast.Expr) and isinstance(part.value, ast.Constant))
            and not any(line in seen for line in range(part.lineno, (part.end_lineno or part.lineno) + 1))
        )

    def reaching(self, name: str, first: int, last: int) -> dict[str, float]:
        """Seconds of the tests that reach some lines of a file.

        Lines that a module runs as it is imported belong to no test, not even to that which imported it first, and
        machine code is not seen: then those that reach the function whose default stands there, or that use the name
        which these lines define, or else all that reach their file.
        """
        tests = self._on(name, range(first, last + 1)) if self.known.in_a_function(name, first) else set[str]()
        if not tests:
            tests = self._on(name, self.known.headed(name, first))
        if not tests:
            tests = self._using(name, self.known.defined(name, first), set())
        if not tests:
            tests = set().union(*self.lines(name).values())
        return {test: self.seconds[test] for test in tests}

    def _on(self, name: str, lines: Iterable[int]) -> set[str]:
        return set().union(*(self.lines(name).get(line, set()) for line in lines))

    def _using(self, name: str, defined: str | None, seen: set[tuple[str, str]]) -> set[str]:
        """Through the lines that use a name, and where these are not seen through what they define in their turn."""
        if defined is None or (name, defined) in seen:
            return set()
        seen.add((name, defined))
        found: set[str] = set()
        for file, line in self.known.uses(name, defined):
            here = self._on(file, [line])
            found |= here or self._using(file, self.known.defined(file, line), seen)
        return found


class Names:
    """Who defines and who uses the names at the top of the package's modules."""

    @cached_property
    def trees(self) -> dict[str, ast.Module]:
        """The syntax tree of every file."""
        return {name: ast.parse((ROOT / name).read_bytes()) for name in source_files()}

    @cached_property
    def importers(self) -> dict[tuple[str, str], dict[str, str]]:
        """The files that import a name from a module, each with what it calls it."""
        found: defaultdict[tuple[str, str], dict[str, str]] = defaultdict(dict)
        for name, tree in self.trees.items():
            for node in ast.walk(tree):
                if isinstance(node, ast.ImportFrom) and node.module is not None:
                    for alias in node.names:
                        found[node.module, alias.name][name] = alias.asname or alias.name
        return found

    def defined(self, name: str, line: int) -> str | None:
        """The function, class or constant whose definition at the top of a module holds a line."""
        for node in self.trees[name].body:
            first = min([node.lineno, *(d.lineno for d in getattr(node, "decorator_list", []))])
            if first <= line <= (node.end_lineno or first):
                if isinstance(node, ast.Assign):
                    return getattr(node.targets[0], "id", None)
                if isinstance(node, ast.AnnAssign):
                    return getattr(node.target, "id", None)
                return getattr(node, "name", None)
        return None

    def in_a_function(self, name: str, line: int) -> bool:
        """Whether a line runs when a function is called."""
        return any(
            node.body[0].lineno <= line <= (node.end_lineno or line)
            for node in ast.walk(self.trees[name])
            if isinstance(node, ast.FunctionDef)
        )

    def headed(self, name: str, line: int) -> range:
        """The lines of the function in whose head a line stands; none where it stands in no head."""
        for node in ast.walk(self.trees[name]):
            if isinstance(node, ast.FunctionDef) and node.lineno <= line < node.body[0].lineno:
                return range(node.body[0].lineno, (node.end_lineno or node.body[0].lineno) + 1)
        return range(0)

    def uses(self, name: str, defined: str) -> list[tuple[str, int]]:
        """Files and lines that use a name, in its own module and in those that import it from there.

        Where there is none, those with a text that is the name: generated code calls what nobody imports.
        """
        files = {name: defined} | self.importers.get((module_of(name), defined), {})
        found = {
            (file, node.lineno)
            for file, called in files.items()
            for node in ast.walk(self.trees[file])
            if isinstance(node, ast.Name) and node.id == called and isinstance(node.ctx, ast.Load)
        }
        return sorted(found or {(file, line) for file, line, text in self.texts if text == defined})

    @cached_property
    def texts(self) -> list[tuple[str, int, str]]:
        """File, line and value of every text."""
        return [
            (file, node.lineno, node.value)
            for file, tree in self.trees.items()
            for node in ast.walk(tree)
            if isinstance(node, ast.Constant) and isinstance(node.value, str)
        ]

    def frozen_in_machine_code(self, name: str, line: int, compiled: set[str]) -> bool:
        """Whether machine code on disk would not know of a change: of compiled functions, or of a constant in them.

        Args: compiled: files with such functions.
        """
        defined = self.defined(name, line)
        if name in compiled:
            return True
        constant = defined is not None and defined.lstrip("_").isupper()
        return constant and not compiled.isdisjoint(self.importers.get((module_of(name), defined), {}))
