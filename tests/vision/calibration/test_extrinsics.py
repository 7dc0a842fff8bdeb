"""Where cameras stand, from the table: planted poses, covariances against scatter, what cannot be told."""

from __future__ import annotations

from dataclasses import replace
from itertools import permutations
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.vision import Camera
from ballfg.vision.calibration.extrinsics import Extrinsics, calibrate_extrinsics
from ballfg.vision.calibration.table_points import Marked, read_table, table_outline, table_points
from tests.vision.filming import looking

AT = table_points()
CORNERS = ("near_left", "near_right", "far_left", "far_right")


def standing(centre: tuple[float, float, float], target: tuple[float, float, float] = (1.37, 0.0, 0.76)) -> Camera:
    return looking("left", centre, target, matrix=[[800.0, 0, 640], [0, 805, 360], [0, 0, 1]])


PLACES = [(-1.5, 2.2, 2.1), (1.37, -3.0, 1.9), (4.4, 1.5, 1.4), (1.3, 0.1, 4.0)]


def marked(camera: Camera, names: tuple[str, ...] = CORNERS, sigma: float = 0.5) -> Marked:
    points = np.stack([AT[name] for name in names])
    return Marked(names, points, camera.project(points), sigma)


def turned(one: Camera, other: Camera) -> np.ndarray:
    """(3,) rad about the world's axes."""
    return cv2.Rodrigues(one.rotation.T @ other.rotation)[0].ravel()


def shaken(seen: Marked, rng: np.random.Generator) -> Marked:
    return replace(seen, pixels=seen.pixels + rng.normal(0, seen.sigma, seen.pixels.shape))


@pytest.mark.parametrize("place", PLACES)
def test_a_planted_pose_comes_back(place: tuple[float, float, float]) -> None:
    camera = standing(place)
    lens = replace(camera, rvec=np.zeros(3), tvec=np.zeros(3))
    for names in (CORNERS, tuple(AT)):
        found = calibrate_extrinsics(lens, marked(camera, names))
        np.testing.assert_allclose(found.camera.centre, place, atol=1e-6)
        np.testing.assert_allclose(turned(camera, found.camera), 0.0, atol=1e-6)
        assert found.rms < 1e-4


@pytest.mark.parametrize("place", [(-6, 0, 2), (8.74, 0, 2), (7, 3, 2.5), (-25, 0, 6), (1.37, 5, 2), (1.37, -5, 2)])
def test_the_order_of_points_is_free(place: tuple[float, float, float]) -> None:
    """All orders of four corners and some of six points, exact, from places that look along the table or across it."""
    camera, rng = standing(place), np.random.default_rng(0)
    six = tuple(name for name in AT if "middle" not in name)
    orders = [*permutations(CORNERS), six, six[::-1], *(tuple(rng.permutation(six)) for _ in range(10))]
    for names in orders:
        found = calibrate_extrinsics(camera, marked(camera, names))
        np.testing.assert_allclose(found.camera.centre, place, atol=1e-5)
        assert found.rms < 1e-4


@pytest.mark.parametrize("place", [(7, 3, 2.5), (8.74, 0, 2)])
def test_a_wrong_point_is_named_in_any_order(place: tuple[float, float, float]) -> None:
    camera = standing(place)
    for names in (tuple(AT), tuple(sorted(AT)), tuple(AT)[::-1]):
        seen = marked(camera, names)
        seen.pixels[names.index("net_left")] += (60, -20)
        with pytest.raises(ValueError, match=r"Without 'net_left' the others agree\."):
            calibrate_extrinsics(camera, seen)


@pytest.mark.parametrize("place", PLACES[:3])
def test_millimetres_and_tenths_of_a_degree_from_the_tables_points(place: tuple[float, float, float]) -> None:
    """Nine points to 0.3 px."""
    camera = standing(place)
    found = calibrate_extrinsics(camera, shaken(marked(camera, tuple(AT), 0.3), np.random.default_rng(0)))
    assert np.linalg.norm(found.camera.centre - place) < 0.01
    assert np.degrees(np.linalg.norm(turned(camera, found.camera))) < 0.1


@pytest.mark.parametrize("names", [CORNERS, tuple(AT)], ids=["corners", "all"])
def test_covariance_is_the_scatter(names: tuple[str, ...]) -> None:
    """Mean square of the whitened error is 6 for 6 unknowns; of 200 it scatters by 0.25."""
    camera = standing(PLACES[0])
    rng = np.random.default_rng(0)
    squares = []
    for _ in range(200):
        found = calibrate_extrinsics(camera, shaken(marked(camera, names), rng))
        error = np.concatenate((-turned(camera, found.camera), found.camera.centre - camera.centre))
        squares.append(error @ np.linalg.solve(found.covariance, error))
    assert 5.0 < np.mean(squares) < 7.0


def test_sigmas_are_those_of_the_worst_axes() -> None:
    camera = standing(PLACES[0])
    found = Extrinsics(camera, marked(camera), np.diag([1, 4, 9, 16, 36, 25]) * 1e-6)
    assert found.turn_sigma == pytest.approx(3e-3)
    assert found.centre_sigma == pytest.approx(6e-3)


