"""Which video is which camera's, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.vision import Camera
from ballfg.vision.tracking.pipeline import check_sizes, match_videos, stamp_files, without

SIZE = (1280, 720)


def camera(name: str, size: tuple[int, int] = SIZE) -> Camera:
    matrix = np.array([[1000.0, 0.0, 639.5], [0.0, 1000.0, 359.5], [0.0, 0.0, 1.0]])
    return Camera(name, size, matrix, np.zeros(5), np.zeros(3), np.zeros(3))


RIG = [camera("left"), camera("middle"), camera("right")]


def test_videos_go_by_their_stems_or_their_names(tmp_path: Path) -> None:
    folder = tmp_path / "middle"
    folder.mkdir()
    found = match_videos([f"right={tmp_path}/take=2.avi", str(folder), "a/left.mp4"], RIG)
    assert list(found) == ["left", "middle", "right"]
    assert found == {"left": Path("a/left.mp4"), "middle": folder, "right": tmp_path / "take=2.avi"}


def test_a_folder_with_a_point_in_its_name_is_not_cut(tmp_path: Path) -> None:
    (tmp_path / "cam.1").mkdir()
    rig = [camera("cam.1"), camera("b")]
    assert match_videos([str(tmp_path / "cam.1"), "b.mp4"], rig)["cam.1"] == tmp_path / "cam.1"


@pytest.mark.parametrize(
    ("given", "message"),
    [
        (["left.mp4", "midle.mp4", "right.mp4"], "must be of a camera: left, middle, right; got 'midle'.*Did you mean"),
        (["left.mp4", "left=b.mp4", "right.mp4"], "camera 'left' must have one video; got left.mp4 and b.mp4"),
        (["left.mp4", "right.mp4"], "got none for 'middle'. Give it as middle=FILE.*--without middle"),
    ],
)
def test_a_video_without_camera_and_a_camera_without_video(given: list[str], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        match_videos(given, RIG)


def test_a_camera_can_be_left_out() -> None:
    assert [c.name for c in without(RIG, ["middle"])] == ["left", "right"]
    with pytest.raises(ValueError, match=r"got 'midddle'\. Correct it\. Did you mean 'middle'"):
        without(RIG, ["midddle"])


def test_stamps_belong_to_a_camera() -> None:
    assert stamp_files(["left=a.csv"], RIG) == {"left": Path("a.csv")}
    for given, message in ((["a.csv"], "NAME=FILE"), (["top=a.csv"], "'top' is no"), (["left=a", "left=b"], "twice")):
        with pytest.raises(ValueError, match=message):
            stamp_files(given, RIG)


def test_another_resolution_is_refused_with_the_scaling() -> None:
    sizes = dict.fromkeys(("left", "middle", "right"), SIZE)
    check_sizes(sizes, RIG)
    with pytest.raises(
        ValueError, match=r"camera 'middle'.* got 1280x720 .* video of 640x360.*fx, fy by 0\.5;"
    ) as said:
        check_sizes(sizes | {"middle": (640, 360)}, RIG)
    assert "cx, cy become 0.5 (c + 0.5) - 0.5" in str(said.value)
    with pytest.raises(ValueError, match="different proportions"):
        check_sizes(sizes | {"right": (640, 480)}, RIG)


def test_the_remedy_for_another_resolution_is_right() -> None:
    """The same world, filmed at half the size: pixels by the advice equal the scaled picture's."""
    full = RIG[0]
    matrix = full.matrix.copy()
    matrix[[0, 1], [0, 1]] *= 0.5
    matrix[:2, 2] = 0.5 * (matrix[:2, 2] + 0.5) - 0.5
    half = replace(full, size=(640, 360), matrix=matrix)
    point = np.array([0.3, -0.2, 2.0])
    assert half.project(point) == pytest.approx(0.5 * (full.project(point) + 0.5) - 0.5)
