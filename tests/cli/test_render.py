"""`ballfg render` as a user meets it: files, messages, exit statuses."""

from __future__ import annotations

from pathlib import Path

import pyarrow.csv as pa_csv
import pytest
import yaml

from ballfg.vision.camera_file import read_cameras
from tests.commands import printed, refused, status

FAST = ("--shots", 1, "--rate", 20, "--size", "160x90")


def test_writes_a_scene_and_says_where(tmp_path: Path) -> None:
    out = tmp_path / "scene"
    said = printed("render", "--out", out, *FAST)
    assert f"frames to {out}: a video and stamps for each of left, right, far; cameras.yaml" in said.out
    assert f"wrote the truth to {out}: truth.csv, visible.csv, scene.yaml" in said.out
    assert [camera.size for camera in read_cameras(out / "cameras.yaml")] == [(160, 90)] * 3
    assert "Replace it with --force" in refused("render", "--out", out, *FAST)
    assert status("render", "--out", out, *FAST, "--force", "--images") == 0
    stamps = pa_csv.read_csv(out / "left_stamps.csv")["t"].to_numpy()
    assert len(list((out / "left").glob("*.png"))) == len(stamps)


def test_options_reach_the_scene(tmp_path: Path) -> None:
    out = tmp_path / "scene"
    options = [
        "--unsynchronised",
        "--offset",
        "left=0.004",
        "--offset",
        "far=-0.001",
        "--colour",
        "orange",
        "--seed",
        5,
    ]
    options += ["--effect", "wind.x=0.3", "--settings", "speed=9", "--no-distractors", "--exposure", 0.004]
    assert status("render", "--out", out, *FAST, *options) == 0
    content = yaml.safe_load((out / "scene.yaml").read_text(encoding="utf-8"))
    clocks = content["clocks"]
    assert [clocks[name]["offset"] for name in ("left", "right", "far")] == [0.004, 0.0, -0.001]
    assert len({clock["phase"] for clock in clocks.values()}) == 3
    assert (content["colour"], content["seed"], content["exposure"]) == ("orange", 5, 0.004)
    assert content["settings"] == {"speed": [9]}
    assert content["undeclared"]["wind"]["x"] == 0.3
    assert content["distractors"] is False


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (["--offset", "middle=0.1"], "--offset must name a camera, left, right, far; got 'middle=0.1'"),
        (["--offset", "left=soon"], "--offset must read CAMERA=SECONDS; got 'left=soon'"),
        (["--size", "large"], "--size must read WIDTHxHEIGHT; got 'large'"),
        (["--distance", "9"], "must stand in the room"),
        (["--colour", "pink"], "colour must be one of white, orange"),
        (["--exposure", "0.1"], "exposure must be at most 0.95 of the frame interval"),
        (["--settings", "speed=99"], "speed must lie in 8 .. 14"),
        (["--effect", "wnd.x=1"], "Did you mean 'wind'"),
    ],
)
def test_bad_input_is_one_line(options: list[str], message: str, tmp_path: Path) -> None:
    assert message in refused("render", "--out", tmp_path / "scene", "--shots", 1, "--rate", 20, *options)
    assert not (tmp_path / "scene").exists()
