"""Holds all candidates of a recording as a fixed camera sees them, and how likely each is a ball or clutter."""

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numba import types

from ballfg.arrays import Array, Index, Mask, plain
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNTS, FLAG, NOTHING, ONE, REAL, TWO, several
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import STANDARD_GRAVITY
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

SEEN, UNKNOWN = 0.9, 0.5
"""Probability that the ball is among the candidates of a picture, at first: among those of `ballfg.vision.broadcast`,
and among those of a detector of which nothing is known."""
SEEN_RANGE: Final = (0.2, 0.95)
"""Of that probability, as a found rally shows it."""
BAR_SIGMA, BAR_SHARE = 1.5, 0.12
"""px, and share of its length, by which a ball's bar differs from its motion while the shutter is open."""
RING: Final = 3.0
"""px, width of the rings in which bars of all candidates are counted."""
SIZE_SIGMA, SIZES = 0.25, 0.25
"""Standard deviation of the logarithm of a ball's radius in the picture about the true one, beside that of the noise:
soft edges, compression; and the width of the steps in which radii of all candidates are counted."""
STRAY: Final = 0.1
"""Share of a ball's bars and radii that are not: a bounce or a shirt within the exposure."""
ASKEW: Final = 0.5
"""rad between a bar and the motion of its centre."""
LONG: Final = 8.0
"""px of a bar and of a motion whose directions are compared."""
HELD, FLATTEST = 1.5, 1.0 / 6.0
"""m above a court without known ends, at which a camera stands at least, and sine of the flattest angle at which it
looks down there: one that looks at the horizon would see all balls far away."""


def ends_of(surfaces: Surfaces) -> Array | None:
    """((x_low, x_high), (y_low, y_high)) m of a court; None if one of its ends is not known."""
    if surfaces.extent is None or not np.isfinite(surfaces.extent).all():
        return None
    return np.array(surfaces.extent).reshape(2, 2)


def at_court(camera: Camera, surfaces: Surfaces) -> tuple[float, float]:
    """Pixels for a m at the court's middle, and px/s^2 of a free fall there, both across a camera's line of sight.

    Of a court without known ends the place counts that the middle of the picture shows.

    Args: camera: without distortion and with one focal length.
    """
    ends, focal = ends_of(surfaces), float(camera.matrix[0, 0])
    if ends is None:
        away = camera.rotation[2]
        away = away * max(camera.centre[2] - surfaces.table_height, HELD) / max(-away[2], FLATTEST)
    else:
        away = np.append(ends.mean(axis=1), surfaces.table_height) - camera.centre
    distance = float(np.linalg.norm(away))
    across = float(np.hypot(away[0], away[1])) / distance  # sine of the angle from the vertical
    return focal / distance, focal / distance * across * STANDARD_GRAVITY


def without_lens(seen: Detections, camera: Camera) -> tuple[Detections, Camera]:
    """The candidates as a camera without distortion and with one focal length would see them, and that camera."""
    (fx, fy), middle = np.diag(camera.matrix)[:2], camera.matrix[:2, 2]
    if fx == fy and not camera.distortion.any():
        return seen, camera
    focal = float(np.sqrt(fx * fy))

    def onto(pixels: Array) -> Array:
        return focal * camera.normalized(pixels) + middle

    slope = np.stack([onto(seen.pixels + step) - onto(seen.pixels - step) for step in 0.5 * np.eye(2)], axis=-1)
    spread = slope @ seen.covariances @ slope.swapaxes(1, 2)
    radii = seen.radii * np.sqrt(np.abs(np.linalg.det(slope)))[:, None]
    flat = replace(seen, pixels=onto(seen.pixels), covariances=spread, streaks=onto(seen.streaks), radii=radii)
    matrix = np.array([[focal, 0.0, middle[0]], [0.0, focal, middle[1]], [0.0, 0.0, 1.0]])
    return flat, replace(camera, matrix=matrix, distortion=np.zeros(0))


@machine_code(several(REAL, 2)(REAL, REAL, REAL, REAL))
def bar_error(x, y, to_x, to_y):
    """px^2, squared distance of a bar from a motion while the shutter is open, either way around; its variance."""
    off = min((x - to_x) ** 2 + (y - to_y) ** 2, (x + to_x) ** 2 + (y + to_y) ** 2)
    return off, BAR_SIGMA**2 + BAR_SHARE**2 * (to_x**2 + to_y**2)


