"""Finds the sizes of the noise that maximise the evidence, and damped steps to more probable common unknowns.

What a wrong model cannot explain counts as its noise.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.likelihood import Batches, Likelihood, Local, Noise, Posterior, Weights, posterior
from ballfg.diagnosis.evidence.rows import COEFFICIENTS, SPIN_KINDS, Rows
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.system import bounded_step
from ballfg.state import STATE_DIM

LEAST, MOST = -5.0, 5.0  # Bounds of the logarithm of a size over its unit
MOST_SCATTER: Final = 1.1
"""Largest logarithm of the scatter of a coefficient over the prior deviation of an unknown one: a factor of 3."""
MOST_STEPS, SETTLED = 30, 0.05  # Largest number of steps of the sizes, and the gain of evidence that ends them
ENOUGH: Final = 0.05
"""Share of what a step of the common unknowns should gain that ends the sizes' steps too: it will change them."""
LONGEST: Final = 1.5  # Largest step of the logarithm of a size
Sized = tuple[Batches, Noise]  # A likelihood with the sizes of its noise


@dataclass(frozen=True)
class Start:
    """Where a similar model's sizes and robust weights are; weights: batch by batch, one if None."""

    noise: Noise
    weights: Sequence[Weights] | None = None


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the evidence by the logarithms of the s sizes: slope (s,) and average information (s, s).

    `along` are, of each batch, the factors (n, d) of the columns start, random, common, residual whose sum is the
    residual at the mean, one for the residual.
    """

    slope: Array
    information: Array
    along: list[Array]


def settled(
    rows: Sequence[Rows],
    precision: Array,
    away: Array,
    starts: Sequence[Start | None] = (None,),
    own: int | None = None,
) -> Sized:
    """The likelihood with the robust weights and sizes of noise that maximise the evidence at the present unknowns.

    Not at those to which it leads: a long step leaves the linear range. There are several maxima: noise that a wrong
    model needed can keep a right one from showing that it needs none.

    Args: precision, away: as in `posterior`.  starts: of similar models, or None for almost no noise beside that of the
        samples; the best end counts.  own: number of the first unknowns, in which rows are not linear; None: all.
    """
    return climbed([begun(rows, start) for start in starts], precision, away, own)


def begun(rows: Sequence[Rows], start: Start | None) -> Sized:
    """The likelihood and the sizes with which a start, as of `settled`, begins, and the weights of what they leave.

    Labels begin with a weight of one: their loss is not convex, and one that a wrong model contradicts would stay out.
    """
    if start is None:
        return Batches.of(rows), Noise.least(rows)
    known = start.weights and [(samples, np.ones_like(spins), cost) for samples, spins, cost in start.weights]
    return Batches.of(rows, known).reweighted(start.noise), start.noise


def climbed(starts: Sequence[Sized], precision: Array, away: Array, own: int | None = None) -> Sized:
    """As `settled`, from what `begun` gives."""
    ends = [_climbed(*one, precision, away, own) for one in starts]
    _, likelihood, noise = max(ends, key=lambda end: end[0])
    return likelihood, noise


def _climbed(
    likelihood: Batches, noise: Noise, precision: Array, away: Array, own: int | None
) -> tuple[float, Batches, Noise]:
    """The largest evidence near a start, by steps with the average information, the weights following the sizes."""

    def at(likelihood: Batches, noise: Noise) -> tuple[Posterior, float, list[Local]]:
        reduced, local = likelihood.reduced(noise)
        free = posterior(reduced, precision, away)
        held = free.held(own)
        return held, free.evidence - held.evidence, local

    found, to_come, local = at(likelihood, noise)
    for _ in range(MOST_STEPS):
        if not np.isfinite(found.evidence):
            break
        slopes = slopes_at(likelihood, noise, local, found, precision, away)
        step = _bounded_step(noise.vector, slopes)
        gain, share, promised = -np.inf, 1.0, 0.5 * float(step @ slopes.slope)
        while gain <= 0.0 and (share == 1.0 or share * promised > SETTLED):
            moved = Noise.of(noise.vector + share * step)
            weights = likelihood.beside(slopes.along, moved)
            after, ahead, eliminated = at(weights, moved)
            gain, share = after.evidence - found.evidence, 0.5 * share
        if gain > 0.0:
            likelihood, noise, found, to_come, local = weights, moved, after, ahead, eliminated
        if gain < max(SETTLED, ENOUGH * to_come):
            break
    likelihood = likelihood.reweighted(noise)
    return at(likelihood, noise)[0].evidence, likelihood, noise


def _bounded_step(sizes: Array, slopes: Slopes) -> Array:
    """(s,) step of the logarithms of the sizes (s,), within their bounds; each is damped by its slope."""
    most = np.full(len(sizes), MOST)
    most[1 + SPIN_KINDS + COEFFICIENTS :] = MOST_SCATTER
    slope, curved = slopes.slope, slopes.information + np.diag(np.abs(slopes.slope)) / LONGEST
    free = np.flatnonzero(~((sizes <= LEAST) & (slope <= 0.0) | (sizes >= most) & (slope >= 0.0)))
    step = np.zeros(len(sizes))
    step[free] = np.linalg.lstsq(curved[np.ix_(free, free)], slope[free])[0]
    return np.clip(sizes + step, LEAST, most) - sizes


def slopes_at(
    likelihood: Batches, noise: Noise, eliminated: Sequence[Local], found: Posterior, precision: Array, away: Array
) -> Slopes:
    """The derivatives of the evidence by the logarithms of the sizes.

    The slope is expected squares less their number; those of the samples follow from the others, since all of them add
    up to the square at the mean plus one for each unknown. The average information needs no traces: A. R. Gilmour,
    R. Thompson, B. R. Cullis, "Average information REML", Biometrics 51, 1995.

    Args: eliminated: of each batch, as `reduced` gives them with the posterior.
    """
    shown = [_shown(part, noise, local, found) for part, local in zip(likelihood.parts, eliminated, strict=True)]
    squares, products, common = (sum(getattr(s, name) for s in shown) for name in ("squares", "products", "common"))
    prior = float(precision @ ((away - found.mean) ** 2 + np.diagonal(found.covariance)))
    unknowns = sum(s.unknowns for s in shown) + len(found.mean)
    white = found.square + float(unknowns) - squares.sum() - prior
    slope = np.append(white, squares) - likelihood.counts
    information = 2.0 * (products - common.T @ found.covariance @ common)
    return Slopes(slope, information, [s.along for s in shown])


@dataclass(frozen=True)
class _Shown:
    """What one batch shows of the sizes."""

    squares: Array  # (s - 1,) expected ones over the variance, of spins and random columns by their kinds
    unknowns: int  # Number of first states and random columns
    along: Array  # (n, d) as of `Slopes`
    products: Array  # (s, s) inner products of what each size's rows or columns show, less what local unknowns absorb
    common: Array  # (c, s) their inner products with the common columns, less the same


def _shown(likelihood: Likelihood, noise: Noise, local: Local, found: Posterior) -> _Shown:
    kinds = likelihood.rows.kinds
    end = STATE_DIM + kinds.shape[1]
    upper = np.stack([linalg.lapack.dtrtri(one.T)[0] for one in local.lower])
    solved = upper @ local.solved.swapaxes(1, 2)  # (n, l, c + 1), what local unknowns absorb of each column
    step, root = np.append(-found.mean, 1.0), np.linalg.cholesky(found.covariance)
    mean, moved = solved @ step, solved[..., :-1] @ root
    squares = mean**2 + (upper**2).sum(axis=-1) + (moved**2).sum(axis=-1)
    own = np.array([squares[:, STATE_DIM:][kinds == kind].sum() for kind in range(len(noise.random))])
    spins = likelihood.spin_columns
    left = spins[..., end:] @ step - (spins[..., :end] @ mean[..., None])[..., 0]
    scattered = (spins[..., end:-1] - spins[..., :end] @ solved[..., :-1]) @ root
    square = left**2 + (scattered**2).sum(axis=-1) + ((spins[..., :end] @ upper) ** 2).sum(axis=-1)
    spin = np.bincount(likelihood.rows.spin_kinds.ravel(), square.ravel(), len(noise.spin))
    shown_of = np.diagonal(likelihood.gram, axis1=1, axis2=2) + (spins**2).sum(axis=1)
    unseen = int((shown_of[:, :STATE_DIM] == 0.0).sum()) + int((kinds < 0).sum())  # `inner` gives them a prior
    along = np.concatenate((-mean, np.broadcast_to(step, (len(mean), len(step)))), axis=1)
    weighted = np.concatenate((spin, own)) * np.exp(-2.0 * noise.vector[1:])
    return _Shown(weighted, mean.size - unseen, along, *_products(likelihood, noise, upper, local.solved, along))


def _products(likelihood: Likelihood, noise: Noise, upper: Array, solved: Array, along: Array) -> tuple[Array, Array]:
    """As of `_Shown`; along: (n, d) factors of the columns whose sum is the residual at the mean."""
    kinds = likelihood.rows.kinds
    end = STATE_DIM + kinds.shape[1]
    ahead = np.zeros((*along.shape, len(noise.random)))  # of the random columns alone, kind by kind
    ahead[:, STATE_DIM:end] = -along[:, STATE_DIM:end, None] * (kinds[..., None] == np.arange(len(noise.random)))
    factors = np.concatenate((along[..., None], ahead), axis=-1)
    of_spins = likelihood.rows.spin_kinds
    columns = likelihood.spin_columns * np.exp(-np.array(noise.spin))[of_spins][..., None]
    samples, spins = np.exp(-2.0 * noise.white) * (likelihood.gram @ factors), columns @ factors
    own_rows = spins[..., :1] * (of_spins[..., None] == np.arange(len(noise.spin)))
    shown = columns.swapaxes(1, 2) @ np.concatenate((own_rows, spins[..., 1:]), axis=-1)
    own = 1 + len(noise.spin)
    rows = np.concatenate((samples[..., :1], shown[..., : own - 1], samples[..., 1:] + shown[..., own - 1 :]), axis=-1)
    products = np.zeros((rows.shape[-1],) * 2)
    products[own:] = np.einsum("nda,ndb->ab", ahead, rows)
    products[:own, own:] = products[own:, :own].T
    products[range(own), range(own)] = np.einsum("nd,nda->a", along, rows[..., :own])
    local = upper.swapaxes(1, 2) @ rows[:, :end]
    common = (rows[:, end:-1] - solved[:, :-1] @ local).sum(axis=0)
    return products - np.einsum("nla,nlb->ab", local, local), common


FIRST_DAMPING, DAMPED, LESS = 0.1, 10.0, 4.0
"""Damping of a step after a whole one that failed, its factor after a further failure, its divisor after a success."""
HARDLY, MOSTLY = 0.25, 0.75
"""Shares of a step's expected gain: with less it fails, with more the next one is damped less."""


