"""The ideal test finds an effect alone, with everything else known; its size is the reference for the loop.

It looks at all tracks, knows the noise, and asks for one effect in its true shape. Its statistic is the score test's:
chi-square where the effect is absent, non-central where it acts, with size^2 d' F d as non-centrality. F is the
information about the effect's coefficients that is left once first states and declared coefficients are projected out;
d is what size 1 adds to these coefficients. F is taken from tracks without noise, at the truth, where every robust
weight is one.

Source: D. R. Cox and D. V. Hinkley, Theoretical Statistics, 1974, section 9.3.
"""

from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, stats

from ballfg.arrays import Array
from ballfg.benchmarks.diagnosis.cases import Case, Recording, planted_case
from ballfg.benchmarks.diagnosis.data import declared_model, make_dataset
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.benchmarks.diagnosis.record import case_digest
from ballfg.benchmarks.resumable import Kept
from ballfg.diagnosis.fit.fit import fit_model
from ballfg.diagnosis.fit.holdout import launcher_labels
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.stretches import stretches_of
from ballfg.diagnosis.hypotheses.signatures import hypothesis_signatures, visible_directions
from ballfg.diagnosis.search.candidates import ALARM
from ballfg.estimation import Smoother, dataset_settings, dataset_surfaces

LEVEL = ALARM  # False-alarm rate of the score tests of one round of the loop
POWER = 0.9  # Probability at which an effect counts as detectable


@dataclass(frozen=True)
class Ideal(Kept):
    """The ideal test of an effect.

    Attributes:
        rank: degrees of freedom; 0 where the data do not show the effect.  information: non-centrality at size 1.
    """

    what = "an ideal test"
    rank: int
    information: float

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
