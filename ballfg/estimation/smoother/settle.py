"""Starts the search for a minimum, arranges its contacts, and starts it again where it went wrong.

A minimum is found for one arrangement of contacts and hits. Those whose estimated time lies outside of their interval
move, and the next minimum is computed, until they stay; the lowest minimum is the result.

Cauchy's loss lets go. From a rough start a spin may move so far from its label that it hardly pulls any more; the
search then ends in another minimum, or on a slope. In that case convex losses lead to the label's minimum, where the
search starts again; the lower minimum is the result.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, NamedTuple, TypeAlias

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.motion.arrays import bounced, fly_through, gaps, surface_offsets
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.launcher import SpinLabel
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.sides.monitor import FAR, LEAST_SPEED, Shared, gap_sigmas
from ballfg.estimation.smoother.motion import contacts_by_interval, move_hits, with_moved_hits
from ballfg.estimation.smoother.problem import Events, TrackProblem, bridged_positions
from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.correlated_noise import BiasStartFactors
from ballfg.factors.dynamics import ContactFactors, DynamicsFactors, model_width
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt, Minimum
from ballfg.factors.launcher import LauncherSpinFactors
from ballfg.factors.linear.covariance import Covariances, marginal_covariances
from ballfg.factors.prior import PriorFactors, SpinLabelFactors
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, STATE_DIM, VELOCITY, VZ, Z
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel
    from ballfg.estimation.smoother.second_look.explanations import Depths

ROUGH = 1e-2
"""Posterior standard deviations. Minima of this accuracy show the places of contacts and hits; only the last one is
found to the optimizer's own tolerance."""
BROKEN = 8.0
"""Norm of a whitened dynamics residual (9 dimensions) beyond which its interval hides a hit; chance: one in 1e9."""
NOWHERE = (Convergence.STUCK, Convergence.TOO_MANY_ITERATIONS)
LEAST_GAIN = 0.9
"""Of the objective. If a search fails and the worst of up to eight hits leaves more than this share, missing hits are
not the reason: the stated noise is far too small, and every further hit would cost a long search."""
LEAST_FALL = 0.05
"""m/s, least downward speed of a guess before a contact."""
DEAR = 5.0
"""Of the objective, a log likelihood: gain of a contact that only the end of a track suggests, if one camera saw it."""
MAX_REFINEMENTS = 6
"""Largest number of moves of contacts and hits to a neighbouring interval; measured tracks needed two."""
LABELS = (LauncherSpinFactors, SpinLabelFactors)
"""Factors of a spin known before the flight. A few of many sightings are far off as a matter of course; a track's
single label is not."""
Arrangement: TypeAlias = tuple[tuple[tuple[int, float], ...], tuple[int, ...]]
"""Interval and height of each contact, and the intervals of hits."""


@dataclass(frozen=True)
class Solution:
    """A minimised graph and its events."""

    events: Events
    graph: BallGraph
    minimum: Minimum
    rival: Array | None = None
    """(3,) rad/s, first spin of another minimum that is nearly as low, if any."""
    others: tuple[Other, ...] = ()
    """With other numbers of contacts in gaps, or before one camera, nearly as probable."""
    depths: Depths | None = None
    """Of a ball without contacts before one camera: its paths at all distances."""


class Other(NamedTuple):
    """A solution of another problem of the same track; odds: log, of the solution that it is compared with."""

    problem: TrackProblem
    solution: Solution
    odds: float


@dataclass(frozen=True)
class Earlier:
    """The information from samples before a problem's: initial values, and factors in place of some priors."""

    start: Values
    summaries: Sequence[FactorBatch] = ()

    def join(self, graph: BallGraph) -> BallGraph:
        """The window's graph with the summaries in it."""
        known, priors = {int(v) for s in self.summaries for v in s.variables[0]}, (PriorFactors, BiasStartFactors)
        kept = [b for b in graph.batches if not (isinstance(b, priors) and int(b.variables[0, 0]) in known)]
        return BallGraph((*kept, *self.summaries))


