"""Interpolates paths by local polynomials that do not extend across bounces, with interpolation errors.

A path is a sequence of samples cut into smooth parts. Between two samples of one part the value is that of the cubic
through the nearest four. Between two parts, where the path has a kink, both sides are continued to where they meet.
No value exists before the first sample, after the last, or in a long gap.
"""

from dataclasses import dataclass
from itertools import pairwise
from typing import Final

import numpy as np
from scipy.stats import chi2

from ballfg.arrays import Array, Index, Mask

MAX_GAP: Final = 0.06  # s, longest bridged gap between two samples of a smooth part: three frames lost at 60 Hz
RATE_OF_CHANGE: Final = 5.0
"""1/s, change of an acceleration by its own size (15 m/s at 3 m); its power times that is left out by a polynomial."""
KINK_CHANCE: Final = 1e-5  # probability with which noise alone passes for a kink
_SAME: Final = 1e-6  # s, a time this close to a sample is the sample's
_INSIDE: Final = 4  # samples of the cubic between two samples
_ASIDE: Final = 5  # samples of the quadratic that continues a part towards a kink: one would do with three, but noisily
_WING: Final = 3  # samples on either side of an interval in the test for a kink


@dataclass(frozen=True, eq=False)
class Path:
    """Samples in order of time; values of any dimension d (2: an image, 3: space)."""

    times: Array  # (n,) s, strictly increasing
    values: Array  # (n, d)
    covariances: Array  # (n, d, d)
    parts: Index  # (n,) number of the smooth part that a sample belongs to, from 0, rising by at most one

    def at(self, times: Array) -> tuple[Array, Array]:
        """Values (k, d) at times (k,) and their covariances (k, d, d), interpolation error included; NaN if unknown."""
        d = self.values.shape[1]
        values, covariances = np.full((len(times), d), np.nan), np.full((len(times), d, d), np.nan)
        if len(self.times) < 2:
            return values, covariances
        right = np.clip(np.searchsorted(self.times, times), 1, len(self.times) - 1)
        gap = self.times[right] - self.times[right - 1]
        known = (times >= self.times[0]) & (times <= self.times[-1]) & (gap <= MAX_GAP)
        smooth = self.parts[right] == self.parts[right - 1]
        side = self._side(times, right, known & ~smooth)
        which = np.flatnonzero(known)
        values[which], covariances[which] = self._fitted(times[which], side[which], _INSIDE)
        nearest = right - (times - self.times[right - 1] < self.times[right] - times)
        same = np.abs(times - self.times[nearest]) <= _SAME
        values[same], covariances[same] = self.values[nearest[same]], self.covariances[nearest[same]]
        return values, covariances

    def beyond(self, times: Array, last: bool) -> tuple[Array, Array]:
        """The same before the first sample or after the last (k,), continued from the part there."""
        side = np.full(len(times), len(self.times) - 1 if last else 0)
        return self._fitted(times, side, _ASIDE)

    def _side(self, times: Array, right: Index, kinked: Mask) -> Index:
        """The sample, before or after a kink, on whose side of the kink each time lies; (k,)."""
        side = right.copy()
        which = np.flatnonzero(kinked)
        if not len(which):
            return side
        before, after = right[which] - 1, right[which]
        middle = 0.5 * (self.times[before] + self.times[after])
        position, speed = (
            self._fitted(middle, after, _ASIDE, order)[0] - self._fitted(middle, before, _ASIDE, order)[0]
            for order in (0, 1)
        )
        with np.errstate(invalid="ignore", divide="ignore"):
            meeting = middle - (position * speed).sum(axis=1) / (speed**2).sum(axis=1)
        meeting = np.where(np.isfinite(meeting), np.clip(meeting, self.times[before], self.times[after]), middle)
        side[which] = np.where(times[which] < meeting, before, after)
        return side

    def _fitted(self, times: Array, side: Index, most: int, order: int = 0) -> tuple[Array, Array]:
        """The `order`-th derivative, 0 or 1, of the polynomial through the samples near `side` in its part.

        Four samples make a cubic if the time lies between samples, else samples make a quadratic by least squares.
        """
        d = self.values.shape[1]
        values, covariances = np.full((len(times), d), np.nan), np.full((len(times), d, d), np.nan)
        first = np.searchsorted(self.parts, self.parts[side])
        stop = np.searchsorted(self.parts, self.parts[side], side="right")
        nearest = np.searchsorted(self.times, times)
        outside = (nearest <= first) | (nearest >= stop)
        count = np.minimum(np.where(outside, _ASIDE, most), stop - first)
        degree = np.minimum(np.where(outside, 2, _INSIDE - 1), count - 1)
        begin = np.clip(nearest - count // 2, first, stop - count)
        for points in np.unique(count[count >= 2]):
            for power in np.unique(degree[count == points]):
                rows = np.flatnonzero((count == points) & (degree == power))
                window = begin[rows, None] + np.arange(points)
                values[rows], covariances[rows] = self._polynomial(times[rows], window, int(power), order)
        return values, covariances

    def _polynomial(self, times: Array, window: Index, degree: int, order: int) -> tuple[Array, Array]:
        """Least squares over the samples `window` (k, w); what a polynomial leaves out goes into the covariance."""
        apart = self.times[window] - times[:, None]
        scale = np.abs(apart).max(axis=1)
        design = (apart / scale[:, None])[..., None] ** np.arange(degree + 1)
        solved = _least_squares(design)
        values = np.einsum("kw,kwd->kd", solved[:, order], self.values[window]) / scale[:, None] ** order
        covariances = np.einsum("kw,kwde->kde", solved[:, order] ** 2, self.covariances[window])
        near = np.sort(np.abs(apart), axis=1)[:, : degree + 1].prod(axis=1)
        # The size of the acceleration; two samples cannot tell it: speed times RATE_OF_CHANGE stands for it then.
        known = min(degree, 2)
        derivative = np.einsum("kw,kwd->kd", solved[:, known], self.values[window]) / scale[:, None] ** known
        bend = np.linalg.norm(derivative, axis=1) * (2.0 if known == 2 else RATE_OF_CHANGE)
        remainder = bend * near * RATE_OF_CHANGE ** max(degree - 1, 0)
        spread = (remainder / (2.0, 2.0, 6.0, 24.0)[degree]) ** 2
        eye = np.eye(values.shape[1])
        return values, covariances / scale[:, None, None] ** (2 * order) + spread[:, None, None] * eye


def path(times: Array, values: Array, covariances: Array) -> Path:
    """A path cut at its kinks and long gaps. Shapes as in `Path`."""
    cut = np.diff(times) > MAX_GAP
    edges = [0, *(np.flatnonzero(cut) + 1).tolist(), len(times)]
    for start, stop in pairwise(edges):
        cut[start : stop - 1] |= _kinks(times[start:stop], values[start:stop], covariances[start:stop])
    return Path(times, values, covariances, np.concatenate(([0], np.cumsum(cut))).astype(np.int64)[: len(times)])


def _least_squares(design: Array) -> Array:
    """(..., p, w) matrices that turn w values into p coefficients; `design` (..., w, p) has columns of size one."""
    transposed = np.swapaxes(design, -1, -2)
    return np.asarray(np.linalg.solve(transposed @ design, transposed))


def _kinks(times: Array, values: Array, covariances: Array) -> Mask:
    """(n - 1) True for intervals with a sharp bend: one cubic does not fit three samples on either side.

    A kink spoils the fits of the neighbouring intervals too; the worst of five marks it. If the path as a whole
    is rougher than its covariances say, a bend must stand out from this roughness.
    """
    n = len(times)
    if n < _INSIDE + 1:
        return np.zeros(max(n - 1, 0), dtype=bool)
    variance = np.trace(covariances, axis1=1, axis2=2) / values.shape[1]
    misfit, tolerance = np.zeros(n - 1), np.ones(n - 1)
    for left, right in ((_WING, _WING), (2, _WING), (_WING, 2)):
        k = np.arange(left - 1, n - right)
        if (left, right) != (_WING, _WING):
            k = k[(k == left - 1) & (left == 2)] if left == 2 else k[k == n - 1 - right]
        window = k[:, None] + np.arange(1 - left, right + 1)
        apart = times[window] - times[k, None]
        design = (apart / np.abs(apart).max(axis=1)[:, None])[..., None] ** np.arange(_INSIDE)
        seen = values[window]
        missed = seen - design @ (_least_squares(design) @ seen)
        degrees = values.shape[1] * (left + right - _INSIDE)
        misfit[k] = ((missed**2).sum(axis=2) / variance[window]).sum(axis=1) / chi2.median(degrees)
        tolerance[k] = chi2.isf(KINK_CHANCE, degrees) / chi2.median(degrees)
    typical = np.median(misfit[misfit > 0.0]) if (misfit > 0.0).any() else 1.0
    misfit /= tolerance * max(typical, 1.0)
    padded = np.pad(misfit, 2)
    around = np.stack([padded[shift : shift + n - 1] for shift in (0, 1, 3, 4)])
    return np.asarray((misfit > 1.0) & (misfit >= around.max(axis=0)))