@machine_code(REAL(REAL, REAL, REAL, REAL, REAL))
def bar_gain(x, y, to_x, to_y, usual):
    """Logarithm of how much likelier a bar is a ball's, which moved so while the shutter was open, than clutter's."""
    if not usual:
        return 0.0
    off, variance = bar_error(x, y, to_x, to_y)
    ratio = math.exp(-0.5 * off / variance) / (2.0 * math.pi * variance) / usual
    return math.log(STRAY + (1.0 - STRAY) * ratio)


@machine_code(REAL(REAL, REAL, REAL, REAL))
def size_gain(size, sigma, foretold, common):
    """Logarithm of how much likelier the logarithm of a radius is a ball's of a foretold one than clutter's."""
    if not common:
        return 0.0
    variance = sigma**2 + SIZE_SIGMA**2
    ratio = math.exp(-0.5 * (size - foretold) ** 2 / variance) / math.sqrt(2.0 * math.pi * variance) / common
    return math.log(STRAY + (1.0 - STRAY) * ratio)


@machine_code(FLAG(REAL, REAL, REAL, REAL))
def along(x, y, to_x, to_y):
    """True if a bar lies along a motion, or one of both is short."""
    long, far = math.hypot(x, y), math.hypot(to_x, to_y)
    return not (long > LONG and far > LONG and abs(x * to_y - y * to_x) > math.sin(ASKEW) * long * far)


@machine_code(NOTHING(TWO, TWO, types.Array(types.boolean, 1, "C")))
def _all_along(bars, motion, good):
    """Writes `along` of bars (n, 2)."""
    for n in range(len(bars)):
        good[n] = along(bars[n, 0], bars[n, 1], motion[n, 0], motion[n, 1])


@machine_code(NOTHING(TWO, TWO, ONE, ONE))
def _bar_gains(bars, motion, usual, gain):
    """Writes `bar_gain` of bars (n, 2)."""
    for n in range(len(bars)):
        gain[n] = bar_gain(bars[n, 0], bars[n, 1], motion[n, 0], motion[n, 1], usual[n])


@machine_code(NOTHING(TWO, TWO, ONE))
def _bars_off(bars, motion, off):
    """Writes the standard deviations (n,) between bars (n, 2) and motions."""
    for n in range(len(bars)):
        square, variance = bar_error(bars[n, 0], bars[n, 1], motion[n, 0], motion[n, 1])
        off[n] = math.sqrt(square / variance)


@machine_code(NOTHING(COUNTS, TWO, TWO))
def _moved(frames, pixels, motion):
    """Writes the slopes (n, 2) of pixels: at the ends those to the next, else of a parabola through three of them."""
    last = len(frames) - 1
    for n in range(last + 1):
        before, after = float(frames[n] - frames[max(n - 1, 0)]), float(frames[min(n + 1, last)] - frames[n])
        for axis in range(2):
            to = (pixels[n, axis] - pixels[n - 1, axis]) / before if n else 0.0
            on = (pixels[n + 1, axis] - pixels[n, axis]) / after if n < last else 0.0
            motion[n, axis] = (after * to + before * on) / (before + after) if 0 < n < last else to + on


def _sized(radii: Array) -> tuple[Array, Array]:
    """Logarithms of radii (n, 2) px with their sigmas, and (n,) the density of each among all; 0 where unknown."""
    known, sizes, common = radii[:, 0] > 0.0, np.zeros_like(radii), np.zeros(len(radii))
    if known.any():
        radius, sigma = radii[known].T
        sizes[known] = np.stack((np.log(radius), sigma / radius), axis=1)
        step = np.floor(sizes[known, 0] / SIZES).astype(np.int64)
        common[known] = _share(step - step.min()) / SIZES
    return sizes, common


def _share(number: Index) -> Array:
    """(n,) of those in the class of each, by their numbers (n,) from 0 on; one more counts in each class."""
    return np.asarray(((np.bincount(number) + 1.0) / (len(number) + number.max(initial=0) + 1.0))[number])


