"""What a capsule covers and what light does to faces, against closed forms."""

import numpy as np
import pytest

from ballfg.simulation.scene.backdrop import TEXTURE_DEPTH, _walls
from ballfg.simulation.scene.room import FLOOR_COLOUR, Capsule, _distance_to_segment, draw, movers
from ballfg.vision import Camera


@pytest.mark.parametrize("ends", [((12.0, 8.0), (25.0, 14.5)), ((25.0, 14.5), (12.0, 8.0)), ((20.0, 3.0), (20.0, 3.0))])
def test_distances_to_a_segment_are_to_its_nearest_point(ends: tuple[tuple[float, float], tuple[float, float]]) -> None:
    """Of all points along it; a segment that is seen end on is a point."""
    first, last = np.array(ends)
    found = _distance_to_segment((5, 2, 33, 21), np.array(ends))
    u, v = np.meshgrid(np.arange(5, 33), np.arange(2, 21))
    along = first + np.linspace(0.0, 1.0, 4001)[:, None] * (last - first)
    away = np.hypot(u[..., None] - along[:, 0], v[..., None] - along[:, 1]).min(axis=-1)
    np.testing.assert_allclose(found, away, atol=5e-3)


def test_a_capsule_covers_its_outline_where_the_room_is_not_nearer() -> None:
    """Seen from the front: two discs, and the band between them."""
    matrix = np.array([[800.0, 0.0, 99.5], [0.0, 800.0, 59.5], [0.0, 0.0, 1.0]])
    camera = Camera(
        "front", (200, 120), matrix, np.zeros(5), np.array([np.pi / 2, 0.0, 0.0]), np.array([0.0, 1.0, 4.0])
    )
    ends = np.array([[-0.2, 0.0, 1.0], [0.2, 0.0, 1.0]])
    capsule = Capsule(ends, 0.05, (200.0, 100.0, 50.0), np.zeros((2, 3)))
    image, room = np.zeros((120, 200, 3), np.float32), np.full((120, 200), 9.0, np.float32)
    room[:, :100] = 3.0  # a wall before its left half
    draw(image, room, camera, capsule, 0.001)
    covered = image.max(axis=2) > 100.0
    assert not covered[:, :100].any()
    expected = (0.2 * 2 * 0.05 + np.pi * 0.05**2 / 2) * (800.0 / 4.0) ** 2  # half of the band, and a half disc
    assert covered[:, 100:].sum() == pytest.approx(expected, rel=0.08)


def test_light_and_texture_multiply_the_colours_of_the_floor() -> None:
    points = np.array([[x, y, 0.0] for x in (0.1, 0.7) for y in (-0.3, 0.4)], dtype=np.float32)
    axis = np.full(len(points), 2)
    plain, bright = (_walls(points, axis, np.full((64, 64), grain, np.float32)) for grain in (0.0, 1.0))
    np.testing.assert_allclose(plain, np.tile(plain[0], (4, 1)))
    assert np.allclose(plain[0] / plain[0, 0], np.array(FLOOR_COLOUR) / FLOOR_COLOUR[0], rtol=1e-5)
    np.testing.assert_allclose(bright, plain * (1.0 + TEXTURE_DEPTH), rtol=1e-5)


def test_capsules_move_as_fast_as_their_velocity_says() -> None:
    for before, now, after in zip(movers(2.0), movers(2.01), movers(2.02), strict=True):
        np.testing.assert_allclose((after.ends - before.ends) / 0.02, now.velocity, atol=5e-3)
