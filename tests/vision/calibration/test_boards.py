"""Corners of boards in rendered images against where they were projected, and what is not taken for a board."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.vision.calibration.boards import Charuco, Chessboard, find_views, image_files, read_grey, suggested
from tests.vision.calibration.board_scenes import CHARUCO, CHESSBOARD, TRUE, image_of, poses


@pytest.mark.parametrize("board", [CHESSBOARD, CHARUCO], ids=["chessboard", "charuco"])
def test_corners_are_where_they_were_projected(board: Chessboard | Charuco) -> None:
    rng = np.random.default_rng(1)
    errors = []
    for rvec, tvec in poses(board, 3, rng, tilt=0.4):
        found = board.find(image_of(board, rvec, tvec, rng))
        assert found is not None
        pixels, points = found
        if isinstance(board, Chessboard):  # the search begins where it likes: its corners lie one square further
            points += (board.square, board.square, 0)
        true = cv2.projectPoints(points, rvec, tvec, TRUE.matrix, TRUE.distortion)[0].reshape(-1, 2)
        if np.linalg.norm(pixels[0] - true[0]) > 5:
            true = true[::-1]
        errors.append(pixels - true)
    errors = np.concatenate(errors)
    assert np.sqrt((errors**2).sum(axis=1).mean()) < 0.08
    assert np.abs(errors.mean(axis=0)).max() < 0.02  # no shift, as of half a pixel


def test_charuco_is_found_in_part() -> None:
    rng = np.random.default_rng(2)
    image = image_of(CHARUCO, np.array([0.1, 0.2, 0.0]), np.array([-0.1, -0.1, 0.45]), rng)
    image[:, 400:] = 90
    found = CHARUCO.find(image)
    assert found is not None
    assert 8 <= len(found[0]) < 35
    image[:, 150:] = 90
    assert CHARUCO.find(image) is None


@pytest.mark.parametrize(
    ("rvec", "tvec"),
    [
        ([0.105, 0.013, -0.125], [-0.206, -0.232, 0.591]),
        ([-0.033, 0.347, 0.239], [-0.053, -0.261, 0.549]),
    ],
)
def test_the_edge_of_a_board_is_not_a_row_of_corners(rvec: list[float], tvec: list[float]) -> None:
    """One row lies outside the image: OpenCV's search (5.0) takes the edge at the other side for it."""
    image = image_of(CHESSBOARD, np.array(rvec), np.array(tvec), np.random.default_rng(0))
    assert CHESSBOARD.find(image) is None


def test_corners_counted_in_place_of_squares_are_noticed(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    file = tmp_path / "a.png"
    cv2.imwrite(str(file), image_of(CHESSBOARD, *poses(CHESSBOARD, 1, rng, tilt=0.1)[0], rng))
    as_corners = Chessboard(9, 6, 0.03)
    assert as_corners.find(read_grey(file)) is None
    assert "show 10x7 squares" in suggested([file], as_corners)
    cv2.imwrite(str(file), np.full((480, 640), 128, np.uint8))
    assert suggested([file], as_corners) == ""


def test_images_are_found_in_folders_patterns_and_one_by_one(tmp_path: Path) -> None:
    for name in ("left_2.png", "left_1.png", "right_1.PNG", "notes.txt"):
        cv2.imwrite(str(tmp_path / "x.png"), np.zeros((4, 6), np.uint8))
        (tmp_path / "x.png").rename(tmp_path / name)
    names = lambda *places: [file.name for file in image_files([str(tmp_path / place) for place in places])]  # noqa: E731
    assert names("") == ["left_1.png", "left_2.png", "right_1.PNG"]
    assert names("left_*.png") == ["left_1.png", "left_2.png"]
    assert names("right_1.PNG", "left_2.png") == ["right_1.PNG", "left_2.png"]
    with pytest.raises(FileNotFoundError, match=r"notes.txt: must be a folder, a pattern or a file of images"):
        names("notes.txt")
    with pytest.raises(FileNotFoundError, match="nowhere"):
        names("nowhere")
    view = next(find_views([tmp_path / "left_1.png"], CHESSBOARD))
    assert (view.name, view.size, len(view.pixels)) == ("left_1.png", (6, 4), 0)


@pytest.mark.parametrize("content", [b"", b"no image"])
def test_what_is_no_image_is_named(tmp_path: Path, content: bytes) -> None:
    (tmp_path / "broken.png").write_bytes(content)
    with pytest.raises(ValueError, match=r"broken.png must be readable"):
        read_grey(tmp_path / "broken.png")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: Chessboard(3, 7, 0.03), "squares must be at least 4 a row and column; got 3x7"),
        (lambda: Chessboard(10, 7, 0.0), "square must be the side of a square in m, above 0; got 0"),
        (lambda: Charuco(8, 6, 0.04, 0.05), "marker must be above 0 and smaller than a square of 0.04 m; got 0.05"),
        (lambda: Charuco(8, 6, 0.04, 0.03, "9X9_50"), "dictionary must be one of 4X4_100"),
        (lambda: Charuco(20, 12, 0.04, 0.03), "dictionary must have 120 markers for 20x12 squares; 4X4_100 has 100"),
    ],
)
def test_boards_that_cannot_be(make, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()
