"""The files whose lines are changed, and the rooms they belong to."""

from __future__ import annotations

from fnmatch import fnmatch
from pathlib import Path

from tests.places import ROOT

PACKAGES = ("ballfg", "factors", "learning", "benchmarks")
LEFT_OUT = (
    "*/__init__.py",
    "*/__main__.py",
    "ballfg/cli/*",  # commands parse, call and print
    "*/cli.py",
    "benchmarks/speed/peers/with_*.py",  # they run in environments of their own
    "benchmarks/speed/peers/worker.py",
)


def source_files(root: Path = ROOT) -> list[str]:
    """Paths below the root, in order; a folder that is linked into another one counts where it lies."""
    found = []
    for package in PACKAGES:
        for path in sorted((root / package).rglob("*.py")):
            name = path.relative_to(root).as_posix()
            if path.resolve() == root.resolve() / name and not any(fnmatch(name, pattern) for pattern in LEFT_OUT):
                found.append(name)
    return found


def room_of(name: str) -> str:
    """The room of a file: `ballfg/tracks/track.py` is of `tracks`, `factors/graph.py` of `factors`."""
    parts = name.split("/")
    return parts[1] if parts[0] == "ballfg" and len(parts) > 2 else parts[0]


def module_of(name: str) -> str:
    """The name under which a file is imported."""
    dotted = name.removesuffix(".py").replace("/", ".")
    return dotted if name.startswith("ballfg/") else f"ballfg.{dotted}"


def has_machine_code(text: str) -> bool:
    """Whether numba compiles functions of a file."""
    return "@machine_code(" in text or "@njit" in text
