"""Fits a ball's image: a disc with soft edges swept along a segment while the shutter is open.

With coverage a(x) in [0, 1], the share of the exposure during which pixel x lies on the ball, a pixel shows
b(x) + a(x) (f - b(x)): background b, ball f. The ball's shading, linear across the disc, adds a swept gradient. The fit
is by least squares on differences to the background, over the whole edge: the ball's brightest spot does not pull the
centre.
"""

from dataclasses import dataclass
from functools import cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.vision.arrays import Array32

LONGEST_HALF: Final = 15.0  # px, prior sigma of half a streak; it only matters below a pixel
WIDEST, BRIGHTEST, SINGLE = 100.0, 1e3, 1e-6
"""px and grey levels, sigmas of centre, radius and contrast of a disc that covers all pixels, of which they show none;
and share of the information that single precision may hide."""
NODE_SPACING: Final = 1.8  # px of streak per node: two edge widths, which Gauss-Legendre integrates to 1e-3
STANDS_OUT: Final = 3.0  # sigmas of noise above which a pixel counts for the first values
FAINT: Final = 0.3  # share of the strongest contrast: with less, a change's noise would weigh too much
MOST_STEPS: Final = 8
HOPELESS: Final = (0.3, 0.2, 0.15)
"""Share of the change left over, at first and after steps, that ends a fit: balls leave 0.02, sleeves 0.1 to 0.9."""
REACH: Final = 1.2
RING: Final = 3.5  # px. The fit takes pixels within REACH radii and RING of the streak that it starts from.
MOST_WORK: Final = 24000  # pixels times nodes of a fit; of a larger ball it takes every second pixel, every third, ...
SETTLED: Final = np.array([0.02, 0.02, 0.1, 0.1, 0.05])  # px: centre, half streak and radius moved by less
SAME: Final = 0.02  # relative step of the contrast below which it is settled
DRIFT: Final = 1.5  # px from first values to last beyond which a fit may have missed pixels of the streak
BLUNT: Final = 1.0  # px: half a streak shorter than this hardly shows, wanders with the noise and need not come to rest
LONGEST_STEP: Final = 3.0  # px, of any parameter in one step: further out the linearisation is worthless
SHARPEST: Final = 0.35  # px, the least softness of an edge: that of a square pixel alone, without a lens
_ROUNDING: Final = np.float32(1e-6)  # px, added to distances from the centre, which are divided by
SMALLEST: Final = 1.0  # px, the least radius: less is a point, and all shapes of it look alike
CENTRE, HALF, RADIUS, CONTRAST, LOOK = slice(0, 2), slice(2, 4), 4, 5, slice(6, 9)  # places in a vector


@dataclass(frozen=True, eq=False)
class Look:
    """Expected edge and shading of a ball: they depend on camera, lens and lamps, not on the frame.

    The mean (3,) is the softness e of the edge (px), so that coverage falls as tanh(distance / e), and the shading in x
    and in y, from the middle to the rim, relative to the ball's brightness: that is what lamps change.
    """

    mean: Array
    information: Array  # (3, 3), inverse of the covariance of these

    @classmethod
    def unknown(cls) -> "Look":
        """The expectation before any ball was seen.

        A lens blur of 0.6 px and a square pixel make an edge of 0.85 px; a ball under one lamp is brighter by a quarter
        towards it.
        """
        return cls(np.array([0.85, 0.0, 0.0]), np.diag([0.3**-2, 0.25**-2, 0.25**-2]))


@dataclass(frozen=True, eq=False)
class Patch:
    """Pixels around a candidate, in the form for the fit."""

    x: Array32  # (m,) px, where the pixels are
    y: Array32
    change: Array32  # (m,) grey levels by which each differs from the background, along the candidate's colour
    background: Array32  # (m,) grey levels of the background along that colour, less their mean
    level: float  # grey levels, that mean
    noise: float  # grey levels, sigma of `change`

    def at(self, rows: NDArray[np.intp]) -> "Patch":
        """A part of the pixels."""
        return Patch(self.x[rows], self.y[rows], self.change[rows], self.background[rows], self.level, self.noise)


