"""Describes the room of a recording, its boxes and its table, and draws what else moves in it.

People in white shirts sway and swing an arm, and a reflection glides. All are capsules (balls swept along segments),
the same in every camera.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.simulation.balls import BallKind
from ballfg.vision.camera import Camera

Colour = tuple[float, float, float]  # Blue, green, red, grey levels 0 to 255 in the light of the lamps

LINE_WIDTH: Final = 0.02  # m, white lines along the edges of the table (ITTF Laws 2.1.4)
MIDDLE_LINE_WIDTH: Final = 0.003  # m, white line that halves the table lengthwise (ITTF Laws 2.1.5)
LINE_COLOUR: Final[Colour] = (205.0, 208.0, 205.0)
TABLE_COLOUR: Final[Colour] = (112.0, 72.0, 30.0)
_APRON: Final[Colour] = (60.0, 42.0, 25.0)
_METAL: Final[Colour] = (70.0, 70.0, 70.0)
_LAUNCHER: Final[Colour] = (48.0, 44.0, 92.0)
FLOOR_COLOUR: Final[Colour] = (62.0, 78.0, 98.0)
WALL_COLOUR: Final[Colour] = (116.0, 124.0, 128.0)
CEILING_COLOUR: Final[Colour] = (160.0, 165.0, 165.0)
_BENCH: Final[Colour] = (58.0, 96.0, 74.0)
_POSTER: Final[Colour] = (120.0, 88.0, 76.0)

WALLS: Final = (np.array([-3.5, -4.2, 0.0]), np.array([6.0, 4.2, 3.4]))
"""m, low and high corner of the room; the origin is on the floor, below the middle of the launcher's end."""


@dataclass(frozen=True, eq=False)
class Box:
    """An upright box with one colour, and another on top if it is the table."""

    low: Array  # (3,) m
    high: Array  # (3,) m
    colour: Colour  # Of its sides, and of its top unless `lined`
    lined: bool = False  # True if its top is the playing surface

    def corners(self) -> Array:
        """(8, 3) m."""
        pick = np.indices((2, 2, 2)).reshape(3, 8).T.astype(bool)
        return np.where(pick, self.high, self.low)


def furniture(kind: BallKind) -> list[Box]:
    """The furniture of the room: the table, then its legs, the launcher, a bench, posters at the walls."""
    if kind.surfaces.extent is None:
        raise ValueError("surfaces must have an extent to be drawn as a table; got None. Use a ball over a table.")
    x0, x1, y0, y1 = kind.surfaces.extent
    top = kind.surfaces.table_height
    boxes = [Box(np.array([x0, y0, top - 0.03]), np.array([x1, y1, top]), _APRON, lined=True)]
    for x in (x0 + 0.3, x1 - 0.35):
        for y in (y0 + 0.15, y1 - 0.2):
            boxes.append(Box(np.array([x, y, 0.0]), np.array([x + 0.05, y + 0.05, top - 0.03]), _METAL))
    muzzle_x, muzzle_z = kind.launcher.x, top + kind.launcher.height
    tube = np.array([muzzle_x - 0.6, -0.045, muzzle_z - 0.045]), np.array([muzzle_x - 0.03, 0.045, muzzle_z + 0.045])
    boxes.append(Box(tube[0], tube[1], _LAUNCHER))
    boxes.append(Box(np.array([muzzle_x - 0.9, -0.15, 0.0]), np.array([muzzle_x - 0.6, 0.15, muzzle_z + 0.1]), _METAL))
    (left, near, _), (right, back, _) = WALLS
    boxes.append(Box(np.array([0.2, back - 0.5, 0.0]), np.array([2.2, back - 0.1, 0.45]), _BENCH))
    boxes.append(Box(np.array([right - 0.02, -2.6, 1.1]), np.array([right, -1.4, 2.2]), _POSTER))
    boxes.append(Box(np.array([0.6, near, 1.2]), np.array([2.4, near + 0.02, 2.0]), _POSTER))
    boxes.append(Box(np.array([left, 0.8, 0.0]), np.array([left + 0.05, 1.7, 2.05]), _BENCH))
    return boxes


def is_line(table: Box, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """True for points of the playing surface, x and y in m, on a white line."""
    (x0, y0, _), (x1, y1, _) = table.low.tolist(), table.high.tolist()
    edge = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y)) < LINE_WIDTH
    return np.asarray(edge | (np.abs(y - (y0 + y1) / 2) < MIDDLE_LINE_WIDTH / 2))


def middle_line(table: Box) -> Array:
    """(n, 3) m, points along the line that halves the table, a millimetre apart: it may be thinner than a pixel."""
    (x0, y0, _), (x1, y1, top) = table.low.tolist(), table.high.tolist()
    x = np.arange(x0, x1, 0.001)
    return np.column_stack((x, np.full_like(x, (y0 + y1) / 2), np.full_like(x, top)))


Rect = tuple[int, int, int, int]  # Left, top, right, bottom in pixels; right and bottom are the first ones outside


def clipped(camera: Camera, pixels: Array, margin: float) -> Rect | None:
    """The part of the image around pixels (n, 2), with a margin in px; None if it is empty."""
    low = np.maximum(np.floor(pixels.min(axis=0) - margin), 0)
    high = np.minimum(np.ceil(pixels.max(axis=0) + margin) + 1, camera.size)
    if not (low < high).all():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def grown(camera: Camera, rect: Rect, by: int) -> Rect:
    """A part of the image with a margin in px, clipped at the image's border."""
    left, top, right, bottom = rect
    width, height = camera.size
    return max(left - by, 0), max(top - by, 0), min(right + by, width), min(bottom + by, height)


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
