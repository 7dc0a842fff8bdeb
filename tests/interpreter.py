"""Commands as a user types them, in a new interpreter that finds packages of given folders."""

from __future__ import annotations

import json
import os
import subprocess
import sys
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

from tests.places import ROOT


def fresh(code: str, **more: Any) -> subprocess.CompletedProcess[str]:
    """What an interpreter of its own prints of some code."""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run([sys.executable, "-c", code], env=environment, capture_output=True, text=True, **more)


COMMAND = "ballfg.cli.main:run"
"""`ballfg`, as the name of its function."""
SERVE = """
import io, json, sys
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module

for line in sys.stdin:
    function, words = json.loads(line)
    module, name = function.split(":")
    printed, said = (io.TextIOWrapper(io.BytesIO(), encoding="utf-8", write_through=True) for _ in range(2))
    status = 0
    with redirect_stdout(printed), redirect_stderr(said):
        try:
            getattr(import_module(module), name)(words)
        except SystemExit as done:
            status = done.code or 0
    print(json.dumps((status, *(stream.buffer.getvalue().decode() for stream in (printed, said)))), flush=True)
"""


@dataclass(frozen=True)
class Answer:
    """What a command left: its exit status, its output and its messages."""

    status: int
    out: str
    err: str


class Interpreter:
    """A new interpreter for several commands, one after another: it imports heavy libraries once.

    Use it as a context, which ends it.

    Args: folders: of packages that it finds before others.  variables: of its environment, beside those of this one.
    """

    def __init__(self, folders: Sequence[Path] = (), variables: Mapping[str, str] | None = None) -> None:
        path = os.pathsep.join(map(str, (*folders, ROOT)))
        environment = {**os.environ, **(variables or {}), "PYTHONPATH": path}
        self._process = subprocess.Popen(
            [sys.executable, "-c", SERVE], env=environment, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
        )

    def __enter__(self) -> Interpreter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._process.communicate(timeout=60)

    def __call__(self, *words: object, function: str = COMMAND) -> Answer:
        """Run a command. Args: words: of its command line.  function: that takes them, as MODULE:NAME."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.write(json.dumps((function, [str(word) for word in words])) + "\n")
        self._process.stdin.flush()
        line = self._process.stdout.readline()
        assert line, f"the interpreter ended with status {self._process.wait()}"
        return Answer(*json.loads(line))