@dataclass(frozen=True, eq=False)
class StreakFit:
    """A disc swept along a segment.

    The values (9,) are the centre x, y (px), half the streak (px, a vector), the radius (px), the contrast against the
    background's mean (grey levels), and the three of a `Look`.
    """

    values: Array
    covariance: Array  # (9, 9) of these, for the noise that the residuals show, expectations included
    tells: Array  # (3, 3) information that these pixels alone bring about the look, taking their noise as known
    unexplained: float  # share of the change's energy beyond the noise that the fit leaves over, 0 to 1 or more
    strength: float  # signal to noise of the whole change: root of its energy beyond the noise, over the noise
    scatter: float  # residual's root mean square over the noise
    settled: bool  # True if the steps converged

    @property
    def centre(self) -> Array:
        """(2,) px, in the middle of the exposure."""
        return self.values[CENTRE]

    @property
    def half(self) -> Array:
        """(2,) px from the centre to one end of the streak."""
        return self.values[HALF]

    @property
    def oddness(self) -> float:
        """Sigmas, root mean square of three, between edge and shading and those expected of any ball."""
        first = Look.unknown()
        off = self.values[LOOK] - first.mean
        return float(np.sqrt(off @ first.information @ off / len(off)))

    @property
    def radius(self) -> float:
        """Radius, px."""
        return float(self.values[RADIUS])


@cache
def _quadrature(count: int) -> tuple[Array32, Array32]:
    """Nodes on [-1, 1] and weights of sum one."""
    nodes, weights = np.polynomial.legendre.leggauss(count)
    return nodes.astype(np.float32), (weights / 2).astype(np.float32)


def _nodes(half: Array) -> int:
    return 1 + int(np.ceil(2.0 * np.hypot(*half) / NODE_SPACING))


def swept(x: Array32, y: Array32, values: Array) -> tuple[Array32, Array32]:
    """Coverage of pixels by the swept disc, and its derivatives.

    Args: x, y: (m,) px.  values: (9,) as in `StreakFit`.
    Returns: (m,) coverage; (8, m): its derivatives by centre (2), half streak (2), radius and edge; the swept gradients
        (2) of a shading that is one at the rim.
    """
    half = values[HALF]
    nodes, weights = _quadrature(_nodes(half))
    radius, edge = np.float32(values[RADIUS]), np.float32(values[LOOK][0])
    dx = x - (values[0] + nodes * half[0]).astype(np.float32)[:, None]  # (q, m)
    dy = y - (values[1] + nodes * half[1]).astype(np.float32)[:, None]
    distance = np.sqrt(dx * dx + dy * dy) + _ROUNDING
    inward = (radius - distance) / edge
    disc = np.tanh(inward)
    slope = (1 - disc * disc) / (2 * edge)
    along = slope / distance
    by_x, by_y = along * dx, along * dy
    disc = (disc + 1) * (1 / (2 * radius))
    moments = weights * nodes
    moment_of = (weights, weights, moments, moments, weights, -weights, weights, weights)
    arrays = (by_x, by_y, by_x, by_y, slope, slope * inward, disc * dx, disc * dy)
    parts = np.empty((len(arrays), x.size), dtype=np.float32)
    for row, moment, array in zip(parts, moment_of, arrays, strict=True):
        np.matmul(moment, array, out=row)
    return (weights @ disc) * radius, parts


def start(patch: Patch, look: Look) -> Array | None:
    """First values (9,) from the moments of the change; None where nothing stands out.

    The variance of a swept disc is r^2/4 across the streak and r^2/4 + h^2/3 along it.
    """
    top = int(np.argmax(patch.change))
    peak = float(patch.change[top])
    if peak <= STANDS_OUT * patch.noise:
        return None
    level = peak + float(patch.background[top])
    height = np.maximum(level - patch.background, FAINT * peak)
    mass = np.where(patch.change > STANDS_OUT * patch.noise, patch.change / height, 0.0).astype(np.float64)
    total = mass.sum()
    cx, cy = mass @ patch.x / total, mass @ patch.y / total
    dx, dy = patch.x - cx, patch.y - cy
    xx, xy, yy = mass @ (dx * dx) / total, mass @ (dx * dy) / total, mass @ (dy * dy) / total
    (small, large), axes = np.linalg.eigh(np.array([[xx, xy], [xy, yy]]))
    radius = max(2.0 * np.sqrt(max(small, 0.0)), SMALLEST)
    half = np.sqrt(3.0 * max(large - small, 0.0)) * axes[:, 1]
    return np.array([cx, cy, *half, radius, level * total / (np.pi * radius**2), *look.mean])


def fit_streak(patch: Patch, values: Array, look: Look) -> StreakFit:
    """Least squares from first values (9,), by Gauss-Newton, with a prior on edge and shading.

    Where the fit ends far from where it began, the pixels around the end are fitted once more.
    """
    fit = _fitted(patch, values, look)
    if fit.settled and np.abs(fit.values[:5] - values[:5]).max() > DRIFT:
        return _fitted(patch, fit.values, look)
    return fit


