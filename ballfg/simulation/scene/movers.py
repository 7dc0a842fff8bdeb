"""Draws other moving objects: people in white shirts who sway and swing an arm, and a gliding reflection.

All are capsules (a ball swept along a segment) in the world, so that every camera sees the same objects.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.simulation.scene.room import Colour, Rect, clipped
from ballfg.vision.camera import Camera

PEOPLE: Final = ((0.35, -3.1, 1.5, 0.0), (2.6, 3.2, -1.7, 0.4))
"""m, m, rad, s: x and y of each person, direction (from +x), delay of sway and swing. They stand at the sides, behind
the cameras of `ballfg.simulation.cameras.table_rig` or behind the table, never between."""
SWAY: Final = (0.03, 0.35)  # m and Hz
SWING: Final = (0.9, 0.8)  # rad and Hz, of the arm; the hand moves at up to 3 m/s
GLIDE: Final = (1.1, 0.23)  # m and Hz, of the reflection on the floor; up to 1.6 m/s
_SHIRT: Final[Colour] = (222.0, 224.0, 222.0)
_TROUSERS: Final[Colour] = (62.0, 46.0, 40.0)
_SKIN: Final[Colour] = (108.0, 138.0, 192.0)
_REFLECTION: Final[Colour] = (232.0, 240.0, 238.0)
_SHOULDER: Final = np.array([0.05, 0.24, 1.42])  # m, of the swinging arm: ahead, to the left, up
SHORTLY: Final = 1e-4  # s, interval for speeds: within it nothing moves by a pixel
SHORTEST: Final = 1e-6  # px^2, least squared length of a segment; a shorter one is drawn as a disc
ROUND_SHADE: Final = 0.3  # Difference in brightness between a capsule's edge and its middle


@dataclass(frozen=True, eq=False)
class Capsule:
    """A ball swept along a segment."""

    ends: Array  # (2, 3) m
    radius: float  # m
    colour: Colour  # Grey levels, blue green red
    velocity: Array  # (2, 3) m/s of the ends, for the blur of the outline


def movers(time: float) -> list[Capsule]:
    """The moving objects besides the ball, at a true time in s."""
    now, later = _places(time), _places(time + SHORTLY)
    velocities = [(after - before) / SHORTLY for (before, _, _), (after, _, _) in zip(now, later, strict=True)]
    return [Capsule(ends, radius, colour, v) for (ends, radius, colour), v in zip(now, velocities, strict=True)]


def _places(time: float) -> list[tuple[Array, float, Colour]]:
    """Ends (2, 3) m, radius m and colour of all capsules."""
    glide = GLIDE[0] * np.sin(2 * np.pi * GLIDE[1] * time)
    reflection = np.array([[1.6 + glide, -1.2, 0.01], [1.76 + glide, -1.15, 0.01]])
    people = [part for x, y, facing, late in PEOPLE for part in _person(x, y, facing, time - late)]
    return [*people, (reflection, 0.012, _REFLECTION)]


def _person(x: float, y: float, facing: float, time: float) -> list[tuple[Array, float, Colour]]:
    """The capsules of a person at x, y m; `facing` rad from +x."""
    angle = SWING[0] * np.sin(2 * np.pi * SWING[1] * time) - 0.5
    forearm = 1.3 * angle + 0.4
    elbow = _SHOULDER + 0.3 * np.array([np.cos(angle), 0.3, np.sin(angle)])
    hand = elbow + 0.3 * np.array([np.cos(forearm), 0.1, np.sin(forearm)])
    parts: list[tuple[Array, float, Colour]] = [
        (np.array([[0.0, 0.0, 0.1], [0.0, 0.0, 0.85]]), 0.13, _TROUSERS),
        (np.array([[0.0, 0.0, 1.0], [0.0, 0.0, 1.38]]), 0.2, _SHIRT),
        (np.array([[0.0, 0.0, 1.66], [0.0, 0.0, 1.74]]), 0.095, _SKIN),
        (np.array([[0.0, -0.24, 1.4], [0.02, -0.3, 1.0]]), 0.055, _SHIRT),
        (np.stack((_SHOULDER, elbow)), 0.055, _SHIRT),
        (np.stack((elbow, hand)), 0.04, _SKIN),
    ]
    sway = SWAY[0] * np.sin(2 * np.pi * SWAY[1] * time)
    c, s = np.cos(facing), np.sin(facing)
    turn = np.array([[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]])
    feet = np.array([x, y, 0.0]) + sway * turn[1]
    return [(ends @ turn + feet, radius, colour) for ends, radius, colour in parts]


def draw(
    image: NDArray[np.float32], distance: NDArray[np.float32], camera: Camera, capsule: Capsule, exposure: float
) -> Rect | None:
    """Draws a capsule where the still room is not nearer.

    Args:
        image: (h, w, 3) grey levels, changed in place.  distance: (h, w) m, of the room.
        exposure: s, for the blur of its motion.
    Returns: the changed part of the image, or None.
    """
    pixels = camera.project(capsule.ends)
    if not np.isfinite(pixels).all():
        return None
    away = float(np.linalg.norm(capsule.ends.mean(axis=0) - camera.centre))
    radius = camera.matrix[0, 0] * capsule.radius / away
    smear = 1.0 + camera.matrix[0, 0] * exposure / away * float(np.linalg.norm(capsule.velocity, axis=1).max())
    rect = clipped(camera, pixels, radius + smear)
    if rect is None:
        return None
    left, top, right, bottom = rect
    off = _distance_to_segment(rect, pixels)
    cover = np.clip(0.5 + (radius - off) / np.float32(smear), 0.0, 1.0)
    cover *= distance[top:bottom, left:right] > away
    shade = 1 - np.float32(ROUND_SHADE) * np.minimum(off / np.float32(radius), 1.0) ** 2
    part = image[top:bottom, left:right]
    part += cover[..., None] * (shade[..., None] * np.array(capsule.colour, dtype=np.float32) - part)
    return rect


def _distance_to_segment(rect: Rect, ends: Array) -> NDArray[np.float32]:
    """(h, w) px from the pixels of a part of the image to the segment between two pixels (2, 2)."""
    left, top, right, bottom = rect
    u = np.arange(left, right, dtype=np.float32)[None, :] - np.float32(ends[0, 0])
    v = np.arange(top, bottom, dtype=np.float32)[:, None] - np.float32(ends[0, 1])
    du, dv = (ends[1] - ends[0]).astype(np.float32)
    length = max(float(du * du + dv * dv), SHORTEST)
    along = np.clip((u * du + v * dv) / np.float32(length), 0.0, 1.0)
    return np.asarray(np.hypot(u - along * du, v - along * dv), dtype=np.float32)