@dataclass(frozen=True)
class Ahead:
    """The density of the tracks about the common unknowns of a fit, as far as it is quadratic.

    Patterns are no unknowns of the fit: at its new values they are as free as before.
    """

    information: Array  # (c, c) of its logarithm
    slope: Array  # (c,) of its logarithm
    limits: tuple[Array, Array]  # Smallest and largest step (c,)
    damping: float = 0.0  # Of the next step, as in `bounded_step`

    @classmethod
    def of(cls, fit: Fit, found: Posterior) -> "Ahead":
        """From the posterior about a fit."""
        own = len(fit.problem.common_precision)
        information: Array = np.asarray(np.linalg.inv(found.covariance[:own, :own]), dtype=np.float64)
        return cls(information, information @ found.mean[:own], fit.limits)

    def step(self, damping: float) -> tuple[Array, float]:
        """(c,) a step within the limits, and the logarithm of the density that it should gain."""
        step = bounded_step(self.information, self.slope, *self.limits, damping)
        return step, float(step @ (self.slope - 0.5 * self.information @ step))

    @property
    def gain(self) -> float:
        """What the whole step should gain."""
        return self.step(0.0)[1]


def next_damping(damping: float, share: float) -> float:
    """The damping of the step after one that gained a share of what it promised."""
    if share < MOSTLY:
        return damping
    return damping / LESS if damping > FIRST_DAMPING / LESS else 0.0
