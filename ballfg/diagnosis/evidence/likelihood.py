"""The marginal likelihood of the tracks under a model with noise: first states and random motion are integrated out.

With the common unknowns integrated out too it is the evidence of the model, by Laplace's approximation.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.evidence.rows import COEFFICIENTS, SPIN_KINDS, Rows
from ballfg.diagnosis.fit.problem import LABEL_LOSS, POSITION_LOSS
from ballfg.diagnosis.fit.system import by_track
from ballfg.state import STATE_DIM

ROUNDED: Final = 1e-3  # Rounding of inner products from which a stretch is reduced by its rows themselves
ALMOST_NONE: Final = -4.0  # Logarithm of a size from which on there is some
LOST: Final = -1e6  # Logarithm of the density of a track under a model that rounding alone decides about
Weights = tuple[Array, Array, Array]  # Robust weights of samples (n, k) and spins (n,), and their cost (n,)


@dataclass(frozen=True)
class Noise:
    """Logarithms of the sizes: of white noise and spins (4,) over the stated ones, and of k kinds of random columns.

    Spins are those with a label, and the others forward, across and up.
    """

    white: float = 0.0
    spin: tuple[float, ...] = (0.0,) * SPIN_KINDS
    random: tuple[float, ...] = ()

    @property
    def scatters(self) -> bool:
        """Whether coefficients differ from track to track."""
        return max(self.random[COEFFICIENTS:], default=ALMOST_NONE) > ALMOST_NONE

    @property
    def calm(self) -> "Noise":
        """The same without such differences."""
        calm = (min(size, ALMOST_NONE) for size in self.random[COEFFICIENTS:])
        return replace(self, random=(*self.random[:COEFFICIENTS], *calm))

    @classmethod
    def least(cls, rows: Sequence[Rows]) -> "Noise":
        """Almost none beside that of the samples."""
        return cls(random=(ALMOST_NONE,) * max(COEFFICIENTS, 1 + int(rows[0].kinds.max())))

    @property
    def vector(self) -> Array:
        """(5 + k,) all of them."""
        return np.array([self.white, *self.spin, *self.random])

    @classmethod
    def of(cls, vector: Array) -> "Noise":
        """The noise of (5 + k,) logarithms."""
        spin, random = vector[1 : 1 + SPIN_KINDS], vector[1 + SPIN_KINDS :]
        return cls(float(vector[0]), tuple(spin.tolist()), tuple(random.tolist()))


@dataclass(frozen=True)
class Reduced:
    """The likelihood without first states and random motion, quadratic in the common unknowns."""

    constant: Array  # (n,) what does not depend on them, without the square of the residual
    gram: Array  # (n, c + 1, c + 1) inner products of common columns and the residual, last, over the noise

    def by_track(self, track: Index) -> "Reduced":
        """Summed over the stretches of each track; track: (n,) their numbers."""
        gram = by_track(self.gram, track)
        return Reduced(by_track(self.constant[:, None, None], track)[:, 0, 0], gram)

    def of(self, tracks: Mask) -> "Reduced":
        """The part of some tracks, summed."""
        return Reduced(self.constant[tracks].sum(keepdims=True), self.gram[tracks].sum(axis=0, keepdims=True))


@dataclass(frozen=True)
class Local:
    """The eliminated unknowns of each stretch."""

    lower: Array  # (n, l, l) triangle of the information on first states and random motion
    solved: Array  # (n, c + 1, l) inner products of common columns and the residual with them, over the triangle


@dataclass(frozen=True)
class Posterior:
    """Evidence of a model, and mean (c,) and covariance (c, c) of its common unknowns, as steps from the fit.

    `square` is that of all rows and priors, over their variances, at the mean; `prior` is the logarithm of the priors'
    density there over that at their own means.
    """

    evidence: float
    square: float
    prior: float
    mean: Array
    covariance: Array

    def gain(self, own: int | None = None) -> float:
        """Gain in the logarithm of the density by the step of the first `own` unknowns to their mean; None: of all."""
        return 0.5 * float(self.mean[:own] @ np.linalg.solve(self.covariance[:own, :own], self.mean[:own]))

    def held(self, own: int | None = None) -> "Posterior":
        """The same with the density of the tracks where the first `own` unknowns are, and the others follow them."""
        gain, follow = self.gain(own), self.covariance[:, :own] @ np.linalg.inv(self.covariance[:own, :own])
        mean = self.mean - follow @ self.mean[:own]
        return replace(self, evidence=self.evidence - gain, square=self.square + 2.0 * gain, mean=mean)


@dataclass(frozen=True)
class Likelihood:
    """Inner products of the rows of one batch under some robust weights."""

    rows: Rows  # Of a fit
    samples: Array  # (n, k) robust weights
    spins: Array  # (n,) robust weights
    penalty: Array  # (n,) their cost

    @cached_property
    def spin_columns(self) -> Array:
        """(n, 3, d) weighted spin rows: columns start, random, common, residual."""
        r = self.rows
        rows = (r.by_start[:, -3:], r.random[:, -3:], r.by_common[:, -3:], r.residual[:, -3:, None])
        return np.concatenate(rows, axis=-1) * np.sqrt(self.spins)[:, None, None]

    @cached_property
    def gram(self) -> Array:
        """(n, d, d) inner products of the samples; columns start, random, common, residual."""
        return self.rows.gram - self.rows.inner_products(1.0 - self.samples)

    def inner(self, noise: Noise) -> tuple[Array, Array]:
        """(n, d, d) information with priors of the random columns, and (n,) logarithms of the sizes."""
        logs = np.array(noise.spin)[self.rows.spin_kinds]
        spins = self.spin_columns * np.exp(-logs)[..., None]
        total = self.gram * np.exp(-2.0 * noise.white)
        total += spins.swapaxes(1, 2) @ spins  # in place: a new array of this size costs more than the sum
        kinds, first = self.rows.kinds, np.arange(STATE_DIM)
        sizes = np.append(noise.random, 0.0)[kinds]
        place = STATE_DIM + np.arange(kinds.shape[1])
        total[:, place, place] += np.exp(-2.0 * sizes)
        total[:, first, first] += total[:, first, first] == 0.0
        count = 3.0 * self.rows.used.sum(axis=1)
        return total, -count * noise.white - logs.sum(axis=1) - sizes.sum(axis=1)

    def reduced(self, noise: Noise) -> tuple[Reduced, Local]:
        """First states and random motion integrated out; stretches that leave all numbers have no density."""
        total, logs = self.inner(noise)
        end = STATE_DIM + self.rows.kinds.shape[1]
        rounding = np.diagonal(total, axis1=1, axis2=2).max(axis=1) * np.finfo(np.float64).eps
        lost = ~(rounding < 1.0)  # rounding alone is a unit of evidence
        total[lost] = np.eye(total.shape[-1])
        gram, kept = total[:, end:, end:].copy(), np.arange(end, total.shape[-1])
        # its triangle below the eliminated rows is the same whatever these hold; large, they stay definite
        total[:, kept, kept] += 1.0 + total[:, kept, kept]
        triangle = np.asarray(np.linalg.cholesky(total), dtype=np.float64)
        lower, solved = triangle[:, :end, :end], triangle[:, end:, :end]
        gram -= solved @ solved.swapaxes(1, 2)
        for one in np.flatnonzero(~lost & (rounding > ROUNDED)).tolist():
            triangle[one] = self._from_rows(noise, one)
            gram[one] = triangle[one, end:, end:] @ triangle[one, end:, end:].T
        narrow = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
        constant = np.where(lost, -np.inf, logs + self.rows.volume - narrow - self.penalty)
        return Reduced(constant, gram), Local(lower, solved)

    def _from_rows(self, noise: Noise, one: int) -> Array:
        """(d, d) the triangle of a stretch, from its rows: their inner products lose half of the digits."""
        r, count = self.rows, 3 * self.rows.used.shape[1]
        listed = (r.by_start, r.random, r.by_common, r.residual[..., None])
        columns = np.concatenate([part[one] for part in listed], axis=-1)
        weights = np.exp(-noise.white) * np.sqrt(np.repeat(self.samples[one] * r.used[one], 3))
        spins = self.spin_columns[one] * np.exp(-np.array(noise.spin)[r.spin_kinds[one]])[:, None]
        rows, size = np.concatenate((columns[:count] * weights[:, None], spins)), columns.shape[-1]
        priors, end = np.zeros(size), STATE_DIM + r.kinds.shape[1]
        priors[:STATE_DIM] = ~rows[:, :STATE_DIM].any(axis=0)
        priors[STATE_DIM:end] = np.exp(-np.append(noise.random, 0.0)[r.kinds[one]])
        upper: Array = np.asarray(np.linalg.qr(np.concatenate((rows, np.diag(priors))), mode="r"))
        return (upper * np.where(np.diagonal(upper) < 0.0, -1.0, 1.0)[:, None]).T

    def local_step(self, noise: Noise, common: Array) -> Array:
        """(n, l) first states and random motion that follow a step (c,) of the common unknowns."""
        total, _ = self.inner(noise)
        end = STATE_DIM + self.rows.kinds.shape[1]
        right = total[:, :end, -1] - total[:, :end, end:-1] @ common
        return np.asarray(np.linalg.solve(total[:, :end, :end], right[..., None])[..., 0])

    def reweighted(self, noise: Noise) -> "Likelihood":
        """With the robust weights of the residual that remains beside the motion, all common unknowns as they are."""
        common = np.zeros(self.rows.by_common.shape[-1])
        motion = self.local_step(noise, common)
        kept = np.broadcast_to(np.append(common, 1.0), (len(motion), len(common) + 1))
        return self.beside(np.concatenate((-motion, kept), axis=1), noise)

    def beside(self, along: Array, noise: Noise) -> "Likelihood":
        """With the robust weights of a residual, the sum of columns by factors (n, d)."""
        r, end = self.rows, STATE_DIM + self.rows.kinds.shape[1]
        start, random, common = along[:, :STATE_DIM], along[:, STATE_DIM:end], along[:, end:-1]
        left = r.residual + (r.by_start @ start[..., None] + r.random @ random[..., None])[..., 0]
        left += (r.by_common @ common[..., None])[..., 0]
        return weighted(r, left / np.exp(noise.white), left[:, -3:] / np.exp(noise.spin)[r.spin_kinds])


@dataclass(frozen=True)
class Batches:
    """The likelihood of all stretches; parts: that of each batch."""

    parts: tuple[Likelihood, ...]
    _known: dict[Noise, tuple[Reduced, list[Local]]] = field(default_factory=dict)

    @classmethod
    def of(cls, rows: Sequence[Rows], weights: Sequence[Weights] | None = None) -> "Batches":
        """The likelihood of rows; weights: of each batch, one if None."""
        if weights is None:
            return cls(tuple(unweighted(batch) for batch in rows))
        return cls(tuple(Likelihood(batch, *own) for batch, own in zip(rows, weights, strict=True)))

    @property
    def weights(self) -> tuple[Weights, ...]:
        """The robust weights of samples and spins, and their cost, of each batch."""
        return tuple((part.samples, part.spins, part.penalty) for part in self.parts)

    @property
    def counts(self) -> Array:
        """As of `Rows`."""
        return np.sum([part.rows.counts for part in self.parts], axis=0)

    def reduced(self, noise: Noise) -> tuple[Reduced, list[Local]]:
        """First states and random motion integrated out, and what was eliminated in each batch."""
        if noise not in self._known:
            parts, local = zip(*(part.reduced(noise) for part in self.parts), strict=True)
            order = np.argsort(np.concatenate([part.rows.numbers for part in self.parts]))
            arrays = (np.concatenate([getattr(r, name) for r in parts])[order] for name in ("constant", "gram"))
            self._known[noise] = Reduced(*arrays), list(local)
        return self._known[noise]

    def reweighted(self, noise: Noise) -> "Batches":
        """As of `Likelihood`."""
        return Batches(tuple(part.reweighted(noise) for part in self.parts))

    def beside(self, along: Sequence[Array], noise: Noise) -> "Batches":
        """As of `Likelihood`, by the factors of each batch."""
        return Batches(tuple(part.beside(own, noise) for part, own in zip(self.parts, along, strict=True)))


def unweighted(rows: Rows) -> Likelihood:
    """The likelihood with robust weights of one."""
    return weighted(rows, np.zeros_like(rows.residual), np.zeros((len(rows.residual), 3)))


def weighted(rows: Rows, left: Array, spins: Array) -> Likelihood:
    """The likelihood with the robust weights of whitened residuals of samples (n, m) and spins (n, 3)."""
    n, k = rows.used.shape
    length = np.linalg.norm(left[:, :-3].reshape(n, k, 3), axis=-1) * rows.used
    spin = np.linalg.norm(spins, axis=-1) * rows.labelled
    samples, labels = POSITION_LOSS.weight(length), LABEL_LOSS.weight(spin)
    penalty = (POSITION_LOSS.value(length) - 0.5 * samples * length**2).sum(axis=1)
    return Likelihood(rows, samples, labels, penalty + LABEL_LOSS.value(spin) - 0.5 * labels * spin**2)


def posterior(reduced: Reduced, precision: Array, away: Array) -> Posterior:
    """The evidence with all common unknowns integrated out; minus infinity and the prior if rounding left nothing.

    Args: precision: (c,) of their priors.  away: (c,) prior mean less present value.
    """
    total = reduced.gram.sum(axis=0)
    information, gradient = total[:-1, :-1] + np.diag(precision), total[:-1, -1] + precision * away
    lower = triangle(information)
    if not np.isfinite(lower).all():
        return Posterior(-np.inf, np.inf, 0.0, np.zeros_like(away), np.diag(1.0 / precision))
    covariance = np.linalg.inv(information)
    mean = covariance @ gradient
    square = total[-1, -1] - gradient @ mean + float((precision * away**2).sum())
    narrow = np.log(np.diagonal(lower)).sum() - 0.5 * np.log(precision).sum()
    evidence, prior = reduced.constant.sum() - 0.5 * square - narrow, -0.5 * (precision * (mean - away) ** 2).sum()
    return Posterior(float(evidence), float(square), float(prior), mean, covariance)


def evidences(reduced: Reduced, precision: Array, away: Array) -> Array:
    """(n,) the evidence of each part alone, with all common unknowns integrated out; NaN if rounding left nothing.

    Args: as in `posterior`.
    """
    information = reduced.gram[:, :-1, :-1] + np.diag(precision)
    gradient = reduced.gram[:, :-1, -1] + precision * away
    lower = triangle(information)
    solved = np.linalg.solve(lower, gradient[..., None])[..., 0]
    square = reduced.gram[:, -1, -1] - (solved**2).sum(axis=-1) + float((precision * away**2).sum())
    narrow = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=-1) - 0.5 * np.log(precision).sum()
    return np.asarray(reduced.constant - 0.5 * square - narrow)


def triangle(information: Array) -> Array:
    """The triangle of matrices (..., c, c); NaN of those that rounding left indefinite, about a path far off, say."""
    try:
        return np.asarray(np.linalg.cholesky(information))
    except np.linalg.LinAlgError:
        if information.ndim == 2:
            return np.full_like(information, np.nan)
        return np.stack([triangle(one) for one in information])


def held_out(tracks: Reduced, precision: Array, away: Array, halves: Mask) -> Array:
    """(t,) logarithm of the density of each track, with common unknowns from the tracks of the other half.

    It is `LOST` of all tracks if one has no density: they bear nothing out.

    Args: tracks: the part of each.  precision, away: as in `posterior`.  halves: (t,) which half each belongs to.
    """
    found = np.zeros(len(halves))
    for half in (True, False):
        own, others = halves == half, tracks.of(halves != half)
        more = Reduced(others.constant + tracks.constant[own], others.gram + tracks.gram[own])
        found[own] = evidences(more, precision, away) - evidences(others, precision, away)
    return found if np.isfinite(found).all() else np.full(len(found), LOST)
