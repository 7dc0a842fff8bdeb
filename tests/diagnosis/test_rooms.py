"""Sub-rooms of the diagnosis use each other in one direction, and none has too many files."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

import ballfg.diagnosis

ROOT = Path(ballfg.diagnosis.__file__).parent
LEVELS = (
    *(
        "generic_test",
        "label_verdicts",
        "budget",
        "result",
        "fit",
        "hypotheses",
        "evidence",
        "search",
        "residual_tests",
        "error_budget",
        "report",
    ),
    *("one_view", "design"),
    *("diagnosis", "joint", "__init__"),
)
"""From the first to the last: a module imports from its own level and from earlier ones only."""
DRAWN = {("result.py", "report")}
"""A result draws itself: `plot` imports the pictures when it is called."""
MOST_FILES = 15


def level_of(path: str) -> int:
    return LEVELS.index(path.split(".")[0])


@pytest.mark.parametrize("path", sorted(ROOT.rglob("*.py")), ids=lambda path: str(path.relative_to(ROOT)))
def test_imports_go_one_way(path: Path) -> None:
    own = level_of(".".join(path.relative_to(ROOT).with_suffix("").parts))
    for name in re.findall(r"ballfg\.diagnosis\.([\w.]+)", path.read_text(encoding="utf-8")):
        drawn = (str(path.relative_to(ROOT)), name) in DRAWN
        assert drawn or level_of(name) <= own, f"{path.relative_to(ROOT)} must not use ballfg.diagnosis.{name}"


def test_folders_are_small() -> None:
    for folder in (ROOT, *(path for path in ROOT.iterdir() if path.is_dir())):
        assert len([path for path in folder.glob("*.py") if path.name != "__init__.py"]) <= MOST_FILES