def initial_states(
    track: Track, contacts: tuple[Contact, ...], segmentation: Segmentation, model: BallModel, label: SpinLabel | None
) -> Array:
    """(n, 9) states from the sliding window: measured positions, mean velocities of windows without events.

    The spin is the label's, or zero, up to the first contact; each contact changes it by the model. A resting ball is
    put on its surface and rolls.
    """
    states = np.zeros((len(track), STATE_DIM))
    states[:, POSITION] = bridged_positions(track, segmentation)
    breaks = np.unique([c.interval for c in contacts] + segmentation.hits.tolist() + segmentation.restarts.tolist())
    states[:, VELOCITY] = window_velocities(track.times, states[:, POSITION], breaks.astype(np.int64))
    if label is not None:
        states[:, SPIN] = label.spin
    for contact in sorted(contacts, key=lambda c: c.time):  # the state before it can reach it
        before = states[[contact.interval]]
        states[contact.interval, Z] -= min(0.0, float(gaps(model, before, contact.height)[0]))
        states[contact.interval, VZ] = before[0, VZ] = min(float(before[0, VZ]), -LEAST_FALL)
        states[contact.interval + 1 :, SPIN] = bounced(model, before)[0, SPIN]
    for rest in segmentation.rests:  # rolling: saturated friction does not determine the direction of the spin
        down = states[rest.first : rest.last + 2]
        down[:, Z] -= gaps(model, down, rest.height)
        down[:, VZ] = 0.0
        down[:, SPIN.start] = -down[:, VELOCITY.start + 1] / model.radius
        down[:, SPIN.start + 1] = down[:, VELOCITY.start] / model.radius
    return states


class ContactSearch:
    """The arrangements of a track's contacts and hits, beginning with its segmentation."""

    def __init__(self, problem: TrackProblem, surfaces: Surfaces) -> None:
        self.problem, self.surfaces = problem, surfaces
        self._seen: dict[Arrangement, Solution] = {}
        self._settled: Solution | None = None
        self._best: Solution | None = None

    @property
    def best(self) -> Solution:
        """The lowest minimum so far; among those with consistent contacts and hits, if any."""
        return min(self._seen.values(), key=lambda s: s.minimum.error) if self._best is None else self._best

    def after(self, solution: Solution) -> tuple[Events, Values] | None:
        """The next arrangement with initial values, after a solution for the previous one; None at the end."""
        times, ball = self.problem.track.times, self.problem.ball
        events = solution.events
        here = arrangement_of(events)
        self._seen[here] = solution
        contacts, values = refined_contacts(times, solution), solution.minimum.values
        noise = float(np.median(self.problem.sigma))
        refined = Events(contacts, with_moved_hits(events.segmentation, contacts, times, values, ball, noise))
        if arrangement_of(refined) == here:
            sided = self._sided(solution)
            if sided is not None:
                return sided
            unseen = () if self._settled else contacts_at_ends(times, solution, ball, self.surfaces)
            if not unseen:  # a contact that only the end of the track suggests must also explain it better
                gain = np.inf if self._settled is None else self._settled.minimum.error - solution.minimum.error
                more = self._settled is None or gain > (DEAR if self.problem.one_view else 0.0)
                self._best = solution if more else self._settled
                return None
            self._settled = solution
            refined = replace(refined, contacts=tuple(sorted((*refined.contacts, *unseen), key=lambda c: c.time)))
        if arrangement_of(refined) in self._seen or len(self._seen) == MAX_REFINEMENTS:
            return self._sided(self.best)
        places = places_of(events.contacts), places_of(refined.contacts)
        values = move_hits(values, times, events.segmentation.hits, refined.segmentation.hits, ball)
        return refined, move_contacts(values, times, *places, ball)

    def _sided(self, solution: Solution) -> tuple[Events, Values] | None:
        """The same arrangement with measurements that a solution without them shows to be on one side of a contact."""
        events, found, observed = solution.events, solution.minimum, self.problem.observed
        waiting = any(batch is not observed[name] for name, batch in self.problem.beside(events).items())
        if not waiting or events.spans is not None or found.step is None:
            return None
        known = marginal_covariances(found.step.root).definite()
        return None if known is None else (replace(events, spans=spans_of(self.problem, solution, known)), found.values)


