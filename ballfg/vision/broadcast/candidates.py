"""Finds what may be the ball in pictures that the camera's motion aligns.

A moving white ball is brighter, in each of the three colours, than the same place in the pictures before and after it;
where it hardly moves, brighter than in pictures some frames away. An orange ball is so in red and on the whole: before
a blue table it has less blue. What is left in connected regions of a ball's size at that
place is a candidate; a ball that moves while the shutter is open is a bar, whose second moments give its ends.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Iterator
from itertools import islice
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.parallel.parts import in_threads
from ballfg.progress import Watch, unwatched
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.court import Court
from ballfg.vision.broadcast.motion import Frames, Shot
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.detection.detections import Candidates, Detections
from ballfg.vision.detection.detector import Colour

NEAR, FAR = 1, 4  # pictures before and after, with which a picture is compared
BRIGHTER: Final = 14.0  # grey levels by which a pixel of a candidate is brighter, in the least of the three colours
PEAK: Final = 24.0  # the same for its brightest pixel: a fast ball over white letters has 40
THIN, THICK = 0.4, 2.2
"""Width of a candidate in diameters of the ball at that place, at least and at most: blur and compression widen it."""
LONGEST: Final = 60.0  # px, of a bar
LEAST: Final = 3  # pixels of a candidate
MOST: Final = 60  # candidates of a picture, those with the highest scores
ROOM: Final = (3.5, 3.0)
"""Half lengths and half widths of the court about which balls are seen: they bound the ball's size."""
SIGMA: Final = 0.6
"""px, standard deviation of a candidate's centre across a bar; along it a share of the bar's length is added."""
ALONG: Final = 0.06
BALLS: Final[tuple[Colour, ...]] = ("white", "orange")  # colours of balls, in the order in which they are looked for
VISIBLE: Final = 3.0  # px, of a bar whose direction shows


def find_candidates(
    frames: Frames,
    shot: Shot,
    court: Court,
    radius: float,
    stamps: Array,
    colour: Colour = "white",
    watch: Watch = unwatched,
) -> Detections:
    """The candidates in the pictures of a shot.

    Args: frames: opens the video.  radius: m, of the ball.  stamps: (f,) s, of all pictures.  colour: of the ball.
    Returns: pixels as in the pictures, with camera `main`; frames are those of the shot.
    """
    size, count = _diameters(shot, court, radius), len(shot)

    def windows() -> Iterator[tuple[list[Image], int, tuple[Pinhole, ...], Array, float]]:
        every = enumerate(watch(frames(), len(stamps), "pictures searched for the ball"))
        mine = (image for k, (_, image) in every if shot.first <= k < shot.first + count)
        window = deque[Image](maxlen=2 * FAR + 1)
        for number in range(-FAR, count):
            for image in islice(mine, 1):  # OpenCV warps four channels twice as quickly as three
                window.append(np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2BGRA), dtype=np.uint8))
            if number >= 0:
                begin = min(number + FAR + 1, count) - len(window)
                cameras = shot.cameras[begin : begin + len(window)]
                yield list(window), number - begin, cameras, size[number], shot.near

    found = in_threads(lambda one: aligned_candidates(*one, colour), windows())
    times = stamps[shot.first : shot.first + count].tolist()
    return Detections.of_frames("main", zip(times, found, strict=True))


def _diameters(shot: Shot, court: Court, radius: float) -> Array:
    """(n, 2) px, least and largest diameter of a ball about the court in each picture."""
    x, y = court.size * ROOM
    corners = np.array([(i * x, j * y, 0.0) for i in (-1, 1) for j in (-1, 1)])
    sizes = list[tuple[float, float]]()
    for camera in shot.cameras:
        depth = np.maximum(((corners - camera.place) @ camera.turn.T)[:, 2], 0.3 * np.linalg.norm(camera.place))
        sizes.append((2.0 * radius * camera.focal / depth.max(), 2.0 * radius * camera.focal / depth.min()))
    return np.array(sizes)


def aligned_candidates(
    window: list[Image],
    index: int,
    cameras: tuple[Pinhole, ...],
    size: Array,
    near: float = 0.0,
    colour: Colour = "white",
) -> Candidates:
    """The candidates of the picture `index` of a window, with the cameras of all of it and diameters (2,) px.

    Args: near: 1/m, as of `Shot`.
    """
    here = window[index]
    rise: Image | None = None
    for apart in (NEAR, FAR):
        beside = [index + step for step in (-apart, apart) if 0 <= index + step < len(window)]
        if not beside:
            continue
        others = [_warped(window[i], cameras[i], cameras[index], near) for i in beside]
        most = others[0] if len(others) == 1 else cv2.max(*others)
        change = _brighter(here, np.asarray(most, dtype=np.uint8), colour)
        rise = change if rise is None else np.maximum(rise, change)
    if rise is None:
        return Candidates.none()
    return _regions(np.asarray(cv2.GaussianBlur(rise, (3, 3), 0), dtype=np.uint8), size)


