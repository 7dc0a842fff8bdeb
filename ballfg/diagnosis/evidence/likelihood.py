"""The marginal likelihood of the tracks under a model with noise: first states and random motion are integrated out.

Sizes of the noise maximise it for each model, so that what a wrong model cannot explain counts as its noise. Common
unknowns have their priors; with them integrated out too the likelihood is the evidence of the model, by Laplace's
approximation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from scipy import linalg

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.evidence.rows import Rows
from ballfg.diagnosis.fit.problem import LABEL_LOSS, POSITION_LOSS
from ballfg.diagnosis.fit.system import by_track
from ballfg.state import STATE_DIM

LEAST, MOST = -5.0, 5.0
"""Bounds of the logarithm of a size over its unit."""
MOST_STEPS, SETTLED = 30, 0.02
"""Largest number of steps of the sizes, and the gain of evidence that ends them."""
LONGEST: Final = 1.5
"""Largest step of the logarithm of a size."""


@dataclass(frozen=True)
class Noise:
    """Logarithms of the sizes: of white noise and spin rows over the stated ones, and of random motion (4,)."""

    white: float = 0.0
    spin: float = 0.0
    random: tuple[float, ...] = (-4.0,) * 4

    @property
    def vector(self) -> Array:
        """(6,) all of them."""
        return np.array([self.white, self.spin, *self.random])

    @classmethod
    def of(cls, vector: Array) -> Noise:
        """The noise of (6,) logarithms."""
        return cls(float(vector[0]), float(vector[1]), tuple(vector[2:].tolist()))


@dataclass(frozen=True)
class Reduced:
    """The likelihood without first states and random motion, quadratic in the common unknowns.

    Attributes:
        constant: (n,) what does not depend on them, without the square of the residual.
        gram: (n, c + 1, c + 1) inner products of common columns and the residual, last, over the noise.
    """

    constant: Array
    gram: Array

    def by_track(self, track: Index) -> Reduced:
        """Summed over the stretches of each track; track: (n,) their numbers."""
        gram = by_track(self.gram, track)
        return Reduced(by_track(self.constant[:, None, None], track)[:, 0, 0], gram)

    def of(self, tracks: Mask) -> Reduced:
        """The part of some tracks, summed."""
        return Reduced(self.constant[tracks].sum(keepdims=True), self.gram[tracks].sum(axis=0, keepdims=True))


@dataclass(frozen=True)
class Local:
    """The eliminated unknowns of each stretch.

    Attributes:
        lower: (n, l, l) triangle of the information on first states and random motion.
        solved: (n, c + 1, l) inner products of common columns and the residual with them, over the triangle.
    """

    lower: Array
    solved: Array


@dataclass(frozen=True)
class Posterior:
    """Evidence of a model, and mean (c,) and covariance (c, c) of its common unknowns, as steps from the fit.

    `square` is that of all rows and priors, over their variances, at the mean.
    """

    evidence: float
    square: float
    mean: Array
    covariance: Array

    def gain(self, own: int | None = None) -> float:
        """Gain in the logarithm of the density by the step of the first `own` unknowns to their mean; None: of all."""
        return 0.5 * float(self.mean[:own] @ np.linalg.solve(self.covariance[:own, :own], self.mean[:own]))

    def held(self, own: int | None = None) -> Posterior:
        """The same with the density of the tracks where the first `own` unknowns are, and the others follow them."""
        gain, follow = self.gain(own), self.covariance[:, :own] @ np.linalg.inv(self.covariance[:own, :own])
        mean = self.mean - follow @ self.mean[:own]
        return Posterior(self.evidence - gain, self.square + 2.0 * gain, mean, self.covariance)


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the evidence by the logarithms of the sizes: slope (6,) and average information (6, 6).

    `along` (n, d) are factors of the columns start, random, common, residual whose sum is the residual at the mean,
    one for the residual.
    """

    slope: Array
    information: Array
    along: Array