def spans_of(problem: TrackProblem, solution: Solution, known: Covariances) -> dict[int, tuple[float, float]]:
    """From when to when, s, the contacts of each interval may be, by the sigma of their times.

    Args: known: covariances at the solution.
    """
    times, values, own = problem.track.times, solution.minimum.values, slice(problem.width)
    shared = Shared(values.coefficients[own], known.coefficients[own, own], known.cross[:, :STATE_DIM, own])
    found = {}
    for interval, met in contacts_by_interval(timed_contacts(times, solution)).items():
        ends, stamps = [met[0], met[-1]], np.array([interval, interval + 1])
        lags = np.array([contact.time for contact in ends]) - times[stamps]
        states, covariances = values.states[stamps], known.states[stamps, :STATE_DIM, :STATE_DIM]
        sigmas = gap_sigmas(states, covariances, shared, stamps, [c.height for c in ends], problem.ball, lags)
        speeds = np.abs(states[:, VZ] - STANDARD_GRAVITY * lags)
        begin, end = FAR * sigmas / np.maximum(speeds, LEAST_SPEED) * [-1.0, 1.0] + times[stamps] + lags
        found[interval] = (float(begin), float(end))
    return found


def contacts_at_ends(times: Array, solution: Solution, model: BallModel, surfaces: Surfaces) -> tuple[Contact, ...]:
    """Contacts that only a single sample at either end shows, too few for the segmentation.

    The last state has fallen through a surface; or the first, extrapolated from later samples, rises from below one.
    """
    values, events, last = solution.minimum.values, solution.events, len(times) - 1
    taken = {c.interval for c in events.contacts} | set(events.segmentation.hits.tolist())
    for rest in events.segmentation.rests:
        taken |= set(range(rest.first, rest.last + 1))
    coefficients = np.tile(values.coefficients[: model_width(model)], (2, 1))
    found = []
    for inside, beyond in ((1, 0), (last - 1, last)) if last > 0 else ():
        interval, speed = min(inside, beyond), float(values.states[beyond, VZ])
        if interval in taken or (beyond - inside) * speed >= 0.0:  # it does not move away from the other samples
            continue
        pair = np.concatenate((values.states[[inside, beyond]], coefficients), axis=1)
        height = surfaces.level_below(pair, surface_offsets(model, pair))[0]
        above, below = gaps(model, pair, float(height)).tolist()
        if above >= 0.0 > below and bool(surfaces.over_table(pair)[1]):
            time = times[beyond] - below / speed
            found.append(Contact(interval, float(np.clip(time, times[interval], times[interval + 1])), float(height)))
            taken.add(interval)
    return tuple(found)


def refined_contacts(times: Array, solution: Solution) -> tuple[Contact, ...]:
    """The contacts, each in the interval of its estimated time, without those outside the track."""
    refined = []
    for contact in timed_contacts(times, solution):
        if not times[0] <= contact.time <= times[-1]:
            continue
        interval = min(max(int(np.searchsorted(times, contact.time, side="right")) - 1, 0), len(times) - 2)
        step = min(max(interval - contact.interval, -1), 1)  # one interval at a time: the estimate moves along
        refined.append(Contact(contact.interval + step, contact.time, contact.height))
    return tuple(refined)