def test_points_out_of_the_tables_plane() -> None:
    camera = standing(PLACES[1])
    points = np.array([*(AT[name] for name in CORNERS), [1.37, 0.915, 0.9125], [0.0, 0.3, 0.0], [2.0, 0.2, 1.5]])
    seen = Marked(tuple("abcdefg"), points, camera.project(points))
    found = calibrate_extrinsics(camera, seen)
    np.testing.assert_allclose(found.camera.centre, camera.centre, atol=1e-6)


def test_left_and_right_swapped_is_noticed() -> None:
    seen = marked(standing(PLACES[0]))
    mirrored = replace(seen, points=seen.points * (1, -1, 1))
    with pytest.raises(ValueError, match=r"camera 'left': points .* (as if seen from below|explained)"):
        calibrate_extrinsics(standing(PLACES[0]), mirrored)


def test_a_point_with_a_wrong_pixel_is_named() -> None:
    camera = standing(PLACES[0])
    seen = marked(camera, tuple(AT))
    pixels = seen.pixels.copy()
    pixels[seen.names.index("far_left")] += (60, -20)
    with pytest.raises(ValueError, match=r"explained within 2 px; got .*\. Without 'far_left' the others agree\."):
        calibrate_extrinsics(camera, replace(seen, pixels=pixels))


def test_two_poses_that_explain_alike_are_refused() -> None:
    """A small square far away looks the same tilted to either side."""
    camera = standing((0.0, -6.0, 3.0), (0.0, 0.0, 0.76))
    points = np.array([[0, 0, 0.76], [0.1, 0, 0.76], [0.1, 0.1, 0.76], [0, 0.1, 0.76]])
    seen = Marked(tuple("abcd"), points, camera.project(points), 1.0)
    with pytest.raises(ValueError, match="points must tell one pose; two explain them alike"):
        calibrate_extrinsics(camera, seen)


@pytest.mark.parametrize(
    ("names", "message"),
    [
        (CORNERS[:3], r"at least 4 points must be marked; got 3 \(near_left, near_right, far_left\)"),
        (("near_left", "net_left", "far_left", "near_left"), "points must not lie in one line"),
    ],
)
def test_points_that_cannot_tell(names: tuple[str, ...], message: str) -> None:
    camera = standing(PLACES[1])
    with pytest.raises(ValueError, match=message):
        calibrate_extrinsics(camera, marked(camera, names))


def test_pixels_outside_the_image() -> None:
    camera = standing(PLACES[0])
    small = replace(camera, size=(640, 360))
    with pytest.raises(ValueError, match=r"pixels must lie in the image of 640x360; near_right is at "):
        calibrate_extrinsics(small, marked(camera, ("near_right", "far_left", "far_right", "near_left")))


def test_the_tables_points_are_where_the_rules_put_them() -> None:
    at = table_points(0.0)
    assert np.linalg.norm(at["near_left"] - at["far_left"]) == pytest.approx(2.74)
    assert np.linalg.norm(at["near_left"] - at["near_right"]) == pytest.approx(1.525)
    np.testing.assert_allclose(at["near_left"], [0, 0.7625, 0])
    assert len(table_outline(0.0)) == 6
    assert sum(np.linalg.norm(line[1] - line[0]) for line in table_outline(0.0)[:4]) == pytest.approx(2 * 4.265)


def test_table_file(tmp_path: Path) -> None:
    file = tmp_path / "table.yaml"
    file.write_text(
        "table_height: 0.0\nsigma: 1\npoints: {post: [1.37, 0.915, 0.1525]}\n"
        "cameras:\n  left: {near_left: [10.5, 20], post: [30, 40]}\n"
    )
    content = read_table(file)
    assert content.table_height == 0.0
    left = content.cameras["left"]
    assert (left.names, left.sigma) == (("near_left", "post"), 1.0)
    np.testing.assert_array_equal(left.points, [[0, 0.7625, 0], [1.37, 0.915, 0.1525]])
    np.testing.assert_array_equal(left.pixels, [[10.5, 20], [30, 40]])


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the content must be a mapping; got nothing"),
        ("camera: {left: {}}", r"fields must be among .*; got 'camera'\. Did you mean 'cameras'\?"),
        ("table_height: 1", "field 'cameras' is required; got table_height"),
        (
            "cameras: {left: {near_lft: [1, 2]}}",
            r"camera 'left': points must be .* got 'near_lft'\. Did you mean 'near_left'",
        ),
        ("cameras: {left: {near_left: [1]}}", r"camera 'left': near_left must be 2 numbers, where it is seen, in px"),
        ("cameras: {left: {near_left: [1, x]}}", r"near_left must be a finite number; got 'x'"),
        ("cameras: {left: {a: [1, 2]}}\npoints: {a: [1, 2]}", r"point 'a' must be 3 numbers, its x, y, z in m"),
        ("cameras: {left: {}}", "camera 'left' must be a mapping; got an empty one"),
        ("sigma: 0\ncameras: {left: {near_left: [1, 2]}}", "sigma must be above 0 px; got 0"),
        ("table_height: 760\ncameras: {left: {near_left: [1, 2]}}", "table_height must be in m, at most 50; got 760"),
        ("cameras: {left: {net_left: [1, 2], net_left: [3, 4]}}", "'net_left' stands twice"),
    ],
)
def test_table_files_that_break_a_rule(tmp_path: Path, text: str, message: str) -> None:
    file = tmp_path / "table.yaml"
    file.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        read_table(file)
    assert str(caught.value).startswith(str(file))
