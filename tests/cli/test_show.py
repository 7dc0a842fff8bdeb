"""`ballfg show` as a user types it: what it writes, and one clear line for what it cannot show."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from ballfg.tracks.info import TABLE_TENNIS, DatasetInfo, write_info
from ballfg.vision.camera_file import write_cameras
from tests.commands import printed, refused, status
from tests.estimation.observations.sighted_rig import RIG, TABLE, scene, world
from tests.pages.made import Fall, Made, make
from tests.written_tables import write_sightings


@pytest.fixture
def made(tmp_path: Path) -> Made:
    return make(tmp_path / "made", {"a": Fall(), "b": Fall(0.5)})


def test_page_and_picture(made: Made, tmp_path: Path) -> None:
    page, picture = tmp_path / "page.html", tmp_path / "picture.png"
    given = (made.predictions, made.dataset, made.states)
    said = printed("show", *given, "--out", page, "--png", picture, "--track", "b")
    assert said.out.splitlines() == [f"{picture}: shot b", f"{page}: 1 of 2 shots"]
    assert page.read_text(encoding="utf-8").startswith("<!DOCTYPE html>")
    assert picture.read_bytes().startswith(b"\x89PNG")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--out", "page.txt"], "out must end in .html or .htm"),
        (["--out", "no/page.html"], "out must be in an existing folder"),
        ([], "out must name the page to write"),
        (["--out", "page.html", "--track", "c"], "--track must name one of the 2 shots; got 'c'"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(
    made: Made, tmp_path: Path, words: list[str], message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    lines = [line for line in refused("show", made.dataset, *words).splitlines() if not line.startswith("note: ")]
    assert len(lines) == 1
    assert message in lines[0]
    assert sorted(path.name for path in tmp_path.iterdir()) == ["made"]


def test_a_missing_viewer_is_said_before_anything_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "rerun", None)
    assert "pip install 'ballfg[viewer]'" in refused("show", tmp_path / "nothing", "--rerun", tmp_path / "log.rrd")


def test_a_recording_holds_every_shot(made: Made, tmp_path: Path) -> None:
    pytest.importorskip("rerun", reason="rerun-sdk is not installed")
    assert (
        f"{tmp_path / 'log.rrd'}: 2 shots"
        in printed("show", made.dataset, made.states, "--rerun", tmp_path / "log.rrd").out
    )
    assert (tmp_path / "log.rrd").stat().st_size > 1000


def test_what_cameras_saw_is_shown_without_a_table_of_tracks(tmp_path: Path) -> None:
    folder = tmp_path / "seen"
    folder.mkdir()
    write_info(folder / "dataset.yaml", DatasetInfo("seen", TABLE, TABLE_TENNIS))
    write_cameras(folder / "cameras.yaml", RIG)
    write_sightings(folder / "detections.csv", [("one", scene(0, world(), duration=0.3).sightings)])
    states, page = folder / "states.csv", tmp_path / "page.html"
    assert status("estimate", folder, "--out", states, "--jobs", 1) == 0
    assert "1 of 1 shots" in printed("show", folder, states, "--out", page).out
    assert "triangulated from what the cameras saw" in page.read_text(encoding="utf-8")
