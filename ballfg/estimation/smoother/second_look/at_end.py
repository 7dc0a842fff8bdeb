"""Estimates the last state of a track, or before a restart, that is near a contact, and a first state near one.

No sample beyond shows the side there.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.motion.arrays import bounced, gap_jacobian, surface_offsets
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.result import Contact, Quality, Rest
from ballfg.estimation.segmentation.segmenter import USUAL
from ballfg.estimation.sides.gaussians import GaussianMixture
from ballfg.estimation.sides.hypotheses import HypothesisModel, measured_at
from ballfg.estimation.sides.monitor import (
    LEAST_SAMPLES,
    LEAST_TIME,
    ContactMonitor,
    ContactState,
    widening,
    with_contact_states,
)
from ballfg.estimation.smoother.problem import QUALITY_SIGMA, TrackProblem
from ballfg.estimation.smoother.settle import LEAST_FALL, Earlier, Solution
from ballfg.factors.batch import Values
from ballfg.factors.graph import Convergence
from ballfg.factors.linear.definite import definite
from ballfg.state import SPIN, STATE_DIM, VELOCITY, VZ, Z
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel
    from ballfg.estimation.smoother.smoother import Smoother

REACH: Final = 3
"""Number of intervals at the end in which a contact may be uncertain."""
LEAST: Final = 3
"""Least number of samples before them."""
MEMORY: Final = 256
"""Number of samples that determine a state at their end."""
SIGMAS: Final = 3.0
"""Standard deviations of the gap at a first sample, within which the ball may have bounced right after it."""
ROUNDS: Final = 8  # Of a search for the velocity before a bounce, whose error a round halves at least
UNEVEN: Final = 0.1  # m, more than a surface lies off its declared height
CERTAIN: Final = 1e-4  # Chance of the other side below which it widens nothing

Solved = tuple[TrackProblem, Solution]


def with_both_sides(smoother: Smoother, problem: TrackProblem, estimate: Estimate) -> Estimate:
    """The estimate; where it ends near a contact, its last state is that of the more probable side.

    It ends with the track, and before each gap over which nothing is known. The samples before the contact are
    estimated by themselves; from there on both hypotheses are followed (`ballfg.estimation.sides`).
    """
    edges = [0, *(np.unique(problem.segmentation.restarts) + 1).tolist(), len(problem.track)]
    found = {end - 1: _at_end(smoother, problem, estimate, begin, end) for begin, end in pairwise(edges)}
    states = {last: state for last, state in found.items() if state is not None}
    return with_contact_states(estimate, states) if states else estimate


def with_hit_at_end(smoother: Smoother, problem: TrackProblem, estimate: Estimate) -> Estimate:
    """The estimate; where its last samples contradict the flight, their covariances hold that the ball may be struck.

    Segmentation and smoother need two or three samples after a hit to tell it from outliers.
    """
    track, n = problem.track, len(estimate)
    good = bool((estimate.quality[-REACH:] == Quality.GOOD).all())
    if good or estimate.status.failed or track.rough or n <= REACH:
        return estimate
    from ballfg.estimation.sides.struck import HitDoubt

    known = {contact.interval for contact in estimate.contacts} | set(estimate.hits.tolist())
    model = HypothesisModel(problem.ball, smoother.surfaces, problem.settings)
    doubt, found = HitDoubt(problem.settings, USUAL), dict[int, Array]()
    for k in range(n - REACH, n):
        before, newest = estimate[k - 1], estimate[k]
        if k - 1 in known or (newest.other_side is not None and newest.other_side.any()):
            doubt.reset()
        else:
            sigma = problem.sigma[k] / QUALITY_SIGMA.get(Quality(estimate.quality[k]), 1.0)
            beliefs = [(state.mean, state.joint) for state in (before, newest)]
            measured = (track.positions[k], sigma, sigma)
            found[k] = doubt.widened(model, beliefs[0], newest.time - before.time, measured, beliefs[1])
        if not doubt.contradicting:
            found.clear()
    if not found:
        return estimate
    covariances, cross = estimate.covariances.copy(), estimate.cross_covariances.copy()
    for k, joint in found.items():
        covariances[k], cross[k] = joint[:STATE_DIM, :STATE_DIM], joint[:STATE_DIM, STATE_DIM:]
    struck = {k: joint - estimate[k].joint for k, joint in found.items()}
    return replace(estimate, covariances=covariances, cross_covariances=cross, struck=struck)


def with_fall_at_end(smoother: Smoother, problem: TrackProblem, estimate: Estimate) -> Estimate:
    """The estimate; where it ends while a ball rolls over an end of the table, its last state holds that it may fall.

    A fall shows late: 2 mm in 20 ms. So a ball that rolls and one that has left are followed from where it certainly
    was on the table (`ballfg.estimation.sides.struck`).
    """
    rests = problem.segmentation.rests
    if estimate.status.failed or problem.track.rough or not rests or smoother.surfaces.extent is None:
        return estimate
    begin = _before_an_end(smoother, problem, estimate, rests[-1])
    if begin is None:
        return estimate
    found = _fallen(smoother, problem, begin, rests[-1].height, estimate.quality)
    if found is None:
        return estimate
    state = ContactState(*found, np.zeros((STATE_DIM, STATE_DIM)), bounced=False)
    return with_contact_states(estimate, {len(estimate) - 1: state})


def _before_an_end(smoother: Smoother, problem: TrackProblem, estimate: Estimate, rest: Rest) -> int | None:
    """The last sample of a rest at which the ball is certainly on the table; None if it is there to the end.

    None too where the ball left the rest so long ago that the segmentation knows of it.
    """
    from ballfg.estimation.sides.struck import LEAST_CHANCE, share_within

    n, times, left = len(estimate), problem.track.times, min(rest.last + 1, len(estimate) - 1)
    if n - 1 - left > LEAST_SAMPLES and times[-1] - times[left] > LEAST_TIME:
        return None
    world = HypothesisModel(problem.ball, smoother.surfaces, problem.settings).world
    if share_within(estimate.states[-1], estimate.covariances[-1], world) > 1.0 - LEAST_CHANCE:
        return None
    for k in range(left, rest.first, -1):
        if share_within(estimate.states[k], estimate.covariances[k], world) > 1.0 - CERTAIN:
            met = [*estimate.hits.tolist(), *(contact.interval for contact in estimate.contacts)]
            return None if any(interval >= k for interval in met) else k
    return None


def _fallen(
    smoother: Smoother, problem: TrackProblem, begin: int, level: float, quality: NDArray[np.int8]
) -> tuple[Array, Array] | None:
    """Mean and covariance of the last state and coefficients of a ball that rolls or falls; None if it hardly falls.

    Args: begin: a sample where the ball rolls.  level: m, of the surface.  quality: (n,) of the samples.
    """
    from ballfg.estimation.sides.struck import RestDoubt, beside, weighed

    track, d, found = problem.track, STATE_DIM + problem.width, None
    rolling = _filtered(smoother, track.between(track.times[max(begin + 1 - MEMORY, 0)], track.times[begin]))
    if rolling is None:
        return None
    model = HypothesisModel(problem.ball, smoother.surfaces, problem.settings, len(rolling[0]) - d)
    doubt = RestDoubt(USUAL)
    for k in range(begin + 1, len(track)):
        sigma = problem.sigma[k] / QUALITY_SIGMA.get(Quality(quality[k]), 1.0)
        dt, measured = float(track.times[k] - track.times[k - 1]), (track.positions[k], sigma)
        found = doubt.step(model, rolling, dt, measured, level)
        rolled = model.predict_rest(GaussianMixture.single(*rolling), dt, level)
        rolled = weighed(model, rolled, measured, USUAL).merged()
        rolling = rolled.means[0], rolled.covariances[0]
    if found is None:
        return None
    near, both = beside(rolling, found[1:], found[0])
    return near[0][:d], both[:d, :d]


def _at_end(smoother: Smoother, problem: TrackProblem, estimate: Estimate, begin: int, end: int) -> ContactState | None:
    """The last state of the samples begin to end - 1, between which no restart lies; None if no contact is near."""
    track, model = problem.track, HypothesisModel(problem.ball, smoother.surfaces, problem.settings)
    intervals = [contact.interval for contact in estimate.contacts if contact.interval < end - 1]
    first = _before_contact(estimate, model, track, intervals, end)
    if estimate.status.failed or first is None or first + 1 - begin < LEAST:
        return None
    if ((estimate.hits >= first) & (estimate.hits < end - 1)).any():
        return None
    before = _filtered(smoother, track.between(track.times[max(first + 1 - MEMORY, begin)], track.times[first]))
    if before is None:
        return None
    biases = len(before[0]) - STATE_DIM - problem.width
    model = HypothesisModel(problem.ball, smoother.surfaces, problem.settings, biases)
    beside = {one: problem.observed[one.name] for one in problem.observations if not one.locates}
    measured = (measured_at(track, problem.sigma, beside, k) for k in range(first + 1, end))
    steps = list(zip(np.diff(track.times[first:end]).tolist(), measured, strict=True))
    latest = max(intervals, default=-1)
    return ContactMonitor(model).run(before, steps, lambda count: latest >= end - 1 - count)


def _before_contact(
    estimate: Estimate, model: HypothesisModel, track: Track, intervals: Sequence[int], end: int
) -> int | None:
    """The last sample that is certainly before a contact near sample end - 1; None without such a contact.

    Args: intervals: of the contacts before.
    """
    near = [interval for interval in intervals if interval >= end - 1 - REACH]
    if near:
        return near[0] - 1
    for k in range(max(end - 1 - REACH, 0), end - 1):
        state = estimate[k]
        if model.may_touch(state.mean, state.joint, float(track.times[k + 1] - track.times[k])):
            return k
    return None


def _filtered(smoother: Smoother, track: Track) -> tuple[Array, Array] | None:
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


def from_before_a_bounce(smoother: Smoother, problem: TrackProblem, solution: Solution) -> Solved | None:
    """The track with a contact right after its first sample, where there may be one; None for other tracks.

    The ball rises from a surface there. The later samples cannot show what was before, and the first one seems to be an
    outlier; here it counts.
    """
    track, values, events = problem.track, solution.minimum.values, solution.events
    found, contacts = events.segmentation, events.contacts
    disturbed = {*found.hits.tolist(), *(rest.first for rest in found.rests)}
    if track.rough or problem.one_view or len(track) <= LEAST or 0 in disturbed:
        return None
    if all(contact.interval for contact in contacts):
        begun = _before_contact_at_start(smoother, problem, solution)
        if begun is None:
            return None
        contacts, values = (begun[0], *contacts), begun[1]
    elif found.quality[0] == Quality.GOOD:
        return None
    quality = found.quality.copy()
    quality[0] = Quality.GOOD
    other = smoother.problem(track, replace(found, quality=quality, contacts=contacts))
    other.added += problem.added
    settled = smoother.settle(other, Earlier(values))
    reached = settled.minimum.convergence in (Convergence.CONVERGED, Convergence.AT_KINK)
    return (other, settled) if reached and any(c.interval == 0 for c in settled.events.contacts) else None


def _before_contact_at_start(
    smoother: Smoother, problem: TrackProblem, solution: Solution
) -> tuple[Contact, Values] | None:
    """A contact right after the first sample and values from before it; None where the ball does not rise from one."""
    values, times = solution.minimum.values, problem.track.times
    speed, step = float(values.states[0, VZ]), float(times[1] - times[0])
    above = np.abs(values.states[0, Z] - np.array(smoother.surfaces.heights())).min(initial=np.inf)
    if speed <= 0.0 or above - problem.ball.radius > speed * step + UNEVEN:
        return None
    own = np.tile(values.coefficients[: problem.width], (2, 1))
    start, later = np.split(np.concatenate((values.states[:2], own), axis=1), 2)
    height = smoother.surfaces.level_below(later, surface_offsets(problem.ball, later))  # the first may seem below it
    if not bool(smoother.surfaces.over_table(start)):
        return None
    found, slope = gap_jacobian(problem.ball, start, height)
    gap = float(found[0])
    if not gap < speed * step or gap > SIGMAS * _sigma_at_start(smoother, problem, solution, slope[0]):
        return None
    states, label = values.states.copy(), problem.settings.spin_label(problem.track)
    states[0, SPIN] = 0.0 if label is None else label.spin
    states[0, VELOCITY] = _velocity_before(problem.ball, values.coefficients[: problem.width], states[0])
    states[0, Z] -= 2.0 * gap if gap < 0.0 else max(gap - 0.5 * speed * step, 0.0)
    contact = Contact(0, float(times[0]) + min(abs(gap) / speed, step), float(height[0]))
    return contact, replace(values, states=states)


def _velocity_before(ball: BallModel, coefficients: Array, after: Array) -> Array:
    """(3,) m/s, from which a bounce of the spin of `after` (9,) makes its velocity, found by repetition."""
    before = np.concatenate((after, coefficients))[None]
    target = before[0, VELOCITY].copy()
    before[0, VZ] *= -1.0
    for _ in range(ROUNDS):
        missing = target - bounced(ball, before)[0, VELOCITY]
        before[0, VELOCITY] += missing * np.array([1.0, 1.0, -1.0])
        before[0, VZ] = min(float(before[0, VZ]), -LEAST_FALL)
    return before[0, VELOCITY]


def _sigma_at_start(smoother: Smoother, problem: TrackProblem, solution: Solution, slope: Array) -> float:
    """m, standard deviation of the gap at the first sample; slope: (9 + p,) derivatives by state and coefficients."""
    known = smoother.optimizer.covariances(solution.graph, solution.minimum)
    if known is None:
        return 0.0
    width, p = solution.minimum.values.width, problem.width
    order = np.r_[:STATE_DIM, width : width + p]
    return float(np.sqrt(slope @ known.joint(0)[np.ix_(order, order)] @ slope))


def log_evidence(solution: Solution) -> float:
    """nats, in Laplace's approximation, but for a constant of the track."""
    assert solution.minimum.step is not None
    spread = sum(batch.log_spread() for batch in solution.graph.batches if len(batch))
    return -(solution.minimum.error + solution.minimum.step.root.log_determinant + spread)


def with_other_beginning(estimate: Estimate, other: Estimate, odds: float) -> Estimate:
    """The estimate with a first covariance that holds another estimate's first state too; odds: log, of its own."""
    chance = float(1.0 / (1.0 + np.exp(min(odds, 100.0))))
    if chance < CERTAIN:
        return estimate
    covariances = estimate.covariances.copy()
    others = estimate.other_sides.copy() if len(estimate.other_sides) else np.zeros_like(covariances)
    more = widening(covariances[0], other.covariances[0], other.states[0] - estimate.states[0], chance)
    covariances[0] += more
    others[0] += more
    return replace(estimate, covariances=covariances, other_sides=others)
