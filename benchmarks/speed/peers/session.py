"""Runs one library with one problem in a process that is asked for solutions."""

import json
import os
import subprocess
import time
from collections.abc import Sequence
from pathlib import Path
from types import TracebackType
from typing import Any, Final, Self

import numpy as np

from ballfg.arrays import Array

WORKER: Final = Path(__file__).with_name("worker.py")


class LibraryError(Exception):
    """A library is missing, or does not solve this problem."""


class Session:
    """A running process; use it in a `with` block.

    Args: python: command that starts the library's interpreter.  task: "estimate" or "rollout".

    Attributes:
        cold: s from the start of the process to its first solution.
        first: s of the first solution, with everything that is compiled for it.
        peak: MiB, the process's largest memory so far.

    Raises: LibraryError: if the library cannot do it.
    """

    def __init__(self, python: Sequence[str], library: str, task: str, problem: Path) -> None:
        begun = time.perf_counter()
        environment = os.environ | {"OMP_NUM_THREADS": "1", "MKL_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        self._process = subprocess.Popen(
            [*python, str(WORKER), library, task, str(problem)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            env=environment,
        )
        self._library = library
        try:
            answer = self._answer()
        except LibraryError:
            self._end()
            raise
        self.cold = time.perf_counter() - begun
        self.first, self.peak = float(answer["first"]), 0.0

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        self._end()

    def times(self, count: int) -> list[float]:
        """S of so many solutions, one after another."""
        answer = self._ask(str(count))
        self.peak = float(answer["peak"])
        return [float(t) for t in answer["times"]]

    def solution(self, folder: Path) -> dict[str, Array]:
        """The last solution by name: position m and velocity m/s (t, n, 3) with spin (t, 3) rad/s, or states (k, 9)."""
        path = folder / f"{self._library}-{id(self)}.npz"
        self._ask(str(path))
        with np.load(path) as file:
            return {name: file[name] for name in file.files}

    def _ask(self, line: str) -> dict[str, Any]:
        assert self._process.stdin is not None
        self._process.stdin.write(f"{line}\n")
        self._process.stdin.flush()
        return self._answer()

    def _answer(self) -> dict[str, Any]:
        """The next line of JSON; libraries print lines of their own between."""
        assert self._process.stdout is not None
        for line in self._process.stdout:
            if line.startswith("{"):
                answer: dict[str, Any] = json.loads(line)
                if "error" in answer:
                    raise LibraryError(f"{self._library}: {answer['error']}")
                return answer
        assert self._process.stderr is not None
        last = self._process.stderr.read().strip().splitlines()[-1:]
        raise LibraryError(f"{self._library} ended: {' '.join(last) or 'without a word'}")

    def _end(self) -> None:
        self._process.kill()
        self._process.communicate()
