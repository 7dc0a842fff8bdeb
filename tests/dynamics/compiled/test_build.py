"""What a process makes, another one finds; and damage, full disks and the like cost no more than time."""

import itertools
import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from ballfg.dynamics.compiled.build import read_note, write_note
from ballfg.dynamics.compiled.kept import cache_folder

SCRIPT = """
from ballfg.dynamics import EFFECTS, AnalyticModel
from ballfg.dynamics.compiled.functions import compiled
from ballfg.dynamics.compiled.kept import cache_folder
assert compiled(AnalyticModel([EFFECTS["gravity"](), EFFECTS["restitution"]()])) is not None
print(*sorted(p.name for p in cache_folder().glob("*.py")))
"""


def in_process(folder) -> list[str]:
    environment = os.environ | {"BALLFG_CACHE": str(folder)}
    return subprocess.run(
        [sys.executable, "-W", "error", "-c", SCRIPT], env=environment, capture_output=True, text=True, check=True
    ).stdout.split()


@pytest.fixture(scope="module")
def made(tmp_path_factory) -> tuple[Path, list[str]]:
    """What a first process leaves: the folder, and names of its functions."""
    folder = tmp_path_factory.mktemp("cache")
    return folder, in_process(folder)


@pytest.mark.thorough  # quicker ones: kept code in test_kept.py, notes in test_functions.py
def test_a_second_process_finds_what_the_first_has_made(made) -> None:
    folder, names = made
    stamps = {path: path.stat().st_mtime_ns for path in (folder / "ballfg").rglob("*") if path.is_file()}
    assert len(names) == 5  # rates, impact, surface; of a ball on a surface the friction, and the rates with it
    assert in_process(folder) == names
    assert {path: path.stat().st_mtime_ns for path in stamps} == stamps


@pytest.mark.thorough
def test_what_a_power_failure_has_damaged_is_made_again(made, tmp_path) -> None:
    folder = Path(shutil.copytree(made[0], tmp_path / "cache"))
    whole = {path: path.read_bytes() for path in (folder / "ballfg").rglob("*") if path.is_file()}
    kinds = {ending: itertools.cycle((0.0, 0.5, 0.9)) for ending in (".py", ".json", ".nbc")}
    for path, content in whole.items():
        kept = int(next(kinds[path.suffix]) * len(content))
        path.write_bytes(content[:kept])
    assert in_process(folder) == made[1]
    for path, content in whole.items():
        assert path.read_bytes() == content if path.suffix in (".py", ".json") else path.stat().st_size


def test_a_note_that_somebody_changed_is_none(tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("BALLFG_CACHE", str(tmp_path))
    cache_folder.cache_clear()
    assert read_note("a") is None
    write_note("a", {"size": 3})
    assert read_note("a") == {"size": 3}
    (file,) = tmp_path.rglob("*.json")
    for text in (file.read_text().replace("3", "4"), '{"size": 3}', "[", "[" * 100_000, "", "3"):
        file.write_text(text)
        assert read_note("a") is None


@pytest.fixture(autouse=True)
def _restored():
    yield
    cache_folder.cache_clear()