@dataclass(frozen=True)
class Likelihood:
    """Inner products of the rows under some robust weights.

    Attributes:
        rows: of a fit.
        samples, spins: (n, k) and (n,) robust weights.
        penalty: (n,) their cost.
    """

    rows: Rows
    samples: Array
    spins: Array
    penalty: Array

    @cached_property
    def spin_columns(self) -> Array:
        """(n, 3, d) weighted spin rows: columns start, random, common, residual."""
        r = self.rows
        rows = (r.by_start[:, -3:], r.motion.columns[:, -3:], r.by_common[:, -3:], r.residual[:, -3:, None])
        return np.concatenate(rows, axis=-1) * np.sqrt(self.spins)[:, None, None]

    @cached_property
    def grams(self) -> tuple[Array, Array]:
        """Two (n, d, d): of the samples, and of the spin rows; columns start, random, common, residual."""
        spins = self.spin_columns
        return self.rows.gram - self.rows.inner_products(1.0 - self.samples), spins.swapaxes(1, 2) @ spins

    def inner(self, noise: Noise) -> tuple[Array, Array]:
        """(n, d, d) information with priors of the random columns, and (n,) logarithms of the sizes."""
        of_samples, of_spins = self.grams
        total = of_samples * np.exp(-2.0 * noise.white)
        total += of_spins * np.exp(-2.0 * noise.spin)
        kinds, first = self.rows.motion.kinds, np.arange(STATE_DIM)
        sizes = np.append(noise.random, 0.0)[kinds]
        place = STATE_DIM + np.arange(kinds.shape[1])
        total[:, place, place] += np.exp(-2.0 * sizes)
        total[:, first, first] += total[:, first, first] == 0.0
        count = 3.0 * self.rows.used.sum(axis=1)
        return total, -count * noise.white - 3.0 * noise.spin - sizes.sum(axis=1)

    def reduced(self, noise: Noise) -> tuple[Reduced, Local]:
        """First states and random motion integrated out."""
        total, logs = self.inner(noise)
        end = STATE_DIM + self.rows.motion.kinds.shape[1]
        gram, kept = total[:, end:, end:].copy(), np.arange(end, total.shape[-1])
        # its triangle below the eliminated rows is the same whatever these hold; large, they stay definite
        total[:, kept, kept] += 1.0 + total[:, kept, kept]
        triangle = np.asarray(np.linalg.cholesky(total), dtype=np.float64)
        lower, solved = triangle[:, :end, :end], triangle[:, end:, :end]
        narrow = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=1)
        constant = logs + self.rows.volume - narrow - self.penalty
        return Reduced(constant, gram - solved @ solved.swapaxes(1, 2)), Local(lower, solved)

    def slopes(self, noise: Noise, local: Local, found: Posterior, precision: Array, away: Array) -> Slopes:
        """The derivatives of the evidence by the logarithms of the sizes.

        The slope is expected squares less their number. The expected squares over their variances of all rows and
        priors add up to the square at the mean plus one for each unknown, so that those of the samples follow from the
        others. The average of the observed and the expected information needs no traces: A. R. Gilmour, R. Thompson,
        B. R. Cullis, "Average information REML", Biometrics 51, 1995.
        """
        kinds = self.rows.motion.kinds
        end = STATE_DIM + kinds.shape[1]
        upper = inverses(local.lower)
        solved = upper @ local.solved.swapaxes(1, 2)  # (n, l, c + 1), what local unknowns absorb of each column
        step, root = np.append(-found.mean, 1.0), np.linalg.cholesky(found.covariance)
        mean, moved = solved @ step, solved[..., :-1] @ root
        squares = mean**2 + (upper**2).sum(axis=-1) + (moved**2).sum(axis=-1)
        own = [squares[:, STATE_DIM:][kinds == kind] for kind in range(len(noise.random))]
        shown = [float(o.sum()) * np.exp(-2.0 * log) for o, log in zip(own, noise.random, strict=True)]
        spins = self.spin_columns
        left = spins[..., end:] @ step - (spins[..., :end] @ mean[..., None])[..., 0]
        scattered = (spins[..., end:-1] - spins[..., :end] @ solved[..., :-1]) @ root
        square = (left**2).sum() + (scattered**2).sum() + ((spins[..., :end] @ upper) ** 2).sum()
        spin = float(square) * np.exp(-2.0 * noise.spin)
        prior = float(precision @ ((away - found.mean) ** 2 + np.diagonal(found.covariance)))
        of_samples, of_spins = (np.diagonal(gram, axis1=1, axis2=2)[:, :STATE_DIM] for gram in self.grams)
        unseen = int((of_samples + of_spins == 0.0).sum()) + int((kinds < 0).sum())  # `inner` gives them a prior
        unknowns = mean.shape[0] * end - unseen + len(found.mean)
        white = found.square + float(unknowns) - sum(shown) - spin - prior
        slope = np.array([white, spin, *shown]) - self.rows.counts
        along = np.concatenate((-mean, np.broadcast_to(step, (len(mean), len(step)))), axis=1)
        return Slopes(slope, self._information(noise, upper, local.solved, along, found.covariance), along)

    def _information(self, noise: Noise, upper: Array, solved: Array, along: Array, covariance: Array) -> Array:
        """(6, 6) twice the inner products of what each size's rows or columns show, less what all unknowns absorb.

        Args: along: (n, d) factors of the columns whose sum is the residual at the mean.
        """
        kinds, (of_samples, of_spins) = self.rows.motion.kinds, self.grams
        end = STATE_DIM + kinds.shape[1]
        ahead = np.zeros((*along.shape, len(noise.random)))  # of the random columns alone, kind by kind
        for kind in range(len(noise.random)):
            ahead[:, STATE_DIM:end, kind] = -along[:, STATE_DIM:end] * (kinds == kind)
        white, spin = np.exp(-2.0 * noise.white), np.exp(-2.0 * noise.spin)
        factors = np.concatenate((along[..., None], ahead), axis=-1)
        samples, spins = white * (of_samples @ factors), spin * (of_spins @ factors)
        rows = np.concatenate((samples[..., :1], spins[..., :1], samples[..., 1:] + spins[..., 1:]), axis=-1)
        products = np.zeros((rows.shape[-1],) * 2)
        products[2:] = np.einsum("nda,ndb->ab", ahead, rows)
        products[:2, 2:] = products[2:, :2].T
        products[0, 0], products[1, 1] = (float((along * r[..., 0]).sum()) for r in (samples, spins))
        local = upper.swapaxes(1, 2) @ rows[:, :end]
        common = (rows[:, end:-1] - solved[:, :-1] @ local).sum(axis=0)
        return 2.0 * (products - np.einsum("nla,nlb->ab", local, local) - common.T @ covariance @ common)

    def local_step(self, noise: Noise, common: Array) -> Array:
        """(n, l) first states and random motion that follow a step (c,) of the common unknowns."""
        total, _ = self.inner(noise)
        end = STATE_DIM + self.rows.motion.kinds.shape[1]
        right = total[:, :end, -1] - total[:, :end, end:-1] @ common
        return np.asarray(np.linalg.solve(total[:, :end, :end], right[..., None])[..., 0])

    def reweighted(self, noise: Noise, common: Array) -> Likelihood:
        """With the robust weights of the residual that remains beside the motion; common: (c,) step of the unknowns."""
        step = np.append(-common, 1.0)
        motion = self.local_step(noise, common)
        return self.beside(np.concatenate((-motion, np.broadcast_to(step, (len(motion), len(step)))), axis=1), noise)

    def beside(self, along: Array, noise: Noise) -> Likelihood:
        """With the robust weights of a residual, the sum of columns by factors (n, d)."""
        r, end = self.rows, STATE_DIM + self.rows.motion.kinds.shape[1]
        start, random, common = along[:, :STATE_DIM], along[:, STATE_DIM:end], along[:, end:-1]
        left = r.residual + (r.by_start @ start[..., None] + r.motion.columns @ random[..., None])[..., 0]
        left += (r.by_common @ common[..., None])[..., 0]
        return weighted(r, left / np.exp(noise.white), left[:, -3:] / np.exp(noise.spin))


