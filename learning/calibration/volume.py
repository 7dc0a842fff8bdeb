"""Corrects the likelihood of coefficients that many tracks share for the volume of each track's states.

The coefficient with the most probable states is not the most probable coefficient: states are many, and each track adds
its share of the same error (J. Neyman, E. Scott, "Consistent estimates based on partially consistent observations",
Econometrica 16, 1948). With the states integrated out, in Laplace's approximation, the log likelihood of coefficients b
is that of the most probable states less log det R(b), with R^T R the Gauss-Newton matrix of the states at fixed b.
Where the depth is loose, log det R falls with drag: from one camera, a pooled drag without it is 10 to 20 % too small.
"""

from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation import Estimate, Smoother
from ballfg.estimation.smoother.settle import ROUGH, Solution
from ballfg.factors.batch import COEFFICIENTS
from ballfg.factors.graph import BallGraph
from ballfg.factors.prior import PriorFactors
from ballfg.tracks import Track

STEP: Final = 0.3
"""Prior standard deviations to each side of the posterior, for the slope; 0.1 to 1 give the same within 8 %."""
HELD: Final = 1e-3  # Prior standard deviations, so narrow that a coefficient counts as fixed


def estimate_with_slopes(smoother: Smoother, names: Sequence[str], track: Track) -> tuple[Estimate, Array]:
    """The estimate of a track, and the slopes (k,) of log det R by some of its coefficients, in one over their units.

    Args: names: of the k coefficients, among those that are estimated with each track.
    """
    prepared = smoother.prepared(track)
    problem, solution = smoother.solved(prepared.since_first())
    estimate = smoother.result(problem, solution).dated(track.times)
    if estimate.status.failed:
        return estimate, np.zeros(len(names))
    columns = [estimate.coefficient_names.index(name) for name in names]
    sigmas = np.array([smoother.settings.coefficients[name] for name in names])
    moves = STEP * np.diag(sigmas)
    ends = [[_log_volume(smoother, solution, columns, sign * move, sigmas) for sign in (1, -1)] for move in moves]
    slopes = np.diff(ends, axis=1)[:, 0] / (-2.0 * STEP * sigmas)
    return estimate, np.where(np.isfinite(slopes), slopes, 0.0)


def _log_volume(smoother: Smoother, solution: Solution, columns: Sequence[int], move: Array, sigmas: Array) -> float:
    """Log det R with coefficients (k,) that are moved and held there, up to a constant; NaN without a minimum."""
    values = solution.minimum.values
    moved = values.coefficients.copy()
    moved[list(columns)] += move
    root = np.zeros((1, len(columns), len(moved)))
    root[0, range(len(columns)), columns] = 1.0 / (HELD * sigmas)
    held = PriorFactors(np.array([COEFFICIENTS]), moved[None], root)
    rough = replace(smoother.optimizer, tolerance=max(ROUGH, smoother.optimizer.tolerance))
    graph = BallGraph((*solution.graph.batches, held))
    minimum = rough.minimize(graph, replace(values, coefficients=moved))
    return float("nan") if minimum.step is None else minimum.step.root.log_determinant
