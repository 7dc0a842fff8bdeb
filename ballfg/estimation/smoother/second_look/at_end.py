"""Estimates the last state of a track that ends near a contact, where no later sample shows the side."""

from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.result import Estimate
from ballfg.estimation.sides.hypotheses import HypothesisModel, measured_at
from ballfg.estimation.sides.monitor import ContactMonitor, with_contact_states
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.factors.linear.definite import definite
from ballfg.state import STATE_DIM
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.estimation.smoother.smoother import Smoother

REACH: Final = 3
"""Number of intervals at the end in which a contact may be uncertain."""
LEAST: Final = 3
"""Least number of samples before them."""
MEMORY: Final = 256
"""Number of samples that determine a state at their end."""


def with_both_sides(smoother: "Smoother", problem: TrackProblem, estimate: Estimate) -> Estimate:
    """The estimate; if the track ends near a contact, its last state is that of the more probable side.

    The samples before the contact are estimated by themselves; from there on both hypotheses are followed
    (`ballfg.estimation.sides`).
    """
    track, n = problem.track, len(problem.track)
    disturbed = np.concatenate((estimate.hits, problem.segmentation.restarts))
    first = _before_contact(estimate, HypothesisModel(problem.ball, smoother.surfaces, problem.settings), track)
    if estimate.status.failed or first is None or first + 1 < LEAST or (disturbed >= first).any():
        return estimate
    before = _filtered(smoother, track.between(track.times[max(first + 1 - MEMORY, 0)], track.times[first]))
    if before is None:
        return estimate
    biases = len(before[0]) - STATE_DIM - problem.width
    model = HypothesisModel(problem.ball, smoother.surfaces, problem.settings, biases)
    beside = {one: problem.observed[one.name] for one in problem.observations if not one.locates}
    measured = (measured_at(track, problem.sigma, beside, k) for k in range(first + 1, n))
    steps = list(zip(np.diff(track.times[first:]).tolist(), measured, strict=True))
    latest = max((contact.interval for contact in estimate.contacts), default=-1)
    state = ContactMonitor(model).run(before, steps, lambda count: latest >= n - 1 - count)
    return estimate if state is None else with_contact_states(estimate, {n - 1: state})


def _before_contact(estimate: Estimate, model: HypothesisModel, track: Track) -> int | None:
    """The last sample that is certainly before a contact near the track's end; None without such a contact."""
    n = len(track)
    near = [contact.interval for contact in estimate.contacts if contact.interval >= n - 1 - REACH]
    if near:
        return near[0] - 1
    for k in range(max(n - 1 - REACH, 0), n - 1):
        state = estimate[k]
        if model.may_touch(state.mean, state.joint, float(track.times[k + 1] - track.times[k])):
            return k
    return None


def _filtered(smoother: "Smoother", track: Track) -> tuple[Array, Array] | None:
    """Mean and covariance of state, coefficients and bias at the end of a track; None if undetermined."""
    problem = smoother.problem(track)
    solution = smoother.settle(problem)
    known = smoother.optimizer.covariances(solution.graph, solution.minimum)
    if known is None:
        return None
    values, p = solution.minimum.values, problem.width
    biases = np.zeros(0) if values.biases is None else values.biases[-1]
    mean = np.concatenate((values.states[-1], values.coefficients[:p], biases))
    width = STATE_DIM + len(biases)
    order = np.r_[:STATE_DIM, width : width + p, STATE_DIM:width]
    return mean, definite(known.joint(-1)[np.ix_(order, order)])