def weighted(rows: Rows, left: Array, spins: Array) -> Likelihood:
    """The likelihood with the robust weights of whitened residuals of samples (n, m) and spins (n, 3)."""
    n, k = rows.used.shape
    length = np.linalg.norm(left[:, :-3].reshape(n, k, 3), axis=-1) * rows.used
    spin = np.linalg.norm(spins, axis=-1) * rows.labelled
    samples, labels = POSITION_LOSS.weight(length), LABEL_LOSS.weight(spin)
    penalty = (POSITION_LOSS.value(length) - 0.5 * samples * length**2).sum(axis=1)
    return Likelihood(rows, samples, labels, penalty + LABEL_LOSS.value(spin) - 0.5 * labels * spin**2)


def posterior(reduced: Reduced, precision: Array, away: Array) -> Posterior:
    """The evidence with all common unknowns integrated out.

    Args: precision: (c,) of their priors.  away: (c,) prior mean less present value.
    """
    total = reduced.gram.sum(axis=0)
    information, gradient = total[:-1, :-1] + np.diag(precision), total[:-1, -1] + precision * away
    lower = np.linalg.cholesky(information)
    covariance = np.linalg.inv(information)
    mean = covariance @ gradient
    square = total[-1, -1] - gradient @ mean + float((precision * away**2).sum())
    narrow = np.log(np.diagonal(lower)).sum() - 0.5 * np.log(precision).sum()
    return Posterior(float(reduced.constant.sum() - 0.5 * square - narrow), float(square), mean, covariance)


