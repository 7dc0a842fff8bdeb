"""Restarts a minimisation with convex losses if it has set a spin label aside.

Cauchy's loss lets go. From a rough start a spin may move so far from its label that it hardly pulls any more; the
search then ends in another minimum, or on a slope. In that case convex losses lead to the label's minimum, where the
search starts again; the lower minimum is the result.
"""

import numpy as np

from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, LevenbergMarquardt, Minimum
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.prior import SpinLabelFactors

LABELS = (LauncherSpinFactors, SpinLabelFactors)
"""Factors of a spin known before the flight. A few of many sightings are far off as a matter of course; a track's
single label is not."""


def label_let_go(graph: BallGraph, values: Values) -> bool:
    """True if the spin is so far from its label that the label's loss pulls less with distance."""
    able = [batch for batch in graph.batches if isinstance(batch, LABELS) and batch.loss.convex != batch.loss]
    return any((np.linalg.norm(batch.linearize(values).residual, axis=-1) > batch.loss.scale).any() for batch in able)


def minimise_with_restart(optimizer: LevenbergMarquardt, graph: BallGraph, start: Values, found: Minimum) -> Minimum:
    """The lower of a given minimum and of the one reached by convex losses on labels."""
    held = optimizer.minimize(_convex(graph), start)
    again = optimizer.minimize(graph, held.values)
    return again if again.error < found.error else found


def _convex(graph: BallGraph) -> BallGraph:
    """The graph with convex losses on labels."""
    return BallGraph(tuple(b.with_loss(b.loss.convex) if isinstance(b, LABELS) else b for b in graph.batches))
