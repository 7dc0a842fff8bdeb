"""Drawn polygons and bars: their middle, width and area in a picture against geometry."""

import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import SIZE, _barred, _filled, looking
from ballfg.vision.broadcast.pinhole import Pinhole

FLOOR, COLOUR = 20.0, 220.0
ABOVE = looking((0.0, -0.01, 10.0), (0.0, 0.0, 0.0), 1000.0)


def shares(camera: Pinhole, corners: np.ndarray) -> np.ndarray:
    """(h, w), how much of each pixel a polygon (n, 3) m covers."""
    image = np.full((SIZE[1], SIZE[0], 3), FLOOR, dtype=np.uint8)
    _filled(image, camera, corners, (COLOUR, COLOUR, COLOUR))
    return (image[..., 1] - FLOOR) / (COLOUR - FLOOR)


@pytest.mark.parametrize("degrees", [3.0, 20.0, 40.0, 87.0])
@pytest.mark.parametrize("width", [0.6, 2.4])
def test_a_line_lies_where_it_is_projected_and_is_as_wide(degrees, width):
    rng, angle = np.random.default_rng(1), np.radians(degrees)
    along, across = np.array([np.cos(angle), np.sin(angle), 0.0]), np.array([-np.sin(angle), np.cos(angle), 0.0])
    for turned in (1, -1):
        middle, half = np.append(rng.uniform(-0.005, 0.005, 2), 0.0), 0.005 * width * across
        line = [middle - along - half, middle + along - half, middle + along + half, middle - along + half]
        seen = shares(ABOVE, np.array(line)[::turned])
        v, u = np.mgrid[: SIZE[1], : SIZE[0]]
        ends = ABOVE.project(np.stack((middle - along, middle + along)))
        way = (ends[1] - ends[0]) / np.linalg.norm(ends[1] - ends[0])
        off = np.stack((u, v), axis=2) - ends.mean(axis=0)
        inner = np.where(np.abs(off @ way) < 60.0, seen, 0.0)
        assert abs((inner * (off @ [-way[1], way[0]])).sum() / inner.sum()) < 0.02
        assert seen.sum() == pytest.approx(width * 200.0, rel=0.03)


def test_a_line_that_a_lens_bends_follows_it():
    bent = looking((0.0, -0.01, 10.0), (0.0, 0.0, 0.0), 1000.0, 0.3)
    seen = shares(bent, np.array([[-3.0, 1.99, 0.0], [3.0, 1.99, 0.0], [3.0, 2.01, 0.0], [-3.0, 2.01, 0.0]]))
    for x in np.linspace(-2.8, 2.8, 9):
        u, v = bent.project(np.array([[x, 2.0, 0.0]]))[0]
        column = seen[:, round(u)]
        assert (column * np.arange(SIZE[1])).sum() / column.sum() == pytest.approx(v, abs=0.15)


def test_a_bar_has_the_area_of_a_rectangle_and_two_half_circles():
    image = np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)
    ends, radius = np.array([[100.3, 50.2], [117.1, 61.8]]), 2.3
    _barred(image, ends, radius, (COLOUR, COLOUR, COLOUR))
    area = np.pi * radius**2 + 2.0 * radius * np.linalg.norm(ends[1] - ends[0])
    share = image[..., 1] / COLOUR
    assert share.sum() == pytest.approx(area, rel=0.02)
    v, u = np.mgrid[: SIZE[1], : SIZE[0]]
    middle = [(share * u).sum() / share.sum(), (share * v).sum() / share.sum()]
    np.testing.assert_allclose(middle, ends.mean(axis=0), atol=0.02)