def move_contacts(
    values: Values, times: Array, old: Sequence[tuple[int, float]], new: Sequence[tuple[int, float]], model: BallModel
) -> Values:
    """Values for a continued search after contacts moved: a state after its contact is now before it, or vice versa.

    Args: values: for the old contacts.  times: (n,) s.  old, new: interval and height of each contact.
    """
    states = values.states.copy()
    changed = sorted({i for i, _ in set(old) ^ set(new)})
    for interval in changed:
        if interval - 1 in changed:
            continue  # the contact entered or left this interval; the state after both is right already
        heights = tuple(height for i, height in new if i == interval)
        start = np.concatenate((states[interval], values.coefficients[: model_width(model)]))[None]
        gap = float(gaps(model, start, heights[0])[0]) if heights else 0.0
        if gap < 0.0 < states[interval, VZ]:  # it was on the way up, from below: before the contact it mirrors that
            states[interval, [Z, VZ]] -= (2.0 * gap, 2.0 * states[interval, VZ])
            start[0, :STATE_DIM] = states[interval]
        after, _ = fly_through(model, start, np.diff(times[interval : interval + 2]), heights)
        if np.isfinite(after).all():
            states[interval + 1] = after[0, :STATE_DIM]
    return replace(values, states=states)


def arrangement_of(events: Events) -> Arrangement:
    """The places of contacts and of hits."""
    return places_of(events.contacts), tuple(events.segmentation.hits.tolist())


def places_of(contacts: tuple[Contact, ...]) -> tuple[tuple[int, float], ...]:
    """Interval and height of each contact."""
    return tuple((c.interval, c.height) for c in contacts)


def timed_contacts(times: Array, solution: Solution) -> tuple[Contact, ...]:
    """The contacts with their estimated times; unchanged without an estimate."""
    grouped = contacts_by_interval(solution.events.contacts)
    timed: list[Contact] = []
    for batch in (batch for batch in solution.graph.batches if isinstance(batch, ContactFactors)):
        elapsed_of = batch.contact_times(solution.minimum.values)
        for interval, elapsed in zip(batch.variables[:, 0].tolist(), elapsed_of, strict=True):
            for contact, tau in zip(grouped[interval], elapsed.tolist(), strict=True):
                time = float(times[interval]) + tau if math.isfinite(tau) else contact.time
                timed.append(Contact(interval, time, contact.height))
    return tuple(sorted(timed, key=lambda c: c.time))


def minimise_with_restart(optimizer: LevenbergMarquardt, graph: BallGraph, start: Values) -> Minimum:
    """The minimum from a start; where a spin let go of its label, the lower of it and the one by convex losses."""
    found = optimizer.minimize(graph, start)
    able = [batch for batch in graph.batches if isinstance(batch, LABELS) and batch.loss.convex != batch.loss]
    far = (np.linalg.norm(b.linearize(found.values).residual, axis=-1) > b.loss.scale for b in able)
    if not any(beyond.any() for beyond in far):  # else the label's loss pulls less with distance
        return found
    convex = (b.with_loss(b.loss.convex) if isinstance(b, LABELS) else b for b in graph.batches)
    held = optimizer.minimize(BallGraph(tuple(convex)), start)
    again = optimizer.minimize(graph, held.values)
    return again if again.error < found.error else found


def worst_break(solution: Solution) -> int | None:
    """The interval with the largest broken dynamics residual, if any; a hit widens the noise of its interval."""
    worst, where = BROKEN, None
    for batch, rows in zip((b for b in solution.graph.batches if len(b)), solution.minimum.linearized, strict=True):
        if isinstance(batch, DynamicsFactors):
            with np.errstate(over="ignore"):  # broken without measure
                norm = np.linalg.norm(rows.residual, axis=-1)
            norm[np.isin(batch.variables[:, 0], solution.events.segmentation.hits)] = 0.0
            if not norm.max() <= worst:
                worst, where = norm.max(), int(batch.variables[norm.argmax(), 0])
    return where


def leads_nowhere(solution: Solution, before: Solution) -> bool:
    """True if one more hit left the search without a minimum and hardly lowered the objective."""
    found, gone = solution.minimum, solution.minimum.convergence in NOWHERE
    return gone and found.error > LEAST_GAIN * before.minimum.error
