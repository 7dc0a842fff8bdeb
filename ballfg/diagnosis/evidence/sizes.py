"""Finds the sizes of the noise that maximise the evidence, by its derivatives.

What a wrong model cannot explain counts as its noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy import linalg

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.likelihood import Likelihood, Local, Noise, Posterior, posterior, unweighted
from ballfg.diagnosis.evidence.rows import Rows
from ballfg.state import STATE_DIM

LEAST, MOST = -5.0, 5.0
"""Bounds of the logarithm of a size over its unit."""
MOST_STEPS, SETTLED = 30, 0.02
"""Largest number of steps of the sizes, and the gain of evidence that ends them."""
LONGEST: Final = 1.5
"""Largest step of the logarithm of a size."""


@dataclass(frozen=True)
class Slopes:
    """Derivatives of the evidence by the logarithms of the sizes: slope (6,) and average information (6, 6).

    `along` (n, d) are factors of the columns start, random, common, residual whose sum is the residual at the mean,
    one for the residual.
    """

    slope: Array
    information: Array
    along: Array


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
    plain = unweighted(rows)
    begun = [(plain.reweighted(start) if start else plain, start or Noise()) for start in starts]
    ends = [_climbed(*one, precision, away, own) for one in begun]
    _, likelihood, noise = max(ends, key=lambda end: end[0])
    return likelihood, noise


def _climbed(
    likelihood: Likelihood, noise: Noise, precision: Array, away: Array, own: int | None
) -> tuple[float, Likelihood, Noise]:
    """The largest evidence near a start, by steps with the average information, the weights following the sizes."""

    def at(likelihood: Likelihood, noise: Noise) -> tuple[Posterior, Slopes | None]:
        reduced, local = likelihood.reduced(noise)
        found = posterior(reduced, precision, away).held(own)
        if not np.isfinite(found.evidence):
            return found, None
        return found, slopes_at(likelihood, noise, local, found, precision, away)

    found, slopes = at(likelihood, noise)
    for _ in range(MOST_STEPS):
        if slopes is None:
            break
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


def slopes_at(
    likelihood: Likelihood, noise: Noise, local: Local, found: Posterior, precision: Array, away: Array
) -> Slopes:
    """The derivatives of the evidence by the logarithms of the sizes.

    The slope is expected squares less their number. The expected squares over their variances of all rows and
    priors add up to the square at the mean plus one for each unknown, so that those of the samples follow from the
    others. The average of the observed and the expected information needs no traces: A. R. Gilmour, R. Thompson,
    B. R. Cullis, "Average information REML", Biometrics 51, 1995.
    """
    kinds = likelihood.rows.motion.kinds
    end = STATE_DIM + kinds.shape[1]
    upper = inverses(local.lower)
    solved = upper @ local.solved.swapaxes(1, 2)  # (n, l, c + 1), what local unknowns absorb of each column
    step, root = np.append(-found.mean, 1.0), np.linalg.cholesky(found.covariance)
    mean, moved = solved @ step, solved[..., :-1] @ root
    squares = mean**2 + (upper**2).sum(axis=-1) + (moved**2).sum(axis=-1)
    own = [squares[:, STATE_DIM:][kinds == kind] for kind in range(len(noise.random))]
    shown = [float(o.sum()) * np.exp(-2.0 * log) for o, log in zip(own, noise.random, strict=True)]
    spins = likelihood.spin_columns
    left = spins[..., end:] @ step - (spins[..., :end] @ mean[..., None])[..., 0]
    scattered = (spins[..., end:-1] - spins[..., :end] @ solved[..., :-1]) @ root
    square = (left**2).sum() + (scattered**2).sum() + ((spins[..., :end] @ upper) ** 2).sum()
    spin = float(square) * np.exp(-2.0 * noise.spin)
    prior = float(precision @ ((away - found.mean) ** 2 + np.diagonal(found.covariance)))
    of_samples, of_spins = (np.diagonal(gram, axis1=1, axis2=2)[:, :STATE_DIM] for gram in likelihood.grams)
    unseen = int((of_samples + of_spins == 0.0).sum()) + int((kinds < 0).sum())  # `inner` gives them a prior
    unknowns = mean.shape[0] * end - unseen + len(found.mean)
    white = found.square + float(unknowns) - sum(shown) - spin - prior
    slope = np.array([white, spin, *shown]) - likelihood.rows.counts
    along = np.concatenate((-mean, np.broadcast_to(step, (len(mean), len(step)))), axis=1)
    return Slopes(slope, _information(likelihood, noise, upper, local.solved, along, found.covariance), along)


def _information(
    likelihood: Likelihood, noise: Noise, upper: Array, solved: Array, along: Array, covariance: Array
) -> Array:
    """(6, 6) twice the inner products of what each size's rows or columns show, less what all unknowns absorb.

    Args: along: (n, d) factors of the columns whose sum is the residual at the mean.
    """
    kinds, (of_samples, of_spins) = likelihood.rows.motion.kinds, likelihood.grams
    end = STATE_DIM + kinds.shape[1]
    ahead = np.zeros((*along.shape, len(noise.random)))  # of the random columns alone, kind by kind
    ahead[:, STATE_DIM:end] = -along[:, STATE_DIM:end, None] * (kinds[..., None] == np.arange(len(noise.random)))
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


def inverses(lower: Array) -> Array:
    """(n, l, l) transposed inverses of triangles (n, l, l)."""
    return np.stack([linalg.lapack.dtrtri(one.T)[0] for one in lower])
