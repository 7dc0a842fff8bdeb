"""A copy of the tree in which changes are tried, one after the other."""

from __future__ import annotations

import contextlib
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from tests.mutants.mutations import Mutation
from tests.places import DATA, ROOT

IGNORED: Final = (
    ".git", ".venv", "build", "dist", "results", "*.egg-info",
    ".pytest_cache", ".mypy_cache", ".ruff_cache", ".hypothesis",
)  # fmt: skip
START: Final = 60.0
"""s that a run may take besides its tests: to import torch, and to compile on a busy machine."""
SLOWER: Final = 4.0
"""How many times as long as recorded tests may take before they are stopped."""
COMPILING: Final = 240.0
"""s more where all machine code is compiled anew."""
MEMORY: Final = 16 * 2**30
"""Bytes of address space: a wrong size of an array ends its process, not the machine."""
FAILURE: Final = re.compile(r"^(?:FAILED|ERROR) (\S.*?)(?: - .*)?$", re.MULTILINE)
ENDED: Final = (0, 1)
"""Exit statuses of pytest after all its tests: none failed, or some did."""
NOT_BEGUN: Final = (4, 5)
"""Exit statuses of pytest that could not run what it was given, or found no test in it."""


@dataclass(frozen=True)
class Outcome:
    """What a run of tests said.

    Attributes:
        killed: a test failed, or the run ended in another way than by passing tests.
        by: the test that failed, or in words what happened.
        seconds: it took.
        code: pytest's exit status; None where it was stopped.
    """

    killed: bool
    by: str
    seconds: float
    code: int | None


class Workshop:
    """A copy of the tree; use it as a context, which removes it at the end. Args: cache: of generated machine code."""

    def __init__(self, cache: Path) -> None:
        self.cache = cache.resolve()
        self.folder = Path(tempfile.mkdtemp(prefix="ballfg-mutants-"))
        self.tree = self.folder / "tree"

    def __enter__(self) -> Workshop:
        shutil.copytree(ROOT, self.tree, symlinks=True, ignore=shutil.ignore_patterns(*IGNORED))
        project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))
        for package, folder in project["tool"]["setuptools"]["package-dir"].items():
            link = self.tree / package.replace(".", "/")  # the package runs where it lies, as if it were installed
            if not link.exists():
                link.symlink_to(os.path.relpath(self.tree / folder, link.parent))
        return self

    def __exit__(self, *_: object) -> None:
        shutil.rmtree(self.folder, ignore_errors=True)

    def attempt(self, mutation: Mutation, tests: Sequence[str], expected: float, *, compile_anew: bool) -> Outcome:
        """Run tests, the first failure ends it, with a change in place; the tree is then as it was.

        Args: expected: s that the tests take.  compile_anew: machine code on disk does not know of the change.
        Raises: RuntimeError: if the tests cannot be run without the change either; then nothing noticed it.
        """
        path = self.tree / mutation.file
        source, stamp = path.read_bytes(), path.stat()
        path.write_bytes(mutation.applied(source))
        try:
            outcome = self._run(tests, _limit(expected, compile_anew), compile_anew)
        finally:
            path.write_bytes(source)
            os.utime(path, ns=(stamp.st_atime_ns, stamp.st_mtime_ns))  # what was compiled from it stays good
        if outcome.code in NOT_BEGUN and self.failing(tests, expected, compile_anew=compile_anew) == list(tests):
            raise RuntimeError(f"pytest must run the recorded tests; got {self._last_line()} Record anew: --refresh.")
        return outcome

    def failing(self, tests: Sequence[str], expected: float, *, compile_anew: bool) -> list[str]:
        """Those tests that fail without any change; all where the run did not come to its end."""
        outcome = self._run(tests, _limit(expected, compile_anew), compile_anew, stop=False)
        return FAILURE.findall(self._said()) if outcome.code in ENDED else list(tests)

    def _said(self) -> str:
        return (self.folder / "said").read_text(encoding="utf-8", errors="replace")

    def _last_line(self) -> str:
        return (self._said().strip().splitlines() or ["nothing."])[-1]

    def _run(self, tests: Sequence[str], limit: float, compile_anew: bool, *, stop: bool = True) -> Outcome:
        wanted, said = self.folder / "wanted", self.folder / "said"
        wanted.write_text("\n".join(tests) + "\n", encoding="utf-8")
        command = [sys.executable, "-m", "pytest", "-q", "--no-header", "--tb=no", "-p", "no:cacheprovider"]
        environment = {
            **os.environ,
            "PYTHONPATH": str(self.tree),
            "PYTEST_ADDOPTS": "",
            "PYTHONDONTWRITEBYTECODE": "1",
            "OMP_NUM_THREADS": "1",
            "BALLFG_DATA": str(DATA),
            "BALLFG_CACHE": str(self.cache),
        }
        fresh = self.folder / "machine_code"
        if compile_anew:
            environment["NUMBA_CACHE_DIR"] = str(fresh)
        begin = time.monotonic()
        with said.open("w", encoding="utf-8") as output:
            process = subprocess.Popen(
                [*command, *(["-x"] if stop else []), f"@{wanted}"],
                cwd=self.tree,
                env=environment,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
            try:
                resource.prlimit(process.pid, resource.RLIMIT_AS, (MEMORY, MEMORY))
                code = process.wait(limit)
            except subprocess.TimeoutExpired:
                code = None
            finally:
                _end(process)
        shutil.rmtree(fresh, ignore_errors=True)
        seconds = time.monotonic() - begin
        if code == 0:
            return Outcome(False, "", seconds, code)
        if code is None:
            return Outcome(True, f"no end after {limit:.0f} s", seconds, code)
        failures = FAILURE.findall(self._said())
        return Outcome(True, failures[0] if failures else f"pytest's exit status {code}", seconds, code)


def _limit(expected: float, compile_anew: bool) -> float:
    """s after which tests that take so long as recorded are stopped."""
    return START + SLOWER * expected + (COMPILING if compile_anew else 0.0)


def _end(process: subprocess.Popen[bytes]) -> None:
    """End what a run started, workers of its own included."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()
