"""Cameras in files: what is written reads back bit for bit, foreign files are understood, bad ones are named."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.vision import Camera
from ballfg.vision.camera_file import read_cameras, write_cameras, write_opencv


def camera(name: str, count: int = 5) -> Camera:
    rng = np.random.default_rng(count)
    matrix = [[1000 / 3, 0, 640.1], [0, 1e3 + 1e-10, 360.7], [0, 0, 1]]
    return Camera(
        name, (1280, 720), matrix, rng.normal(0, 1e-7, count), rng.normal(size=3), rng.normal(size=3), 1e-5 / 3
    )


RIG = [camera("left"), replace(camera("right", 0), readout=-0.012), camera("top-2", 14)]


def same(one: Camera, other: Camera) -> bool:
    return (one.name, one.size, one.time_offset) == (other.name, other.size, other.time_offset) and all(
        np.array_equal(getattr(one, field), getattr(other, field))
        for field in ("matrix", "distortion", "rvec", "tvec", "readout")
    )


@pytest.mark.parametrize(
    ("write", "name"),
    [(write_cameras, "a.yaml"), (write_cameras, "a.yml")]
    + [(write_opencv, f"a.{ending}") for ending in ("yaml", "yml", "xml", "json")],
)
def test_what_is_written_reads_back_bit_for_bit(tmp_path: Path, write: Callable[..., None], name: str) -> None:
    write(tmp_path / name, RIG)
    back = read_cameras(tmp_path / name)
    assert len(back) == 3
    assert all(same(one, other) for one, other in zip(back, RIG, strict=True))
    assert [path.name for path in tmp_path.iterdir()] == [name]


def test_a_covariance_reads_back_and_opencv_has_no_place_for_it(tmp_path: Path) -> None:
    root = np.tril(np.random.default_rng(0).uniform(0.1, 1.0, (7, 7)))
    loose = replace(camera("left"), covariance=root @ root.T)
    write_cameras(tmp_path / "a.yaml", [loose])
    np.testing.assert_array_equal(read_cameras(tmp_path / "a.yaml")[0].covariance, loose.covariance)
    with pytest.raises(ValueError, match="cameras must be exact in OpenCV's files; 'left' has a covariance"):
        write_opencv(tmp_path / "a.xml", [loose])


def test_the_file_is_as_documented(tmp_path: Path) -> None:
    plain = Camera("left", (1280, 720), [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], [], [0, 0, 0], [0, 0, 3])
    write_cameras(tmp_path / "c.yaml", [plain])
    assert (tmp_path / "c.yaml").read_text() == (
        "cameras:\n  left:\n    size: [1280, 720]\n"
        "    matrix:\n    - [1000.0, 0.0, 640.0]\n    - [0.0, 1000.0, 360.0]\n    - [0.0, 0.0, 1.0]\n"
        "    distortion: []\n    rvec: [0.0, 0.0, 0.0]\n    tvec: [0.0, 0.0, 3.0]\n    time_offset: 0.0\n"
    )


@pytest.mark.parametrize("write", [write_cameras, write_opencv])
def test_without_a_place_only_the_lens_is_there(tmp_path: Path, write: Callable[..., None]) -> None:
    write(tmp_path / "c.yaml", RIG, posed=False)
    with pytest.raises(ValueError, match=r"c.yaml: camera 'left': field 'rvec' is required; .*--table"):
        read_cameras(tmp_path / "c.yaml")
    back = read_cameras(tmp_path / "c.yaml", posed=False)
    unposed = [replace(one, rvec=np.zeros(3), tvec=np.zeros(3)) for one in RIG]
    assert all(same(one, other) for one, other in zip(back, unposed, strict=True))


@pytest.mark.parametrize("ending", ["yml", "xml", "json"])
@pytest.mark.parametrize("coefficients", ["distortion_coefficients", "dist_coeffs"])
def test_a_file_of_one_camera_as_opencvs_samples_write_it(tmp_path: Path, ending: str, coefficients: str) -> None:
    file = tmp_path / f"right.{ending}"
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    storage.write("calibration_time", "today")
    storage.write("image_width", 1280)
    storage.write("image_height", 720)
    storage.write("camera_matrix", RIG[0].matrix)
    storage.write(coefficients, RIG[0].distortion[:, None])
    storage.write("rvec", RIG[0].rvec)
    storage.write("tvec", RIG[0].tvec[None])
    storage.release()
    (back,) = read_cameras(file)
    assert same(back, replace(RIG[0], name="right", time_offset=0.0))


def test_lists_and_an_image_size_in_old_opencv_yaml(tmp_path: Path) -> None:
    file = tmp_path / "rig.yaml"
    file.write_text(
        "%YAML:1.0\n---\ncount: 1\nleft:\n   image_size: [ 1280, 720 ]\n   camera_matrix: !!opencv-matrix\n"
        "      rows: 3\n      cols: 3\n      dt: f\n      data: [ 1000., 0., 640., 0., 1000., 360., 0., 0., 1. ]\n"
        "   dist_coeffs: [ 0.1, 0.2, 0., 0. ]\n   rvec: [ 1., 2., 3. ]\n   tvec: [ 0, 0, 3 ]\n   time_offset: 0.004\n"
    )
    (back,) = read_cameras(file)
    matrix = [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]]
    assert same(back, Camera("left", (1280, 720), matrix, [0.1, 0.2, 0, 0], [1, 2, 3], [0, 0, 3], 0.004))


GOOD = "size: [1280, 720], matrix: [[1000, 0, 640], [0, 1000, 360], [0, 0, 1]], distortion: [], "


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the content must be a mapping; got nothing"),
        ("cameras: [left]", "cameras must be a mapping; got list"),
        ("cameras: {}", "cameras must be a mapping; got an empty one"),
        ("rig: {}", "fields must be among cameras; got 'rig'"),
        ("cameras: {left: 3}", "camera 'left' must be a mapping; got int"),
        ("cameras: {left: {matrx: 1}}", r"camera 'left': fields must be among .*got 'matrx'\. Did you mean 'matrix'\?"),
        ("cameras: {left: {size: [2, 2]}}", "camera 'left': field 'matrix' is required; got size"),
        ("cameras: {left: {" + GOOD + "tvec: [0, 0, 1]}}", "camera 'left': field 'rvec' is required"),
        ("cameras: {left: {" + GOOD + "rvec: [0, 0], tvec: [0, 0, 1]}}", "camera 'left': rvec must have shape"),
        ("cameras: {left: {" + GOOD + "rvec: [0, 0, .nan], tvec: [0, 0, 1]}}", "camera 'left': rvec must be finite"),
        (
            "cameras: {left: {" + GOOD.replace("1280", "a") + "rvec: [0, 0, 0], tvec: [0, 0, 1]}}",
            "size must be width and",
        ),
        (
            "cameras: {left: {" + GOOD + "rvec: [0, 0, 0], tvec: [0, 0, 1], time_offset: 4ms}}",
            "time_offset must be a number",
        ),
        (
            "cameras: {left: {" + GOOD + "rvec: [0, 0, 0], tvec: [0, 0, 1], readout: 16 ms}}",
            "readout must be a number",
        ),
        (
            "cameras: {left: {" + GOOD.replace("[]", "[1]") + "rvec: [0, 0, 0], tvec: [0, 0, 1]}}",
            "distortion must have one of",
        ),
        (
            "cameras: {left: {" + GOOD + "rvec: [0, 0, 0], tvec: [120, -300, 3100]}}",
            "camera 'left': tvec must be in m, at most 1000 m long; got 3117. It is probably in mm",
        ),
        ("cameras: {left: {size: 1}, left: {size: 2}}", "'left' stands twice"),
        ("cameras: {left: {", "not readable as YAML"),
        ("%YAML:1.0\n---\nfoo: [1, 2\nbar: }", "must be a file of OpenCV's FileStorage; it cannot be parsed"),
        ("%YAML:1.0\n---\nfoo: 1\n", "node 'camera_matrix' is required; got foo"),
        ("%YAML:1.0\n---\ncamera_matrix: 3\nimage_size: [1, 2]\n", "node 'camera_matrix' must be a matrix or a list"),
        (
            "%YAML:1.0\n---\ncamera_matrix: 3\n",
            "nodes 'image_width' and 'image_height' are required; got camera_matrix",
        ),
        (
            "%YAML:1.0\n---\ncamera_matrix: 3\nfisheye_model: 1\nimage_size: [1, 2]\n",
            "node 'fisheye_model' must be one of 0, false; got '1'. Its coefficients mean something else",
        ),
        (
            "%YAML:1.0\n---\ncamera_matrix: 3\ndistortion_model: equidistant\nimage_size: [1, 2]\n",
            "node 'distortion_model' must be one of plumb_bob, rational_polynomial; got 'equidistant'",
        ),
        ("%YAML:1.0\n---\ncamera_matrix: 3\nimage_size: [1.5, 2.]\n", "image's size must be two whole numbers"),
    ],
)
def test_files_that_break_a_rule(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "c.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_cameras(file)
    assert str(caught.value).startswith(str(file))


def test_a_file_that_denies_a_fisheye_is_read(tmp_path: Path) -> None:
    """OpenCV's sample writes the node always."""
    file = tmp_path / "left.xml"
    write_opencv(file, [camera("left")])
    text = file.read_text().replace("<image_width>", "<fisheye_model>0</fisheye_model><image_width>")
    file.write_text(text)
    assert "fisheye" in text
    np.testing.assert_array_equal(read_cameras(file)[0].distortion, camera("left").distortion)


