"""Describes the room of a recording: boxes, colours, the table's lines; geometry without drawing, also in an image."""

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
    """The furniture of the room: the table on its legs, the launcher, a bench, posters at the walls."""
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


def is_line(kind: BallKind, x: NDArray[np.floating], y: NDArray[np.floating]) -> NDArray[np.bool_]:
    """True for points of the playing surface, x and y in m, on a white line."""
    if kind.surfaces.extent is None:
        return np.zeros(np.shape(x), dtype=bool)
    x0, x1, y0, y1 = kind.surfaces.extent
    edge = np.minimum(np.minimum(x - x0, x1 - x), np.minimum(y - y0, y1 - y)) < LINE_WIDTH
    return np.asarray(edge | (np.abs(y - (y0 + y1) / 2) < MIDDLE_LINE_WIDTH / 2))


def middle_line(kind: BallKind) -> Array:
    """(n, 3) m, points along the line that halves the table, a millimetre apart: it may be thinner than a pixel."""
    if kind.surfaces.extent is None:
        return np.zeros((0, 3))
    x0, x1, y0, y1 = kind.surfaces.extent
    x = np.arange(x0, x1, 0.001)
    return np.column_stack((x, np.full_like(x, (y0 + y1) / 2), np.full_like(x, kind.surfaces.table_height)))


Rect = tuple[int, int, int, int]  # Left, top, right, bottom in pixels; right and bottom are the first ones outside


def inside(camera: Camera, pixels: Array, reach: Array | float = 0.0) -> NDArray[np.bool_]:
    """(...) True for discs of radius `reach` (...) px about pixels (..., 2) inside the image; False for NaN."""
    reach = np.asarray(reach)[..., None]
    return np.asarray(((pixels - reach >= -0.5) & (pixels + reach < np.array(camera.size) - 0.5)).all(axis=-1))


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
