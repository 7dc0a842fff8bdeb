"""Whatever a command is killed at, its folder is the old or the new one, and it can be typed again."""

from __future__ import annotations

import subprocess
import sys

import pytest

from tests.faults.injection import FULL
from tests.faults.kills import Tally, run
from tests.faults.scenarios import SCENARIOS, warm_up
from tests.places import ROOT

SOME = {
    "simulate-csv-over-parquet": 3,
    "estimate": 2,
    "import": 2,
    "calibrate-cameras": 2,
    "learned-model": 4,
    "report": 4,
    "checkpoint": 4,
    "sequence-model": 4,
    "train": 2,
}
"""Numbers of calls at which these are killed here; `python -m tests.faults.kills --all` tries every call of all."""
LONG = ("train", "calibrate-cameras", "learned-model", "sequence-model")
"""Those of `SOME` that take long, or write as others do."""
NAMED = {scenario.name: scenario for scenario in SCENARIOS}


@pytest.mark.parametrize(
    ("words", "points"),
    [(("folder",), 30), pytest.param(("folder-again", "--full-disk"), 150, marks=pytest.mark.thorough)],
)
def test_a_folder_at_every_call_that_is_killed_or_finds_the_disk_full(words: tuple[str, ...], points: int) -> None:
    command = [sys.executable, "-m", "tests.faults.kills", "--all", *words]  # without torch a copy takes 2 ms
    said = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=False)
    assert said.returncode == 0, said.stdout + said.stderr
    last = said.stdout.splitlines()[-1]
    assert int(last.split()[0]) >= points
    assert [word for word in last.split() if word.strip(",").isdigit()][1:] == [*["0,"] * 6, "0"]


@pytest.mark.parametrize("name", [pytest.param(n, marks=[pytest.mark.thorough] * (n in LONG)) for n in SOME])
def test_a_kill_of_each_command(name: str) -> None:
    warm_up()
    tally = Tally()
    run(NAMED[name], tally, SOME[name])
    assert tally.wrong == []
    assert tally.counts["points"] == SOME[name]


def test_a_disk_that_is_full_for_a_command() -> None:
    warm_up()
    tally = Tally()
    run(NAMED["estimate"], tally, 3, FULL, lasting=True)
    assert tally.wrong == []