def test_names_are_text_as_they_are_written(tmp_path: Path) -> None:
    (tmp_path / "c.yaml").write_text("cameras: {01: {" + GOOD + "rvec: [0, 0, 0], tvec: [0, 0, 1]}}")
    assert [camera.name for camera in read_cameras(tmp_path / "c.yaml")] == ["01"]


def test_a_file_that_is_not_there(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"c.yaml: must be a file with cameras; there is none"):
        read_cameras(tmp_path / "c.yaml")


@pytest.mark.parametrize(
    ("write", "name", "cameras", "message"),
    [
        (write_cameras, "c.yaml", [], "at least one camera; got none"),
        (write_cameras, "c.yaml", [RIG[0], RIG[0]], "names of their own; got 'left' 2 times"),
        (write_cameras, "c.txt", RIG, "path must end in .yaml"),
        (write_opencv, "c.txt", RIG, "path must end in .xml, .json"),
        (write_opencv, "c.xml", [replace(RIG[0], name="cam 1")], "letters, digits, - and _, .* got 'cam 1'"),
    ],
)
def test_what_is_not_written(
    tmp_path: Path, write: Callable[..., None], name: str, cameras: list, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        write(tmp_path / name, cameras)
    assert not list(tmp_path.iterdir())


def test_a_file_that_fails_half_way_leaves_the_old_one(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "c.yaml"
    write_cameras(file, RIG[:1])
    before = file.read_bytes()

    def fail(*_: object) -> None:
        raise OSError("disk full")

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(OSError, match="disk full"):
        write_cameras(file, RIG)
    assert file.read_bytes() == before
    assert len(list(tmp_path.iterdir())) == 1
    with pytest.raises(FileNotFoundError, match="out must be in an existing folder"):
        write_cameras(tmp_path / "nowhere" / "c.yaml", RIG)
