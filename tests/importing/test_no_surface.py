"""Recordings without a surface: no bounce shows one, and no command asks for one."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import yaml

import ballfg as bf
from ballfg.tracks import read_dataset
from tests.commands import status
from tests.importing.throws import thrown, write_rows


def _throws(folder: Path, count: int = 9, step: float = 0.01) -> Path:
    """Throws that go up and come down, 0.9 s, with noise of 2 mm."""
    t = np.arange(0.0, 0.9, step)
    rows = []
    for shot in range(count):
        p = np.stack((3.0 * t, 0.1 * shot * t, 2.0 + 5.0 * t - 4.905 * t**2), axis=1)
        p += 0.002 * np.random.default_rng(shot).standard_normal(p.shape)
        rows += [(shot, *row) for row in np.column_stack((t, p)).tolist()]
    return write_rows(folder / "throws.csv", "shot,t,x,y,z", rows)


def test_throws_have_no_surface_and_no_doubt_about_it() -> None:
    t, p = thrown(0.001)
    before = t < 0.34  # the bounce is at 0.35 s
    data = bf.import_tracks([np.column_stack((t, p))[before] for _ in range(9)])
    assert data.info.table_height is None
    assert data.info.imported is not None
    assert data.info.imported["table height"].startswith("none (likely: no ball bounces")
    assert not any("surface" in doubt for doubt in data.info.doubts)


def test_a_stated_height_stays() -> None:
    t, p = thrown(0.001)
    data = bf.import_tracks(np.column_stack((t, p))[t < 0.34], table_height=0.5)
    assert data.info.table_height == 0.5


def test_turns_that_may_be_bounces_are_a_doubt() -> None:
    """Three balls that turn upwards at heights which no single surface has."""
    t, p = thrown(0.001)
    data = bf.import_tracks([np.column_stack((t, p + np.array([0.0, 0.0, rise]))) for rise in (0.0, 0.35, 0.7)])
    assert data.info.table_height is None
    (doubt,) = (doubt for doubt in data.info.doubts if "surface" in doubt)
    assert "3 turns at 0.78 to 1.48 m may be bounces or hits" in doubt


def test_every_command_runs(tmp_path: Path) -> None:
    data, states, ahead = tmp_path / "throws", tmp_path / "states.csv", tmp_path / "ahead.csv"
    assert status("import", _throws(tmp_path, 5, 0.02), "--out", data) == 0
    assert yaml.safe_load((data / "dataset.yaml").read_text())["frame"] == {"up": "z", "table_height": "none"}
    assert read_dataset(data).info.table_height is None
    for command in (
        ("estimate", data, "--out", states),
        ("predict", data, "--observe", 0.4, "--out", ahead),
        ("predict", data, "--observe", 0.4, "--next-contact", "--apex", "--out", tmp_path / "events.csv"),
        ("noise", data),
        ("show", data, states, ahead, "--out", tmp_path / "page.html"),
        ("live", "--replay", data, "--speed", 0, "--plane", "z=2.5,down", "--out", tmp_path / "live.jsonl"),
    ):
        assert status(*command) == 0, command
    events = (tmp_path / "events.csv").read_text().splitlines()[1:]
    assert all(float(row.split(",")[2]) == ("apex" in row) for row in events)  # the probability of each


@pytest.mark.thorough
def test_a_diagnosis_runs(tmp_path: Path) -> None:
    assert status("import", _throws(tmp_path), "--out", tmp_path / "throws") == 0
    assert status("diagnose", tmp_path / "throws", "--out", tmp_path / "diagnosis") == 0