def evidences(reduced: Reduced, precision: Array, away: Array) -> Array:
    """(n,) the evidence of each part alone, with all common unknowns integrated out; arguments as in `posterior`."""
    information = reduced.gram[:, :-1, :-1] + np.diag(precision)
    gradient = reduced.gram[:, :-1, -1] + precision * away
    lower = np.linalg.cholesky(information)
    solved = np.linalg.solve(lower, gradient[..., None])[..., 0]
    square = reduced.gram[:, -1, -1] - (solved**2).sum(axis=-1) + float((precision * away**2).sum())
    narrow = np.log(np.diagonal(lower, axis1=1, axis2=2)).sum(axis=-1) - 0.5 * np.log(precision).sum()
    return np.asarray(reduced.constant - 0.5 * square - narrow)


def held_out(tracks: Reduced, precision: Array, away: Array, halves: Mask) -> Array:
    """(t,) logarithm of the density of each track, with common unknowns from the tracks of the other half.

    Args: tracks: the part of each.  precision, away: as in `posterior`.  halves: (t,) which half each belongs to.
    """
    found = np.zeros(len(halves))
    for half in (True, False):
        own, others = halves == half, tracks.of(halves != half)
        more = Reduced(others.constant + tracks.constant[own], others.gram + tracks.gram[own])
        found[own] = evidences(more, precision, away) - evidences(others, precision, away)
    return found


def settled(
    rows: Rows, precision: Array, away: Array, starts: Sequence[Noise | None] = (None,), own: int | None = None
) -> tuple[Likelihood, Noise]:
    """The likelihood with the robust weights and sizes of noise that maximise the evidence at the present unknowns.

    Not at those to which it leads: a long step leaves the linear range. There are several maxima: noise that a wrong
    model needed can keep a right one from showing that it needs none.

    Args:
        precision, away: as in `posterior`.
        starts: noise of similar models, or None for almost none beside that of the samples; the best end counts.
        own: number of the common unknowns, the first ones, in which the rows are not linear; None: all.
    """
    plain = weighted(rows, np.zeros_like(rows.residual), np.zeros((len(rows.residual), 3)))
    none = np.zeros(len(precision))
    begun = [(plain.reweighted(start, none) if start else plain, start or Noise()) for start in starts]
    ends = [_climbed(*one, precision, away, own) for one in begun]
    _, likelihood, noise = max(ends, key=lambda end: end[0])
    return likelihood, noise


def _climbed(
    likelihood: Likelihood, noise: Noise, precision: Array, away: Array, own: int | None
) -> tuple[float, Likelihood, Noise]:
    """The largest evidence near a start, by steps with the average information, the weights following the sizes."""

    def at(likelihood: Likelihood, noise: Noise) -> tuple[Posterior, Slopes]:
        reduced, local = likelihood.reduced(noise)
        found = posterior(reduced, precision, away).held(own)
        return found, likelihood.slopes(noise, local, found, precision, away)

    found, slopes = at(likelihood, noise)
    for _ in range(MOST_STEPS):
        step = _bounded_step(noise.vector, slopes)
        gain, share, promised = -np.inf, 1.0, 0.5 * float(step @ slopes.slope)
        while gain <= 0.0 and (share == 1.0 or share * promised > SETTLED):
            moved = Noise.of(noise.vector + share * step)
            weights = likelihood.beside(slopes.along, moved)
            after, derivatives = at(weights, moved)
            gain, share = after.evidence - found.evidence, 0.5 * share
        if gain > 0.0:
            likelihood, noise, found, slopes = weights, moved, after, derivatives
        if gain < SETTLED:
            break
    return found.evidence, likelihood, noise


def _bounded_step(sizes: Array, slopes: Slopes) -> Array:
    """(6,) step of the logarithms of the sizes (6,), within their bounds; each is damped by its slope."""
    slope, curved = slopes.slope, slopes.information + np.diag(np.abs(slopes.slope)) / LONGEST
    free = np.flatnonzero(~((sizes <= LEAST) & (slope <= 0.0) | (sizes >= MOST) & (slope >= 0.0)))
    step = np.zeros(len(sizes))
    step[free] = np.linalg.lstsq(curved[np.ix_(free, free)], slope[free])[0]
    return np.clip(sizes + step, LEAST, MOST) - sizes


def inverses(lower: Array) -> Array:
    """(n, l, l) transposed inverses of triangles (n, l, l)."""
    return np.stack([linalg.lapack.dtrtri(one.T)[0] for one in lower])
