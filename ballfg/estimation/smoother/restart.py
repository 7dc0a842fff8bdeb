"""A minimisation begun again: a spin label that was set aside on the way is asked once more.

Cauchy's loss lets go. On the way from a rough start a spin may leave its label so far behind that it hardly pulls
any more; the search then ends in another minimum, or on a slope. Where a label ends like that, convex losses lead to
where it holds, and the search begins again from there; the lower minimum is the answer.
"""

import numpy as np

from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, LevenbergMarquardt, Minimum
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.prior import SpinLabelFactors

LABELS = (LauncherSpinFactors, SpinLabelFactors)
"""Factors that tell a spin before the flight is looked at. A few of many sightings are far off as a matter of course;
the one label that a track has is not."""


def label_let_go(graph: BallGraph, values: Values) -> bool:
    """Whether the loss of a label pulls less the further away the spin is, and the spin is far away."""
    able = [batch for batch in graph.batches if isinstance(batch, LABELS) and batch.loss.convex != batch.loss]
    return any((np.linalg.norm(batch.linearize(values).residual, axis=-1) > batch.loss.scale).any() for batch in able)


def minimise_with_restart(optimizer: LevenbergMarquardt, graph: BallGraph, start: Values, found: Minimum) -> Minimum:
    """The lower of a minimum that was found and of the one that convex losses on labels lead to."""
    held = optimizer.minimize(_convex(graph), start)
    again = optimizer.minimize(graph, held.values)
    return again if again.error < found.error else found


def _convex(graph: BallGraph) -> BallGraph:
    """The graph with labels that never let go."""
    return BallGraph(tuple(b.with_loss(b.loss.convex) if isinstance(b, LABELS) else b for b in graph.batches))
