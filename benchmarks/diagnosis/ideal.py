"""The ideal test finds an effect alone, with everything else known; its size is the reference for the loop.

It looks at all tracks, knows the noise, and asks for one effect in its true shape. Its statistic is the score test's:
chi-square where the effect is absent, non-central where it acts, with size^2 d' F d as non-centrality. F is the
information about the effect's coefficients that is left once first states and declared coefficients are projected out;
d is what size 1 adds to these coefficients. F is taken from tracks without noise, at the truth, where every robust
weight is one.

Source: D. R. Cox and D. V. Hinkley, Theoretical Statistics, 1974, section 9.3.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special, stats

from ballfg.arrays import Array
from ballfg.benchmarks.diagnosis.cases import PLANTS, Case, Recording, planted_case
from ballfg.benchmarks.diagnosis.data import declared_model, make_dataset
from ballfg.benchmarks.diagnosis.record import case_digest
from ballfg.benchmarks.results import Kept
from ballfg.diagnosis.fit.fit import fit_model
from ballfg.diagnosis.fit.holdout import launcher_labels
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.stretches import stretches_of
from ballfg.diagnosis.hypotheses.signatures import hypothesis_signatures, visible_directions
from ballfg.diagnosis.search.score import ALARM
from ballfg.estimation import Smoother, dataset_settings, dataset_surfaces

LEVEL = ALARM  # False-alarm rate of the score tests of one round of the loop
POWER = 0.9  # Probability at which an effect counts as detectable


@dataclass(frozen=True)
class Ideal(Kept):
    """The ideal test of an effect."""

    what = "an ideal test"
    rank: int  # degrees of freedom; 0 where the data do not show the effect
    information: float  # non-centrality at size 1

    @property
    def size(self) -> float:
        """The smallest size found with `POWER`; infinite where the data do not show the effect."""
        if not self.rank or self.information <= 0.0:
            return float("inf")
        return float(np.sqrt(needed(self.rank) / self.information))

    def power(self, sizes: ArrayLike) -> Array:
        """(...) probability that an effect of some sizes (...) is found."""
        noncentrality = self.information * np.asarray(sizes, dtype=np.float64) ** 2
        return np.asarray(power(noncentrality, self.rank)) if self.rank else np.zeros_like(noncentrality)


def power(noncentrality: ArrayLike, rank: int) -> Array:
    """(...) probability that the statistic passes its threshold."""
    return np.asarray(stats.ncx2.sf(stats.chi2.isf(LEVEL, rank), rank, noncentrality))


def needed(rank: int) -> float:
    """The non-centrality at which the power is `POWER`."""
    most = 1e3 + 1e2 * rank  # far beyond it for every rank
    return float(optimize.brentq(lambda ncp: float(power(ncp, rank)) - POWER, 0.0, most))


def ideal_case(name: str, seed: int) -> Case:
    """The dataset that an ideal test is computed from: the effect absent, measured without noise."""
    return replace(planted_case("ideal", name, 0.0, seed), recording=Recording(position=0.0, spin=0.0))


def fit_declared(case: Case) -> Fit:
    """The declared model fitted to the tracks of a case without noise, under the stated noise."""
    with TemporaryDirectory() as folder:
        dataset = make_dataset(case, Path(folder) / "tracks")
        model = declared_model(case, dataset.info.ball.radius)
        settings, tracks = dataset_settings(dataset, model), list(dataset)
    smoother = Smoother(model, dataset_surfaces(dataset), settings)
    stretches = stretches_of(smoother, tracks, launcher_labels(dataset, tracks, settings))
    return fit_model(model, stretches, settings, settle_noise=False)


def ideal_of(case: Case) -> Ideal:
    """Compute the ideal test of a case's subject, an effect that comes in sizes."""
    plant = PLANTS[case.subject]
    found, _ = hypothesis_signatures(fit_declared(case), [plant.hypothesis()])
    efficient, direction = found.efficient(), plant.direction()
    rank = visible_directions(efficient.total, efficient.raw).shape[1]
    return Ideal(case_digest(case), rank, float(direction @ efficient.total @ direction))


NAMED = 0.9  # Share of seeds from which on an effect of some size counts as named
SLOPE_PRIOR = 10.0
"""Standard deviation of the curve's slope about zero, in logits per unit of the size's logarithm. It makes the fit
exist where outcomes part cleanly; a curve of that slope goes from 10 to 90 % within a factor of 1.6."""
MIDDLE_PRIOR = 2.0
"""Standard deviation of the logarithm of the size at which the curve is at one half, about that of the sizes tried."""


@dataclass(frozen=True)
class Curve:
    """Probability to be named against size: a logistic function of the size's logarithm.

    Attributes:
        middle: logarithm of the size at one half.  slope: logits per unit of the logarithm.
        lowest, highest: sizes that were tried.
    """

    middle: float
    slope: float
    lowest: float
    highest: float

    def at(self, sizes: ArrayLike) -> Array:
        """(...) probabilities at some sizes (...)."""
        return np.asarray(special.expit(self.slope * (np.log(sizes) - self.middle)))

    @property
    def limit(self) -> float:
        """The size at `NAMED`; the lowest one tried where it lies below, infinite where it lies beyond the highest."""
        size = float(np.exp(self.middle + special.logit(NAMED) / self.slope)) if self.slope > 0.0 else np.inf
        return max(size, self.lowest) if size <= self.highest else np.inf


def power_curve(sizes: Sequence[float], outcomes: Sequence[bool]) -> Curve:
    """The most probable curve through outcomes at sizes.

    Args: sizes: (n,) positive.  outcomes: (n,) whether the effect was named.
    """
    if not outcomes:
        raise ValueError("outcomes must not be empty; got none. Run some sizes first.")
    logs, signs = np.log(sizes), np.where(outcomes, 1.0, -1.0)
    centre = float(logs.mean())

    def loss(parameters: Array) -> float:
        middle, slope = parameters[0], np.exp(parameters[1])
        fit = np.logaddexp(0.0, -signs * slope * (logs - middle)).sum()
        return float(fit + 0.5 * ((middle - centre) / MIDDLE_PRIOR) ** 2 + 0.5 * (slope / SLOPE_PRIOR) ** 2)

    starts = [(m, s) for m in (float(logs.min()), centre, float(logs.max())) for s in (0.0, 1.5)]
    tried = [optimize.minimize(loss, start, method="Nelder-Mead") for start in starts]
    middle, slope = min(tried, key=lambda t: float(t.fun)).x
    return Curve(float(middle), float(np.exp(slope)), float(min(sizes)), float(max(sizes)))
