"""Opening a folder that somebody sent harms nothing, whatever is planted in it and around it."""

from __future__ import annotations

import json
import os
import shutil
from pathlib import Path
from signal import SIGALRM
from unittest.mock import patch

import pytest

from tests.commands import status
from tests.faults.elsewhere import changes, in_this_process, state, try_folders
from tests.faults.scenarios import IMPORT, capture

PLAN = {"stale": ["thesis.tex", "src"], "new": []}


@pytest.fixture(scope="module")
def imported(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset, in a folder with a file of its own."""
    folder = tmp_path_factory.mktemp("imported")
    capture(folder)
    assert status(*(str(word).replace("@", str(folder)) for word in IMPORT)) == 0
    return folder / "mine"


@pytest.fixture
def home(imported: Path, tmp_path: Path) -> Path:
    """The folder of a user, with a dataset `d`."""
    shutil.copytree(imported, tmp_path / "home" / "d")
    (tmp_path / "home" / "src").mkdir()
    for name in ("thesis.tex", "src/main.c", "d/thesis.tex"):
        (tmp_path / "home" / name).write_text(f"the only copy of {name}")
    (tmp_path / "v.txt").write_text("the only copy of v.txt")
    (tmp_path / "out").mkdir()
    return tmp_path / "home"


def unchanged_by(home: Path, words: tuple[object, ...], expected: int = 0) -> None:
    """Runs a command; nothing changes outside of `out`."""
    before = state(home.parent)
    found, said = in_this_process([str(word) for word in words])
    assert found == expected, said
    out = home.parent / "out"
    kept = {path: one for path, one in state(home.parent).items() if not Path(path).is_relative_to(out)}
    assert kept == {path: one for path, one in before.items() if not Path(path).is_relative_to(out)}


@pytest.mark.parametrize("target", ["../../../v.txt", "../../nowhere"])
@pytest.mark.parametrize("command", ["show", "estimate", "model"])
def test_a_link_as_the_lock_of_an_earlier_version(home: Path, command: str, target: str) -> None:
    out = home.parent / "out"
    planted = home / "d" / ".ballfg-writing"
    planted.mkdir()
    (planted / "plan.json").write_text("{}")
    (planted / "lock").symlink_to(target)
    (out / ".s.csv.ballfg-writing").mkdir()
    (out / ".s.csv.ballfg-writing" / "lock").symlink_to("../../v.txt")
    model = home / "d" / "model.yaml"
    model.write_text("flight: {gravity: {}}\nbounce: {restitution: {}}\n")
    words = {
        "show": ("show", home / "d", "--out", out / "p.html"),
        "estimate": ("estimate", home / "d", "--out", out / "s.csv", "--jobs", 1),
        "model": ("estimate", home / "d", "--model", model, "--out", out / "s.csv", "--jobs", 1),
    }
    unchanged_by(home, words[command])
    assert (home.parent / "v.txt").read_text() == "the only copy of v.txt"
    assert os.readlink(out / ".s.csv.ballfg-writing" / "lock") == "../../v.txt"


@pytest.mark.parametrize("where", [".", "d"])
def test_a_plan_of_an_earlier_version_is_not_carried_out(home: Path, where: str) -> None:
    planted = home / where / ".ballfg-writing"
    (planted / "new").mkdir(parents=True)
    (planted / "new" / "thesis.tex").write_text("theirs")
    (planted / "plan.json").write_text(json.dumps(PLAN | {"new": ["thesis.tex"]}))
    out = home.parent / "out"
    unchanged_by(home, ("estimate", home / "d", "--out", out / "s.csv", "--jobs", 1))
    unchanged_by(home, ("show", home / "d", "--out", out / "p.html"))


def test_a_plan_in_the_folder_of_the_output_is_not_carried_out(home: Path) -> None:
    planted = home / ".ballfg-writing"
    planted.mkdir()
    (planted / "plan.json").write_text(json.dumps(PLAN))
    before = state(home)
    assert status("estimate", home / "d", "--out", home / "s.csv", "--jobs", 1) == 0
    (home / "s.csv").unlink()
    after = state(home)
    assert {path for path in before if before[path][3] != after[path][3]} == set()
    assert after.keys() == before.keys()


@pytest.mark.parametrize("name", ["tracks.csv", "dataset.yaml", "labels.csv"])
def test_a_pipe_in_place_of_a_file_is_not_waited_for(home: Path, name: str) -> None:
    (home / "d" / name).unlink(missing_ok=True)
    os.mkfifo(home / "d" / name)
    found, said = in_this_process(["show", str(home / "d"), "--out", str(home / "p.html")], 20.0)
    assert found == (0 if name == "labels.csv" else 2), said


def test_links_in_a_loop_are_refused_in_one_line(home: Path) -> None:
    for name in ("detections.csv", "cameras.yaml"):
        (home / "d" / name).symlink_to(name)
    seen, cameras = (str(home / "d" / name) for name in ("detections.csv", "cameras.yaml"))
    found, said = in_this_process(["track", seen, "--cameras", cameras, "--out", str(home / "tracked")])
    assert (found, said.count("\n")) == (2, 1), said
    assert "Too many levels of symbolic links" in said


def test_an_output_in_proc_is_refused_at_once(home: Path) -> None:
    found, said = in_this_process(["estimate", str(home / "d"), "--out", "/proc/x.csv", "--jobs", "1"], 20.0)
    assert (found, said.count("\n")) == (2, 1)
    assert said.startswith("ballfg: error: /proc/x.csv: ")


@pytest.mark.thorough
def test_random_folders() -> None:
    """A few of those of `python -m tests.faults.elsewhere`."""
    seen, wrong = try_folders(2, seed=3)
    assert wrong == []
    assert seen["done"] > 4


def test_what_would_be_wrong_is_seen(home: Path, tmp_path: Path) -> None:
    before = state(tmp_path)
    (tmp_path / "v.txt").write_text("another")
    (home / "thesis.tex").chmod(0o600)
    (home / "left").touch()
    (home / "src" / "main.c").unlink()
    names = {Path(path).relative_to(tmp_path).as_posix() for path in changes(before, state(tmp_path), tmp_path / "out")}
    assert names == {"v.txt", "home", "home/thesis.tex", "home/left", "home/src", "home/src/main.c"}


def test_a_command_that_waits_is_a_hang(tmp_path: Path) -> None:
    def wait(_: list[str]) -> None:
        (tmp_path / "pipe").read_text()

    os.mkfifo(tmp_path / "pipe")
    with patch("tests.faults.elsewhere.run", wait):
        assert in_this_process([], 0.2) == (-SIGALRM, "hangs")
