"""`ballfg calibrate-cameras` as a user meets it: images to cameras.yaml, what it prints, what it refuses."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml

from ballfg.vision import Camera
from ballfg.vision.calibration.table_points import table_points
from ballfg.vision.camera_file import read_cameras, write_cameras
from tests.commands import printed, refused, status
from tests.vision.calibration.board_scenes import CHARUCO, TRUE, image_of, poses
from tests.vision.filming import looking

BOARD = ("--board", "charuco", "--squares", "8x6", "--square", 0.04, "--marker", 0.03)
CENTRES = {"left": (-1.2, 2.6, 2.2), "right": (-1.0, -2.8, 2.3)}


def standing(name: str) -> Camera:
    lens = {"size": TRUE.size, "matrix": TRUE.matrix, "distortion": TRUE.distortion}
    return looking(name, CENTRES[name], (1.37, 0.0, 0.76), **lens)


@pytest.fixture(scope="module")
def calib(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Images of a board for two cameras, one of them blank, and a table file with pixels to 0.3."""
    folder = tmp_path_factory.mktemp("calib")
    rng = np.random.default_rng(0)
    table: dict[str, dict[str, list[float]]] = {}
    for name in CENTRES:
        (folder / name).mkdir()
        for i, pose in enumerate(poses(CHARUCO, 12, rng, tilt=0.5, reach=1.7)):
            cv2.imwrite(str(folder / name / f"{i:02d}.png"), image_of(CHARUCO, *pose, rng))
        cv2.imwrite(str(folder / name / "blank.png"), np.full((480, 640), 100, np.uint8))
        camera = standing(name)
        seen = {point: camera.project(place) for point, place in table_points().items() if camera.in_view(place)}
        table[name] = {point: (pixel + rng.normal(0, 0.3, 2)).round(2).tolist() for point, pixel in seen.items()}
    (folder / "table.yaml").write_text(yaml.safe_dump({"sigma": 0.3, "cameras": table}))
    return folder


def images(calib: Path, *names: str) -> list[str]:
    return [word for name in names or CENTRES for word in ("--images", f"{name}={calib / name}")]


def test_from_images_to_cameras(calib: Path, tmp_path: Path) -> None:
    out = tmp_path / "cameras.yaml"
    view = ("--view", f"left={calib / 'left' / '00.png'}")
    said = printed("calibrate-cameras", *BOARD, *images(calib), "--table", calib / "table.yaml", *view, "--out", out)
    assert said.err == ""
    assert "left: 640x480\n  lens: 11 of 13 images, RMS 0.0" in said.out
    assert "left out, they disagree with the others: " in said.out
    assert "no board, or hardly any of it, in: blank.png" in said.out
    assert f"{out}: 2 cameras\n" in said.out
    for camera in read_cameras(out):
        true = standing(camera.name)
        np.testing.assert_allclose(camera.matrix[[0, 1], [0, 1]], true.matrix[[0, 1], [0, 1]], rtol=3e-3)
        assert np.linalg.norm(camera.centre - true.centre) < 0.02
        assert np.degrees(np.linalg.norm(cv2.Rodrigues(camera.rotation.T @ true.rotation)[0])) < 0.3
    assert sorted(path.name for path in tmp_path.iterdir()) == [
        "cameras.yaml",
        "cameras_calibration.json",
        "cameras_calibration.png",
    ]
    left, right = json.loads((tmp_path / "cameras_calibration.json").read_text())
    assert (left["camera"], right["camera"]) == ("left", "right")
    assert left["lens"]["missed"] == ["blank.png"]
    assert left["lens"]["rms"] < 0.1
    assert len(left["lens"]["views"]) + len(left["lens"]["left_out"]) == 12
    assert left["lens"]["ray_sigma"] < 0.5
    assert left["lens"]["sigmas"]["fx"] < 2.0
    assert left["place"]["centre_sigma"] < 0.01
    height, width = cv2.imread(str(tmp_path / "cameras_calibration.png")).shape[:2]
    assert (width, height) == (1800, 852)


