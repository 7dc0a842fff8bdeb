"""The image of the ball: its outline and its centre, against a polygon of the outline drawn large, and its motion."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from ballfg.simulation.cameras import table_rig
from ballfg.simulation.scene.renderer import SHADING, BallImage, ball_image
from ballfg.vision.camera import Camera

RADIUS = 0.02
FINER = 16
"""Pixels of the large drawing along a pixel."""
PLACES = ([1.37, 0.0, 0.9], [0.3, -0.6, 1.4], [2.6, 0.5, 0.85], [0.02, 0.1, 1.6])


def still(point: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.tile(point, (3, 1))


def moving(point: NDArray[np.float64], velocity: NDArray[np.float64], exposure: float) -> NDArray[np.float64]:
    return point + exposure * np.linspace(-0.5, 0.5, 17)[:, None] * velocity


def drawn(camera: Camera, path: NDArray[np.float64]) -> BallImage:
    image = ball_image(camera, path, RADIUS)
    assert image is not None
    return image


def centroid(image: BallImage, weight: NDArray[np.float64]) -> NDArray[np.float64]:
    left, top, right, bottom = image.rect
    u, v = np.meshgrid(np.arange(left, right), np.arange(top, bottom))
    return np.array([(u * weight).sum(), (v * weight).sum()]) / weight.sum()


def polygon_cover(camera: Camera, point: NDArray[np.float64], image: BallImage) -> NDArray[np.float64]:
    """Cover from the outline's own points: the circle in which the rays from the camera touch the sphere."""
    axis = camera.centre - point
    distance = np.linalg.norm(axis)
    axis = axis / distance
    first = np.linalg.svd(axis[None])[2][1]
    angle = np.linspace(0, 2 * np.pi, 400, endpoint=False)[:, None]
    around = np.cos(angle) * first + np.sin(angle) * np.cross(axis, first)
    circle = point + RADIUS**2 / distance * axis + RADIUS * np.sqrt(1 - (RADIUS / distance) ** 2) * around
    left, top, right, bottom = image.rect
    corners = (camera.project(circle) - (left, top) + 0.5) * FINER - 0.5
    large = np.zeros(((bottom - top) * FINER, (right - left) * FINER), dtype=np.uint8)
    cv2.fillPoly(large, [np.round(corners * 256).astype(np.int32)[:, None]], 255, shift=8)
    return cv2.resize(large, None, fx=1 / FINER, fy=1 / FINER, interpolation=cv2.INTER_AREA) / 255


@pytest.mark.parametrize("camera", table_rig(), ids=lambda camera: camera.name)
@pytest.mark.parametrize("place", PLACES)
def test_outline_is_that_of_a_sphere(camera: Camera, place: list[float]) -> None:
    point = np.array(place)
    image = drawn(camera, still(point))
    expected = polygon_cover(camera, point, image)
    # the large drawing includes the pixels on its edge: it is up to half of its own pixel too big all around
    edge = np.pi * 2 * np.sqrt(expected.sum() / np.pi) / FINER
    assert -0.1 * edge < expected.sum() - image.cover.sum() < 0.8 * edge
    np.testing.assert_allclose(image.cover, expected, atol=0.11)
    np.testing.assert_allclose(centroid(image, image.cover), centroid(image, expected), atol=0.02)


@pytest.mark.parametrize("camera", table_rig(), ids=lambda camera: camera.name)
@pytest.mark.parametrize(("speed", "exposure"), [(0.0, 0.002), (1.0, 0.005), (5.0, 0.002), (5.0, 0.005), (15.0, 0.002)])
def test_centroid_is_the_centre_in_the_middle_of_the_exposure(camera: Camera, speed: float, exposure: float) -> None:
    rng = np.random.default_rng(int(speed))
    for place in PLACES[:3]:
        direction = rng.standard_normal(3)
        point = np.array(place) + 0.01 * rng.standard_normal(3)
        image = drawn(camera, moving(point, speed * direction / np.linalg.norm(direction), exposure))
        off = centroid(image, image.cover) - camera.project(point)
        assert np.linalg.norm(off) < 0.05  # of it up to 0.03 is perspective: the outline's middle is not the centre


def test_blur_keeps_the_light_and_has_the_length_of_the_way() -> None:
    camera = table_rig()[0]
    point = np.array(PLACES[0])
    across = camera.rotation[0] * 10.0
    fast, slow = drawn(camera, moving(point, across, 0.004)), drawn(camera, still(point))
    assert fast.cover.sum() == pytest.approx(slow.cover.sum(), rel=1e-3)
    ends = camera.project(moving(point, across, 0.004)[[0, -1]])
    u = np.arange(fast.rect[0], fast.rect[2])
    spread = np.sqrt((fast.cover.sum(axis=0) * (u - ends[:, 0].mean()) ** 2).sum() / fast.cover.sum())
    length = np.linalg.norm(ends[1] - ends[0])
    radius = np.sqrt(slow.cover.sum() / np.pi)
    assert spread == pytest.approx(np.sqrt(length**2 / 12 + radius**2 / 4), rel=0.01)  # of a uniform and of a disc
    assert length > 2 * radius - 0.5


def test_a_bounce_within_the_exposure_bends_the_streak() -> None:
    camera = table_rig()[0]
    point = np.array([1.37, 0.0, 0.78])
    time = np.linspace(-0.5, 0.5, 17)[:, None]
    path = point + 0.005 * (np.abs(time) * [0.0, 0.0, 4.0] + time * [4.0, 0.0, 0.0])
    bent, straight = drawn(camera, path), drawn(camera, moving(point, np.array([4.0, 0.0, 0.0]), 0.005))
    rise = camera.project(point + np.array([0.0, 0.0, 0.005])) - camera.project(
        point
    )  # 4 m/s, the mean of |time| is 1/4
    np.testing.assert_allclose(centroid(bent, bent.cover) - centroid(straight, straight.cover), rise, atol=0.05)


def test_light_is_shaded_mildly() -> None:
    camera = table_rig()[1]
    image = drawn(camera, still(np.array(PLACES[0])))
    inner = image.cover > 0.99
    shade = image.light[inner] / image.cover[inner]
    assert 1 - 2 * SHADING <= shade.min() < shade.max() <= 1.0
    assert centroid(image, image.light)[1] < centroid(image, image.cover)[1]  # the lamp is above


def test_what_the_lens_cannot_show_is_not_drawn() -> None:
    camera = table_rig()[0]
    beside = camera.centre + camera.rotation[2] + 4.0 * camera.rotation[0]
    assert camera.in_view(beside) or np.isfinite(camera.project(beside)).all()  # the polynomial has an answer
    assert ball_image(camera, still(beside), RADIUS) is None
    assert ball_image(camera, still(camera.centre - camera.rotation[2]), RADIUS) is None
    aside = camera.centre + camera.rotation[2] + 0.9 * camera.rotation[0]
    assert ball_image(camera, still(aside), RADIUS) is None


def test_a_ball_at_the_edge_is_cut() -> None:
    camera = table_rig()[0]
    ray = camera.rays([-2.0, 300.0])
    image = drawn(camera, still(camera.centre + 3.0 * ray))
    assert image.rect[0] == 0
    whole = drawn(camera, still(camera.centre + 3.0 * camera.rays([20.0, 300.0])))
    assert 0.2 < image.cover.sum() / whole.cover.sum() < 0.5