@dataclass(frozen=True, eq=False)
class Field:
    """The candidates of a recording as one fixed camera would see them, sorted by picture.

    Attributes:
        frame: (n,) numbers of their pictures.  pixels: (n, 2).  covariances: (n, 2, 2) px^2.
        bars: (n, 2) px from end to end, zero where not blurred.
        density: (n,) 1/px^2, of clutter that looks as much like a ball.
        usual: (n,) 1/px^2, density of a bar like each one's among all candidates; 0 of a detector that gives none.
        sizes: (n, 2) logarithms of radii in px, and their standard deviations.
        common: (n,) density of a size like each one's among all candidates; 0 where it is not known.
        first: (f + 1,) where each picture's begin.  stamps: (f,) s, of the pictures.  step: s between them, the median.
        scale: px for a m at the court.  exposure: of the step, during which the shutter is open.
        seen: probability that the ball is among the candidates of a picture.
        fall: px/s^2, of a free fall at the court; 0 along the line of sight.
        play: True if one ball in play is looked for, which flies along the court and bounces; False for any flight.
    """

    frame: Index
    pixels: Array
    covariances: Array
    bars: Array
    density: Array
    usual: Array
    sizes: Array
    common: Array
    first: Index
    stamps: Array
    step: float
    scale: float
    exposure: float = 0.0
    seen: float = SEEN
    fall: float = 0.0
    play: bool = True

    @classmethod
    def of(cls, seen: Detections, scale: float, ball: float = SEEN, fall: float = 0.0) -> "Field":
        """The field of detections of a fixed camera that hold the ball with a probability `ball`."""
        count, pixels = len(seen.frames), seen.pixels
        size = pixels.max(axis=0, initial=-np.inf) - pixels.min(axis=0, initial=np.inf)
        better = len(seen) - np.searchsorted(np.sort(seen.scores), seen.scores)
        first = np.searchsorted(seen.frame, np.arange(count + 1))
        step, bars = float(np.median(np.diff(seen.frames))), np.nan_to_num(seen.streaks[:, 1] - seen.streaks[:, 0])
        density = better / count / float(np.prod(np.maximum(size, 1.0)))
        number = (np.linalg.norm(bars, axis=1) // RING).astype(np.int64)
        usual = _share(number) / (np.pi * RING**2 * (2.0 * number + 1.0))  # of rings about a bar of no length
        rows = plain(seen.frame), plain(pixels), plain(seen.covariances), bars, density, usual * bars.any()
        sizes, common = _sized(seen.radii)
        return cls(*rows, sizes, common, first, seen.frames, step, scale, seen=ball, fall=fall)

    def smooth(self, density: float) -> "Field":
        """The field whose clutter moves smoothly: where its motion foretells a candidate, it has a density, 1/px^2."""
        return replace(self, density=np.maximum(self.density, density))

    def without(self, clutter: Mask) -> "Field":
        """The field in which some candidates (n,) are as dense as their noise: to be where a motion foretells them."""
        own = 1.0 / (2.0 * np.pi * np.sqrt(np.linalg.det(self.covariances)))
        return replace(self, density=np.where(clutter, np.maximum(own, self.density), self.density))

    def rows(self, frame: int) -> Index:
        """Numbers of the candidates of a picture; none beyond the ends."""
        inside = 0 <= frame < len(self.first) - 1
        return np.arange(self.first[frame], self.first[frame + 1]) if inside else np.zeros(0, dtype=np.int64)

    def along(self, rows: Index, motion: Array) -> Mask:
        """(n,) bool: the bars of rows (n,) lie along motions (n, 2) px, or one of both is short."""
        good: Mask = np.empty(len(rows), dtype=bool)
        _all_along(self.bars[rows], motion, good)
        return good

    @property
    def spot(self) -> Array:
        """(n,) logarithm of how much likelier candidates are a ball than clutter, by their number alone."""
        return np.asarray(np.log(self.seen / self.density / (2.0 * np.pi * np.sqrt(np.linalg.det(self.covariances)))))

    def bar_gain(self, rows: Index, motion: Array, exposure: float) -> Array:
        """(n,) the same of bars alone, for motions (n, 2) px a picture and an exposure of the step."""
        gain = np.empty(len(rows))
        _bar_gains(self.bars[rows], exposure * motion, self.usual[rows], gain)
        return gain

    def bar_off(self, rows: Index, motion: Array) -> Array:
        """(n,) standard deviations between bars and motions (n, 2) px a picture."""
        off = np.empty(len(rows))
        _bars_off(self.bars[rows], self.exposure * motion, off)
        return off

    def agree(self, rows: Index, most: float) -> bool:
        """True if all bars of an arc lie within so many standard deviations of its motion."""
        return bool((self.bar_off(rows, self.motion(rows)) < most).all())

    def off(self, rows: Index, order: int) -> float:
        """px, root mean square distance of candidates from the best polynomial of an order in time."""
        since = self.stamps[self.frame[rows]]
        powers = np.vander(since - since.mean(), order + 1)
        off = self.pixels[rows] - powers @ np.linalg.lstsq(powers, self.pixels[rows], rcond=None)[0]
        return float(np.sqrt((off**2).sum(axis=1).mean()))

    def motion(self, rows: Index) -> Array:
        """(n, 2) px a picture, of an arc: the slope of a parabola through each candidate and those beside it."""
        motion = np.empty((len(rows), 2))
        _moved(self.frame[rows], self.pixels[rows], motion)
        return motion