def test_lenses_first_and_places_later(calib: Path, tmp_path: Path) -> None:
    lenses, out = tmp_path / "lenses.json", tmp_path / "cameras.xml"
    assert (
        f"{lenses}: 2 cameras, lenses only" in printed("calibrate-cameras", *BOARD, *images(calib), "--out", lenses).out
    )
    said = printed("calibrate-cameras", "--intrinsics", lenses, "--table", calib / "table.yaml", "--out", out).out
    assert "lens:" not in said
    assert "place: " in said
    known, placed = read_cameras(lenses, posed=False), read_cameras(out)
    for lens, camera in zip(known, placed, strict=True):
        np.testing.assert_array_equal(lens.matrix, camera.matrix)
        assert np.linalg.norm(camera.centre - CENTRES[camera.name]) < 0.02
    rough = tmp_path / "rough.yaml"
    assert (
        "focal length "
        in printed(
            "calibrate-cameras",
            "--intrinsics",
            lenses,
            "--table",
            calib / "table.yaml",
            "--focal-sigma",
            0.05,
            "--out",
            rough,
        ).out
    )
    for lens, camera in zip(known, read_cameras(rough), strict=True):
        assert abs(np.log(camera.matrix[0, 0] / lens.matrix[0, 0])) < 3.0 * np.sqrt(camera.covariance[6, 6])


def test_a_focal_length_that_was_found_roughly_stays_rough_after_a_move(tmp_path: Path) -> None:
    """The covariance of the first place, 2 m away, is not that of the second."""
    first = replace(standing("left"), covariance=np.diag(np.square([0.3] * 3 + [2.0] * 3 + [0.01])))
    at = table_points()
    shown = {name: standing("left").project(point).tolist() for name, point in at.items() if "middle" not in name}
    write_cameras(tmp_path / "first.yaml", [first])
    (tmp_path / "table.yaml").write_text(yaml.safe_dump({"cameras": {"left": shown}}))
    words = ("--table", tmp_path / "table.yaml", "--out", tmp_path / "second.yaml")
    assert status("calibrate-cameras", "--intrinsics", tmp_path / "first.yaml", *words) == 0
    (second,) = read_cameras(tmp_path / "second.yaml")
    sigmas = np.sqrt(np.diag(second.covariance))
    assert 0.0005 < sigmas[6] <= 0.01
    assert sigmas[:3].max() < 0.02
    assert sigmas[3:6].max() < 0.05
    assert np.linalg.norm(second.centre - CENTRES["left"]) < 1e-3


def test_the_same_bytes_twice(calib: Path, tmp_path: Path) -> None:
    for name in ("a", "b"):
        (tmp_path / name).mkdir()
        assert status("calibrate-cameras", *BOARD, *images(calib, "left"), "--out", tmp_path / name / "c.yaml") == 0
    for file in (tmp_path / "a").iterdir():
        assert file.read_bytes() == (tmp_path / "b" / file.name).read_bytes()


def test_bad_input_is_one_line_and_nothing_is_written(calib: Path, tmp_path: Path) -> None:
    out = ("--out", tmp_path / "c.yaml")
    table = ("--table", calib / "table.yaml")
    few = ("--images", f"left={calib / 'left' / '0[0-1].png'}")
    cases = [
        ((*BOARD, *images(calib, "left"), *table, *out), "table.yaml names camera 'right', which --images does not"),
        ((*BOARD, *few, *out), "camera 'left': at least 3 images must show the board; got 2 of 2"),
        ((*BOARD, "--images", f"left={calib / 'none'}", *out), "none: must be a folder, a pattern or a file of images"),
        ((*BOARD, "--images", "left", *out), "--images must be NAME=PLACE, as left=calib/left; got 'left'"),
        ((*BOARD[:2], "--squares", "8", *images(calib), *out), "--squares must be squares in a row x rows, as 10x7"),
        ((*BOARD[:4], *images(calib), *out), "square must be the side of a square in m, above 0; got 0"),
        ((*out,), "either --images or --intrinsics must be given, and not both"),
        ((*BOARD, *images(calib), "--out", tmp_path / "c.txt"), "out must end in .yaml, .yml, .xml, .json"),
        ((*BOARD, *images(calib), "--out", tmp_path / "no" / "c.yaml"), "out must be in an existing folder"),
        ((*BOARD, *images(calib), "--out", calib / "table.yaml"), "out must be new or a file of cameras"),
        ((*BOARD, *images(calib), "--intrinsics", "c.yaml", *table, *out), "and not both"),
        (("--intrinsics", calib / "lenses.yaml", *out), "--intrinsics must come with --table"),
        (
            (*BOARD, *images(calib), *table, "--focal-sigma", 0.05, "--out", tmp_path / "c.xml"),
            "--focal-sigma must come with --table and with an --out of .yaml",
        ),
        (("--intrinsics", calib / "lenses.yaml", *table, *out), "must be a file with cameras; there is none"),
        (
            (*BOARD, *images(calib), *table, "--view", f"top={calib / 'left' / '00.png'}", *out),
            "--view names camera 'top', which --images does not (left, right)",
        ),
    ]
    for arguments, message in cases:
        assert message in refused("calibrate-cameras", *arguments)
        assert not list(tmp_path.iterdir())