def _brighter(here: Image, most: Image, colour: Colour) -> Image:
    """(h, w) by how much pixels (h, w, 4) of a picture are brighter than others', as a ball of a colour is."""
    blue, green, red, *_ = cv2.split(cv2.subtract(here, most))
    if colour == "white":
        return np.minimum(np.minimum(blue, green), red).astype(np.uint8)
    grey, others = (cv2.cvtColor(one, cv2.COLOR_BGRA2GRAY) for one in (here, most))
    return np.minimum(red, cv2.subtract(grey, others)).astype(np.uint8)


def _warped(image: Image, camera: Pinhole, onto: Pinhole, near: float) -> Image:
    """A picture's background as another camera sees it; what it does not see is white."""
    width, height = camera.size
    grid = np.stack(np.meshgrid(np.linspace(0, width - 1, 5), np.linspace(0, height - 1, 5)), axis=-1).reshape(-1, 2)
    there = camera.onto(grid, onto, near)
    if np.abs(there - grid).max() < 0.05:
        return image
    homography = cv2.findHomography(grid, there, 0)[0]
    seen = cv2.warpPerspective(image, homography, (width, height), flags=cv2.INTER_LINEAR, borderValue=(255.0,) * 4)
    return np.asarray(seen, dtype=np.uint8)


def _regions(rise: Image, size: Array) -> Candidates:
    """Connected regions of a ball's width, as bars."""
    bright = rise > BRIGHTER
    count, labels = cv2.connectedComponents(bright.view(np.uint8), connectivity=8)
    y, x = np.divmod(np.flatnonzero(bright), bright.shape[1])
    mine, pixels = labels[y, x].astype(np.int64), np.stack((x, y), axis=1).astype(np.float64)
    corner, far = np.full((count, 2), np.inf), np.full((count, 2), -np.inf)
    np.minimum.at(corner, mine, pixels)
    np.maximum.at(far, mine, pixels)
    sides, areas = (far - corner).max(axis=1) + 1.0, np.bincount(mine, minlength=count)
    fine = (areas >= LEAST) & (sides < LONGEST + THICK * size[1]) & (sides >= THIN * size[0])
    used = fine[mine]
    pixels, mine, weight = pixels[used], mine[used], rise[y[used], x[used]].astype(np.float64)
    peak = np.zeros(count)
    np.maximum.at(peak, mine, weight)
    centre, width, half = _bars(pixels, weight, mine, corner)
    kept = np.flatnonzero((peak >= PEAK) & (width > THIN * size[0]) & (width < THICK * size[1]))
    centre, width, half, peak, area = centre[kept], width[kept], half[kept], peak[kept], areas[kept]
    length = 2.0 * np.hypot(*half.T)
    filled = np.minimum(1.0, area / np.maximum(width * (length + width), 1.0))
    scores = np.clip(peak / (peak + 60.0) * filled, 0.0, 1.0)
    unit = half / np.maximum(0.5 * length, 1e-9)[:, None]
    spread = SIGMA**2 * np.eye(2) + ((ALONG * length) ** 2)[:, None, None] * unit[:, :, None] * unit[:, None]
    streaks = np.stack((centre - half, centre + half), axis=1)
    streaks[length <= VISIBLE] = np.nan
    order = np.argsort(-scores, kind="stable")[:MOST]
    return Candidates(centre[order], spread[order], scores[order], streaks[order])


def _bars(pixels: Array, weight: Array, mine: Index, corner: Array) -> tuple[Array, Array, Array]:
    """Centres (k, 2) px, widths (k,) px and halves of the lengths (k, 2) px of bars; of width zero without pixels.

    A swept disc of diameter w and length l has the variances w^2 / 16 across it and w^2 / 16 + l^2 / 12 along it.

    Args: pixels: (n, 2), with weights (n,) and numbers (n,) of their bars.  corner: (k, 2) px, near each bar.
    """
    count = len(corner)

    def mean(values: Array) -> Array:
        return np.bincount(mine, weight * values, minlength=count) / total

    total = np.maximum(np.bincount(mine, weight, minlength=count), 1e-9)
    near = pixels - corner[mine]
    centre = np.stack((mean(near[:, 0]), mean(near[:, 1])), axis=1)
    x, y = (near - centre[mine]).T
    xx, xy, yy = mean(x * x), mean(x * y), mean(y * y)
    value, axes = np.linalg.eigh(np.stack((xx, xy, xy, yy), axis=1).reshape(-1, 2, 2))
    small, large = np.maximum(value[:, 0], 0.0), value[:, 1]
    half = 0.5 * np.sqrt(12.0 * np.maximum(large - value[:, 0], 0.0))[:, None] * axes[..., 1]
    width = np.where(np.bincount(mine, minlength=count) > 0, 4.0 * np.sqrt(small + 1.0 / 24.0), 0.0)
    return centre + corner, width, half
