"""The entry points of the installed programs: Ctrl-C is one line even while they are being imported."""

import sys
from importlib import import_module

from ballfg.collector import collect_rarely


def ballfg() -> None:
    """The program `ballfg`."""
    _run("ballfg.cli.main")


def bench() -> None:
    """The program `ballfg-bench`."""
    _run("ballfg.benchmarks.cli")


def train() -> None:
    """The program `ballfg-train`."""
    _run("ballfg.learning.cli")


def _run(module: str) -> None:
    collect_rarely()
    try:
        import_module(module).run()
    except KeyboardInterrupt:
        print("ballfg: interrupted", file=sys.stderr)
        sys.exit(130)
