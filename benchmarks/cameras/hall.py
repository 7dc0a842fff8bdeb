"""Draws pictures of a table in a hall from a camera that pans and zooms: projected polygons."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.court import Court, table_tennis
from ballfg.vision.broadcast.lines import moved
from ballfg.vision.broadcast.pinhole import Pinhole

SIZE: Final = (960, 540)
"""px, of all pictures."""
COURT: Final = table_tennis()
FINE: Final = 4
"""Bits of a drawn coordinate below a pixel."""


def looking(place: Sequence[float], at: Sequence[float], focal: float, bend: float = 0.0) -> Pinhole:
    """A camera at a place (m) that looks at a point (m), upright."""
    forward = np.subtract(at, place)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return Pinhole(np.stack((right, np.cross(forward, right), forward)), np.array(place), focal, SIZE, bend)


def panned(camera: Pinhole, count: int, turn: float, zoom: float) -> list[Pinhole]:
    """Cameras that turn to the right by `turn` rad in all and grow their focal length by a factor exp(zoom)."""
    shares = np.linspace(0.0, 1.0, count)
    return [moved(camera, np.array([0.0, turn * s, 0.0, 0.0, 0.0, 0.0, zoom * s])) for s in shares]


def picture(
    camera: Pinhole,
    rng: np.random.Generator,
    balls: Sequence[Array] = (),
    others: Sequence[tuple[Array, float]] = (),
    court: Court = COURT,
) -> Image:
    """A blue table with white lines and a net, on a dark floor with marks; balls (2, 3) m, ends of their bars.

    Args: others: polygons (n, 3) m and their grey levels, of what stands before or behind the table.
    """
    image = np.full((SIZE[1], SIZE[0], 3), (60, 50, 48), dtype=np.uint8)
    marks = np.random.default_rng(5)
    for _ in range(150):
        x, y = marks.uniform((-9.0, -7.0), (9.0, 12.0))
        level = marks.uniform(70, 170)
        corners = np.array([[x, y], [x + 0.5, y], [x + 0.4, y + 0.3], [x, y + 0.3]]) + marks.uniform(-0.1, 0.1, (4, 2))
        _filled(image, camera, np.column_stack((corners, np.full(4, -0.76))), (level, level, level))
    far = float(np.linalg.norm(camera.place))
    for shown, level in others:
        if np.linalg.norm(shown.mean(axis=0) - camera.place) > far:
            _filled(image, camera, shown, (level, level, level))
    _filled(image, camera, court.corners, (150, 80, 30))
    for first, second in court.lines:
        along = (second - first) / np.linalg.norm(second - first)
        across = np.array([-along[1], along[0], 0.0]) * 0.01
        if first[2] > 0.0:
            across = np.array([0.0, 0.0, 0.008])
            low = np.array([0.0, 0.0, first[2]])
            _filled(image, camera, np.array([first, second, second - low, first - low]), (70, 60, 40))
        ends = np.array([first - across, second - across, second + across, first + across])
        _filled(image, camera, ends, (240, 240, 240))
    for ball in balls:
        ends = camera.project(ball)
        depth = ((ball.mean(axis=0) - camera.place) @ camera.turn.T)[2]
        radius = 0.02 * camera.focal / depth
        start, end = (tuple(int(v) for v in np.round(one * 2**FINE)) for one in ends)
        cv2.line(image, start, end, (235, 240, 240), max(1, round(2 * radius)), cv2.LINE_AA, FINE)
    for shown, level in others:
        if np.linalg.norm(shown.mean(axis=0) - camera.place) <= far:
            _filled(image, camera, shown, (level, level, level))
    noisy = cv2.GaussianBlur(image, (3, 3), 0.7).astype(np.float32) + rng.normal(0.0, 2.0, image.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def _filled(image: Image, camera: Pinhole, corners: Array, colour: tuple[float, float, float]) -> None:
    pixels = camera.project(_dense(corners))
    if np.isfinite(pixels).all() and np.abs(pixels).max() < 1e4:
        cv2.fillPoly(image, [np.round(pixels * 2**FINE).astype(np.int32)], colour, cv2.LINE_AA, FINE)


def _dense(corners: Array) -> Array:
    """Points along the border of a polygon: a distorted edge is no line."""
    shares = np.linspace(0.0, 1.0, 12, endpoint=False)[:, None]
    ends = np.roll(corners, -1, axis=0)
    return np.concatenate([a + shares * (b - a) for a, b in zip(corners, ends, strict=True)])
