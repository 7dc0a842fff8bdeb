"""Draws pictures of a table in a hall from a camera that pans and zooms: projected polygons, and how the hall looks."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.court import Court, table_tennis
from ballfg.vision.broadcast.lines import moved
from ballfg.vision.broadcast.pinhole import Pinhole

SIZE: Final = (960, 540)
"""px, of pictures."""
Colour = tuple[float, float, float]
"""Grey levels of blue, green and red."""
COURT: Final = table_tennis()
PARTS: Final = 12
"""Of the side of a polygon, which a lens bends."""
LARGEST: Final = 1e4
"""px, of a polygon that is drawn."""
FLOOR: Final = -0.76
"""m, z of the floor."""
BARRIERS: Final = (
    *(((x, y), (0.8, 0.0)) for x in (-4.9, -3.0, -1.0, 1.0, 3.0, 4.9) for y in (-3.5, 3.5)),
    *(((x, y), (0.0, 0.8)) for x in (-7.0, 7.0) for y in (-2.0, 0.0, 2.0)),
)
"""Middles and half lengths of barriers, m."""


@dataclass(frozen=True)
class Look:
    """The colours of a hall, and half the widths, m, of table lines, the middle one, and the net's tape from above.

    Attributes: barriers: around the floor; None: there are none.  net: cloth, with its posts and tape in `lines`.
    """

    table: Colour = (150, 80, 30)
    lines: Colour = (240, 240, 240)
    net: Colour = (70, 60, 40)
    floor: Colour = (60, 50, 48)
    wall: Colour = (60, 50, 48)
    ball: Colour = (235, 240, 240)
    barriers: Colour | None = None
    half_width: float = 0.01
    half_middle: float = 0.01
    half_tape: float = 0.0


PLAIN: Final = Look()


def looking(
    place: Sequence[float], at: Sequence[float], focal: float, bend: float = 0.0, size: tuple[int, int] = SIZE
) -> Pinhole:
    """A camera at a place (m) that looks at a point (m), upright."""
    forward = np.subtract(at, place)
    forward = forward / np.linalg.norm(forward)
    right = np.cross(forward, (0.0, 0.0, 1.0))
    right /= np.linalg.norm(right)
    return Pinhole(np.stack((right, np.cross(forward, right), forward)), np.array(place), focal, size, bend)


def panned(camera: Pinhole, count: int, turn: float, zoom: float) -> list[Pinhole]:
    """Cameras that turn to the right by `turn` rad in all and grow their focal length by a factor exp(zoom)."""
    shares = np.linspace(0.0, 1.0, count)
    return [moved(camera, np.array([0.0, turn * s, 0.0, 0.0, 0.0, 0.0, zoom * s])) for s in shares]


def picture(
    camera: Pinhole,
    rng: np.random.Generator,
    balls: Sequence[Array] = (),
    others: Sequence[tuple[Array, Colour]] = (),
    court: Court = COURT,
    look: Look = PLAIN,
    empty: Image | None = None,
) -> Image:
    """A table with lines and a net, on a floor with marks; balls (2, 3) m, ends of their bars.

    Args: others: polygons (n, 3) m and their colours, of what stands before or behind the table.
        empty: the hall as the camera sees it; None: it is drawn.
    """
    image = hall(camera, look) if empty is None else empty.copy()
    far = float(np.linalg.norm(camera.place))
    for shown, colour in others:
        if np.linalg.norm(shown.mean(axis=0) - camera.place) > far:
            _filled(image, camera, shown, colour)
    _filled(image, camera, court.corners, look.table)
    for first, second in court.lines:
        _line(image, camera, np.stack((first, second)), look)
    for ball in balls:
        ends = camera.project(ball)
        depth = ((ball.mean(axis=0) - camera.place) @ camera.turn.T)[2]
        _barred(image, ends, 0.02 * camera.focal / depth, look.ball)
    for shown, colour in others:
        if np.linalg.norm(shown.mean(axis=0) - camera.place) <= far:
            _filled(image, camera, shown, colour)
    noisy = cv2.GaussianBlur(image, (3, 3), 0.7).astype(np.float32) + rng.normal(0.0, 2.0, image.shape)
    return np.asarray(np.clip(noisy, 0, 255), dtype=np.uint8)


def hall(camera: Pinhole, look: Look) -> Image:
    """The floor, with marks as of letters and wear, and barriers with white letters around it."""
    width, height = camera.size
    image = np.full((height, width, 3), look.wall, dtype=np.uint8)
    marks = np.random.default_rng(5)
    if look.floor != look.wall:
        for x, y in product(np.arange(-12.0, 12.0, 2.0), np.arange(-12.0, 16.0, 2.0)):  # one may lie behind the camera
            tile = [(x, y, FLOOR), (x + 2.0, y, FLOOR), (x + 2.0, y + 2.0, FLOOR), (x, y + 2.0, FLOOR)]
            _filled(image, camera, np.array(tile), look.floor)
    for _ in range(150):
        x, y = marks.uniform((-9.0, -7.0), (9.0, 12.0))
        level = marks.uniform(70, 170)
        corners = np.array([[x, y], [x + 0.5, y], [x + 0.4, y + 0.3], [x, y + 0.3]]) + marks.uniform(-0.1, 0.1, (4, 2))
        _filled(image, camera, np.column_stack((corners, np.full(4, FLOOR))), (level, level, level))
    if look.barriers is not None:
        _barriers(image, camera, look.barriers, marks)
    return image


def _barriers(image: Image, camera: Pinhole, colour: Colour, marks: np.random.Generator) -> None:
    """Draws barriers with white letters."""
    for middle, along in BARRIERS:
        one = partial(_upright, np.array(middle), np.array(along))
        _filled(image, camera, one(-1.0, 1.0, 0.0, 0.7), colour)
        for begin in np.arange(-0.8, 0.8, 0.12):
            _filled(image, camera, one(begin, begin + marks.uniform(0.03, 0.1), 0.25, 0.5), (235, 235, 235))


def _upright(middle: Array, along: Array, begin: float, end: float, low: float, high: float) -> Array:
    """(4, 3) m, a rectangle that stands on the floor, from and to shares of its half length and heights, m."""
    first, last = middle + begin * along, middle + end * along
    return np.array([[*first, FLOOR + low], [*last, FLOOR + low], [*last, FLOOR + high], [*first, FLOOR + high]])


def _line(image: Image, camera: Pinhole, ends: Array, look: Look) -> None:
    """Draws a line (2, 3) m of the court, or the net with its tape."""
    first, second = ends
    along = (second - first) / np.linalg.norm(second - first)
    middle = not first[1] and not second[1]
    across = np.array([-along[1], along[0], 0.0]) * (look.half_middle if middle else look.half_width)
    if first[2] > 0.0:
        across = np.array([0.0, 0.0, 0.008])
        thick = np.array([look.half_tape, 0.0, 0.0])
        low = np.array([0.0, 0.0, first[2]])
        _filled(image, camera, np.array([first, second, second - low, first - low]), look.net)
        if look.half_tape:
            _filled(image, camera, np.array([first - thick, second - thick, second + thick, first + thick]), look.lines)
    _filled(image, camera, np.array([first - across, second - across, second + across, first + across]), look.lines)


def _filled(image: Image, camera: Pinhole, corners: Array, colour: Colour) -> None:
    """Draws a convex polygon (n, 3) m, each pixel by the share that lies within it.

    `cv2.fillPoly` would make a line 1.4 px wider, and a tenth of a pixel off.
    """
    border = camera.project(_dense(corners))
    if not (np.isfinite(border).all() and np.abs(border).max() < LARGEST):
        return
    box = _box(image, border)
    pixels = _pixels(box)
    sides = np.concatenate((border, border[:1]))
    after = sides[1:]
    inwards = np.sign((border[:, 0] * after[:, 1] - border[:, 1] * after[:, 0]).sum())
    share = np.ones(pixels.shape[:2])
    for first in range(0, len(border), PARTS):
        side = sides[first : first + PARTS + 1]
        along = (side[-1] - side[0]) / max(float(np.linalg.norm(side[-1] - side[0])), 1e-9)
        across = inwards * np.array([-along[1], along[0]])
        inside = pixels @ across - np.interp(pixels @ along, side @ along, side @ across)
        share -= 1.0 - np.clip(inside / np.abs(across).sum() + 0.5, 0.0, 1.0)  # a pixel is wider along its diagonal
    _blended(image[box], np.clip(share, 0.0, 1.0), colour)


def _barred(image: Image, ends: Array, radius: float, colour: Colour) -> None:
    """Draws a bar with round ends (2, 2) px, each pixel by the share that lies within it."""
    box = _box(image, np.concatenate((ends - radius, ends + radius)))
    pixels, along = _pixels(box) - ends[0], ends[1] - ends[0]
    share = np.clip(pixels @ along / max(float(along @ along), 1e-9), 0.0, 1.0)
    distance = np.linalg.norm(pixels - share[..., None] * along, axis=2)
    _blended(image[box], np.clip(radius - distance + 0.5, 0.0, 1.0), colour)


def _box(image: Image, points: Array) -> tuple[slice, slice]:
    """Rows and columns of the pixels that points (n, 2) px enclose."""
    low, high = np.floor(points.min(axis=0)).astype(int), np.ceil(points.max(axis=0)).astype(int) + 1
    (left, top), (right, bottom) = np.maximum(low, 0), np.clip(high, 0, image.shape[1::-1])
    return slice(int(top), max(int(top), int(bottom))), slice(int(left), max(int(left), int(right)))


def _pixels(box: tuple[slice, slice]) -> Array:
    """(h, w, 2) px, the middles of the pixels of a box."""
    v, u = np.mgrid[box]
    return np.stack((u, v), axis=2).astype(np.float64)


def _blended(part: Image, share: Array, colour: Colour) -> None:
    """Paints a share (h, w) of each pixel of a part (h, w, 3) of a picture."""
    part[:] = np.round(part + share[..., None] * (np.array(colour) - part)).astype(np.uint8)


def _dense(corners: Array) -> Array:
    """Points along the border of a polygon, `PARTS` a side: a distorted edge is no line."""
    shares = np.linspace(0.0, 1.0, PARTS, endpoint=False)[:, None]
    ends = np.roll(corners, -1, axis=0)
    return np.concatenate([a + shares * (b - a) for a, b in zip(corners, ends, strict=True)])


SIZES: Final = ((640, 360), (854, 480), (1280, 720), (1920, 1080))
"""px, of pictures."""
TABLES: Final = ((150, 80, 30), (190, 120, 50), (70, 90, 25), (48, 45, 45), (90, 40, 15))
"""Colours: blue, light blue, green, dark grey, dark blue."""
FLOORS: Final = ((45, 40, 150), (140, 70, 40), (120, 120, 118), (95, 140, 180), (35, 32, 30), (80, 95, 60))
"""Colours: red, blue, grey, wood, dark, green."""
LINES: Final = ((240, 240, 240), (200, 205, 205), (70, 50, 210))
"""Colours: white, dull white, red."""
WHITE, ORANGE = (235, 240, 240), (50, 140, 250)
"""Colours of balls."""
SHIRTS: Final = ((40, 40, 45), (40, 40, 190), (170, 60, 30), (60, 150, 60))
"""Colours of players and judges."""
DARK: Final = 60
"""Grey levels of dark tables and floors, at most."""
HALF_MIDDLE: Final = (0.0015, 0.0025)
"""m, half the width of the middle line (3 mm by ITTF Law 2.1.5)."""

HALF_TAPE: Final = 0.005
"""m, half the thickness of the net's tape and cord, which shows from above the net."""


