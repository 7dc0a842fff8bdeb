"""The last word on a track: the window minimised to a tight tolerance, and the states that left it before."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import gtsam
import numpy as np

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.estimate.online_events import SIGMA_FACTOR, EventTracker
from ballfg.estimate.online_isam import Sample
from ballfg.estimate.online_window import Window
from ballfg.estimate.problem import Events, build_graph, effective_sigmas
from ballfg.estimate.result import Estimate
from ballfg.estimate.segmentation import Contact, Segmentation
from ballfg.estimate.settings import Settings
from ballfg.estimate.smoother import MAX_REFINEMENTS, Solution, _places, _prior_covariances, _refined, _status, _timed
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY
from ballfg.factors.covariance import Covariances, marginal_covariances
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.factors.kind import COEFFICIENTS, Array, FactorKind, Index, Values
from ballfg.factors.prior import PriorFactors
from ballfg.state import STATE_DIM
from ballfg.tracks import Track


@dataclass(frozen=True)
class Frozen:
    """A state as it was when it left the window.

    Attributes:
        sample: its observation.  state: (9,).  joint: (9 + p, 9 + p) covariance with the coefficients.
    """

    sample: Sample
    state: Array
    joint: Array


def freeze(window: Window, count: int) -> list[Frozen]:
    """The window's oldest states with their covariances."""
    shared, states, frozen = [COEFFICIENT_KEY] * (window.p > 0), window.states, []
    for k in range(count):
        joint = window.isam.jointMarginalCovariance([STATE_KEY + window.first + k, *shared]).fullMatrix()
        frozen.append(Frozen(window.samples[k], states[k], joint))
    return frozen


class LinearFactors(FactorKind):
    """A linear factor that marginalised states left: r = sum A_i (v_i - v_i*) - b.

    Args:
        factor: of iSAM2.  values: v*, of the window.  first: number of the window's first state.
    """

    def __init__(self, factor: gtsam.LinearContainerFactor, values: Values, first: int) -> None:
        numbers = [COEFFICIENTS if k == COEFFICIENT_KEY else k - STATE_KEY - first for k in factor.keys()]
        at = gtsam.Values()
        for number, key in zip(numbers, factor.keys(), strict=True):
            at.insert(key, values.coefficients if number == COEFFICIENTS else values.states[number])
        matrix, self.b = factor.linearize(at).jacobian()
        super().__init__(np.array([numbers]), len(self.b))
        widths = [len(values.coefficients) if n == COEFFICIENTS else STATE_DIM for n in numbers]
        self.blocks = tuple(np.split(matrix, np.cumsum(widths)[:-1], axis=1))
        self.points = tuple(np.array(values.gather(np.array([n]))) for n in numbers)

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Residual (1, r) and Jacobians (1, r, d)."""
        parts = [block @ (x - at)[0] for block, x, at in zip(self.blocks, inputs, self.points, strict=True)]
        return (np.sum(parts, axis=0) - self.b)[None], tuple(block[None] for block in self.blocks)


def solve_window(window: Window, track: Track, segmentation: Segmentation, settings: Settings) -> Solution:
    """Minimise the graph of the window's samples, and move contacts as the smoother does.

    Args:
        window: where the minimisation starts, and what marginalised states know.
        track: the window's samples.  segmentation: of them.  settings: noise and priors.
    """
    sigma = effective_sigmas(track, segmentation, settings)
    values = Values(window.states, window.coefficients)
    summaries = [LinearFactors(factor, values, window.first) for factor in window.summaries]
    events = Events(segmentation.contacts, segmentation)
    optimizer, seen = LevenbergMarquardt(), {}
    for _ in range(MAX_REFINEMENTS):
        graph = with_summaries(build_graph(track, window.model, events, sigma, settings), summaries)
        solution = Solution(events, graph, optimizer.minimize(graph, values))
        seen[_places(events.contacts)] = solution
        refined = _refined(track.times, solution)
        if _places(refined) in seen:
            break
        values = solution.minimum.values
        events = Events(refined, segmentation)
    return min(seen.values(), key=lambda s: s.minimum.error)


def with_summaries(graph: BallGraph, summaries: Sequence[FactorKind]) -> BallGraph:
    """The graph with what marginalised states know in place of the priors on the same variables."""
    if not summaries:
        return graph
    known = {int(v) for summary in summaries for v in summary.variables[0]}
    kept = [k for k in graph.kinds if not (isinstance(k, PriorFactors) and int(k.variables[0, 0]) in known)]
    return BallGraph((*kept, *summaries))


def final_estimate(
    window: Window, track: Track, events: EventTracker, frozen: Sequence[Frozen], whitened: Array, settings: Settings
) -> Estimate:
    """The result over a whole track.

    Args:
        window: after the last push.  track: all of it.  events: of the stream.
        frozen: the states that left the window, oldest first.
        whitened: (n, 3) innovations of the pushes.  settings: noise and priors.
    """
    first = window.first
    part = track if first == 0 else track.between(float(track.times[first]), float(track.times[-1]))
    segmentation = events.segmentation(first, part.times, part.positions)
    solution = solve_window(window, part, segmentation, settings)
    minimum, n, p = solution.minimum, len(part), window.p
    if minimum.step is None:
        covariances = _prior_covariances(n, p, effective_sigmas(part, segmentation, settings), settings)
    else:
        covariances = marginal_covariances(minimum.step.bayes_net, n, p)
    joints = np.array([f.joint for f in frozen]).reshape(-1, STATE_DIM + p, STATE_DIM + p)
    old_contacts, old_hits, old_quality = _events_of(frozen)
    contacts = [replace(c, interval=c.interval + first) for c in _timed(part.times, solution)]
    return Estimate(
        name=track.name,
        times=track.times,
        states=np.concatenate((np.array([f.state for f in frozen]).reshape(-1, STATE_DIM), minimum.values.states)),
        covariances=np.concatenate((joints[:, :STATE_DIM, :STATE_DIM], covariances.states)),
        status=_status(minimum, len(track)),
        whitened=whitened,
        coefficient_names=window.model.names if isinstance(window.model, AugmentedModel) else (),
        coefficients=minimum.values.coefficients,
        coefficient_covariance=covariances.coefficients,
        cross_covariances=np.concatenate((joints[:, :STATE_DIM, STATE_DIM:], covariances.cross)),
        contacts=(*old_contacts, *contacts),
        hits=np.concatenate((old_hits, segmentation.hits + first)),
        quality=np.concatenate((old_quality, segmentation.quality)),
        error=minimum.error,
        iterations=minimum.iterations,
    )


def _events_of(frozen: Sequence[Frozen]) -> tuple[list[Contact], Index, Array]:
    """Contacts, hits and qualities of the samples that left the window."""
    contacts, hits = [], []
    for k, state in enumerate(frozen):
        motion = state.sample.motion
        if k and motion.linked:
            start = frozen[k - 1].sample.time
            contacts += [Contact(k - 1, start + t, h) for t, h in zip(motion.times, motion.heights, strict=True)]
        if k and (motion.hit or not motion.linked):
            hits.append(k - 1)
    quality = np.array([int(np.argmin(np.abs(SIGMA_FACTOR - f.sample.factor))) for f in frozen], dtype=np.int8)
    return contacts, np.array(hits, dtype=np.int64), quality