def _fitted(patch: Patch, values: Array, look: Look) -> StreakFit:
    values = values.copy()
    near = _near(patch, values)
    close = patch.at(near[:: 1 + int(len(near) * _nodes(values[HALF]) / MOST_WORK)])
    total = _energy(patch.change, patch.noise)
    beyond = total - _energy(patch.change[near], patch.noise)
    share = len(near) / len(close.change)
    settled = False
    for turn in range(MOST_STEPS):
        normal, gradient, residual = _linearised(close, values, look)
        unexplained = max(beyond + share * _energy(residual, patch.noise), 0.0) / max(total, patch.noise**2)
        if unexplained > HOPELESS[min(turn, len(HOPELESS) - 1)]:
            break
        step = np.linalg.solve(normal, gradient)
        step *= min(1.0, LONGEST_STEP / max(np.abs(step[:5]).max(), LONGEST_STEP))
        values += step
        values[RADIUS] = max(values[RADIUS], SMALLEST)
        values[LOOK.start] = max(values[LOOK.start], SHARPEST)
        small = np.abs(step[:5]) < SETTLED
        small[HALF] |= (np.hypot(*values[HALF]) < BLUNT) & (np.abs(step[HALF]) < BLUNT / 2)
        settled = bool(small.all() and abs(step[CONTRAST]) < SAME * abs(values[CONTRAST]))
        if settled:
            break
    scatter = float(np.sqrt(residual @ residual / len(residual))) / patch.noise
    covariance = np.asarray(np.linalg.inv(normal), dtype=np.float64)
    tells = np.linalg.inv(covariance[LOOK, LOOK]) - look.information
    strength = float(np.sqrt(max(total, 0.0))) / patch.noise
    return StreakFit(values, covariance * max(scatter, 1.0) ** 2, tells, unexplained, strength, scatter, settled)


def _energy(change: Array32, noise: float) -> float:
    """Grey levels^2 in a change beyond what noise brings."""
    return float(change @ change) - len(change) * noise**2


def _near(patch: Patch, values: Array) -> NDArray[np.intp]:
    """Numbers of the pixels on the streak and around it: the rest of the patch is background to it."""
    length = max(float(np.hypot(*values[HALF])), SMALLEST)
    along_x, along_y = values[HALF] / length
    dx, dy = patch.x - np.float32(values[0]), patch.y - np.float32(values[1])
    along = dx * np.float32(along_x) + dy * np.float32(along_y)
    along -= np.clip(along, np.float32(-length), np.float32(length))
    across = dx * np.float32(along_y) - dy * np.float32(along_x)
    ring = np.float32(REACH * values[RADIUS] + RING)
    if not values[HALF].any():
        across, along = dx, dy
    return np.flatnonzero(along * along + across * across < ring * ring)


def _linearised(patch: Patch, values: Array, look: Look) -> tuple[Array, Array, Array32]:
    """Normal matrix (9, 9) and right side (9,) of a step, residual (m,)."""
    coverage, parts = swept(patch.x, patch.y, values)
    height = np.float32(values[CONTRAST]) - patch.background
    brightness = np.float32(values[CONTRAST] + patch.level)
    lit = values[LOOK][1:].astype(np.float32) @ parts[6:]
    residual = patch.change - coverage * height - brightness * lit
    columns = np.empty((9, coverage.size), dtype=np.float32)
    np.multiply(parts[:5], height, out=columns[:5])
    np.add(coverage, lit, out=columns[CONTRAST])
    np.multiply(parts[5], height, out=columns[6])
    np.multiply(parts[6:], brightness, out=columns[7:])
    normal = (columns @ columns.T).astype(np.float64) / patch.noise**2
    gradient = (columns @ residual).astype(np.float64) / patch.noise**2
    everywhere = np.arange(9)
    normal[everywhere, everywhere] *= 1.0 + SINGLE  # positive definite for all the rounding
    normal[[0, 1, RADIUS], [0, 1, RADIUS]] += WIDEST**-2
    normal[CONTRAST, CONTRAST] += BRIGHTEST**-2
    normal[[2, 3], [2, 3]] += LONGEST_HALF**-2
    gradient[HALF] -= values[HALF] * LONGEST_HALF**-2
    normal[LOOK, LOOK] += look.information
    gradient[LOOK] += look.information @ (look.mean - values[LOOK])
    return normal, gradient, residual