def drawn_look(rng: np.random.Generator) -> Look:
    """A look; red lines lie on dark tables and floors, with dark nets."""
    table = TABLES[rng.integers(len(TABLES))]
    floor, wall = (FLOORS[rng.integers(len(FLOORS))] for _ in range(2))
    dark = max(table) < DARK and max(floor) < DARK
    lines = LINES[rng.integers(len(LINES) if dark else 2)]
    barriers = FLOORS[rng.integers(len(FLOORS))] if rng.random() < 0.7 else None
    net = (70, 60, 40) if dark or rng.random() < 0.6 else (150, 150, 150)
    return Look(table, lines, net, floor, wall, WHITE, barriers, 0.01, rng.uniform(*HALF_MIDDLE), HALF_TAPE)


def judges(rng: np.random.Generator) -> list[tuple[Array, Colour]]:
    """An umpire behind the net's far post, and two judges beside the ends: polygons and colours."""
    found = list[tuple[Array, Colour]]()
    for x, y in ((0.0, 2.6), (-4.0, 3.1), (4.0, 3.1)):
        x, y = x + rng.normal(0.0, 0.2), y + rng.normal(0.0, 0.1)
        for wide, low, high, colour in (
            (0.22, FLOOR, 0.35, SHIRTS[rng.integers(len(SHIRTS))]),
            (0.09, 0.35, 0.6, (120, 150, 200)),
        ):
            body = [(x - wide, y, low), (x + wide, y, low), (x + wide, y, high), (x - wide, y, high)]
            found.append((np.array(body), colour))
    return found
