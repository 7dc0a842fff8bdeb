"""Minimising from a rough start: a spin label that was set aside on the way is asked once more.

Cauchy's loss lets go. On the way from a rough start a spin may leave its label so far behind that it hardly pulls
any more; the search then ends in another minimum, or on a slope. Where a label ends like that, convex losses lead to
where it holds, and the search begins again from there; the lower minimum is the answer.
"""

from __future__ import annotations

import numpy as np

from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, LevenbergMarquardt, Minimum
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.prior import SpinLabelFactors
from ballfg.factors.search import Search

LABELS = (LauncherSpinFactors, SpinLabelFactors)
"""Kinds that say what a spin is before the flight is looked at. That a few of many sightings are far off is a matter of
course; of the one label that a track has it is news."""


def search_twice(optimizer: LevenbergMarquardt, graph: BallGraph, values: Values) -> Search[Minimum]:
    """The lowest minimum found from a start: `optimizer.search`, and where a loss has let go, from another one too."""
    minimum = yield from optimizer.search(graph, values)
    if not _lets_go(graph, minimum.values):
        return minimum
    held = yield from optimizer.search(_convex(graph), values)
    again = yield from optimizer.search(graph, held.values)
    return again if again.error < minimum.error else minimum


def _lets_go(graph: BallGraph, values: Values) -> bool:
    """Whether the loss of a label pulls less the further away the spin is, and the spin is far away."""
    able = [kind for kind in graph.kinds if isinstance(kind, LABELS) and kind.loss.convex != kind.loss]
    return any((np.linalg.norm(kind.linearize(values).residual, axis=-1) > kind.loss.scale).any() for kind in able)


def _convex(graph: BallGraph) -> BallGraph:
    """The graph with labels that never let go."""
    kinds = (kind.with_loss(kind.loss.convex) if isinstance(kind, LABELS) else kind for kind in graph.kinds)
    return BallGraph(tuple(kinds))
