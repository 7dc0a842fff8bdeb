"""The smoother: the most probable states of a whole track, by Levenberg-Marquardt on its factor graph."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.observations.sighted import SightedTrack, retimed
from ballfg.estimation.result import Estimate, Status, leave_one_out, leave_sighting_out
from ballfg.estimation.segmentation import Segmentation, physics_of, segment
from ballfg.estimation.settings import Settings, sample_sigmas
from ballfg.estimation.smoother.initial import initial_states, move_contacts
from ballfg.estimation.smoother.near_contact import widen_near_contacts
from ballfg.estimation.smoother.problem import (
    PASSENGER,
    Events,
    build_graph,
    coefficient_sigmas,
    effective_sigmas,
    initial_values,
    trackwise_model,
)
from ballfg.estimation.smoother.restart import search_twice
from ballfg.estimation.smoother.solution import Solution, contacts_at_ends, places_of, refined_contacts, timed_contacts
from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.covariance import Covariances, marginal_covariances
from ballfg.factors.dynamics import DynamicsFactors
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt, Minimum
from ballfg.factors.prior import PriorFactors
from ballfg.factors.search import Search, run
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Track

Array = NDArray[np.float64]

MAX_REFINEMENTS = 6
"""How often contacts may move to a neighbouring interval; two were the most seen on measured tracks."""


MAX_UNSEEN_HITS = 8
"""How many hits the estimate may add to those that the segmentation found; measured logs needed three at most."""
BROKEN = 8.0
"""Norm of a whitened dynamics residual (9 dimensions) beyond which its interval hides a hit; chance: one in 1e9."""

LEAST_POSITION_SIGMA = 0.05
"""m. A position in a track that no graph explains is not trusted better than that."""

OFFSET_ROUNDS = 6
"""How often stamps may be moved by the time offsets that were estimated; 4 ms need three."""
FIRST_STEPS = 15
"""Linear solutions of the first round, after which stamps move anyhow."""
OFFSET_SETTLED = 1e-5
"""s. An offset that moves by less is settled: the path bends by a nanometre meanwhile."""


@dataclass(frozen=True)
class Earlier:
    """What the samples of a window owe to those that left it.

    Attributes:
        start: values to start the minimisation from.
        summaries: factors that stand for what left; they replace priors on the same variables.
    """

    start: Values
    summaries: Sequence[FactorBatch]

    def join(self, graph: BallGraph) -> BallGraph:
        """The window's graph with the summaries in it."""
        known = {int(v) for summary in self.summaries for v in summary.variables[0]}
        kept = [k for k in graph.kinds if not (isinstance(k, PriorFactors) and int(k.variables[0, 0]) in known)]
        return BallGraph((*kept, *self.summaries))


class Smoother(Estimator):
    """Maximum a posteriori estimate of all states of a track.

    Contacts, hits, outliers are found by the segmentation; contacts are then refined by the estimate: one whose
    estimated time lies outside its interval moves to where it belongs, and the graph is solved again.

    A `SightedTrack` is estimated from its sightings, not from its positions; with `settings.time_offsets`, stamps move
    by the offsets that were found, until those stay.

    Args:
        model: the ball.  surfaces: what it may bounce on.  settings: noise and priors.
        optimizer: settings of the minimisation.
    """

    name = "smoother"

    def __init__(
        self,
        model: BallModel,
        surfaces: Surfaces,
        settings: Settings,
        optimizer: LevenbergMarquardt | None = None,
    ) -> None:
        super().__init__(model, surfaces, settings)
        self.trackwise = trackwise_model(model, settings)
        self.optimizer = optimizer or LevenbergMarquardt()

    def estimate(self, track: Track) -> Estimate:
        """The states of a track, one per stamp, with the covariances of the Laplace approximation."""
        if not (isinstance(track, SightedTrack) and self.settings.time_offsets):
            return self.estimate_as_timed(track)
        first = self.first_look()
        for k in range(OFFSET_ROUNDS):
            estimate = (self if k else first).estimate_as_timed(track)
            known = np.array([camera.time_offset for camera in track.cameras])
            if estimate.status is Status.FAILED:
                return estimate
            if k > 0 and np.abs(estimate.time_offsets - known).max() < OFFSET_SETTLED:
                return estimate
            track = retimed(track, estimate.time_offsets)
        return replace(estimate, status=Status.NOT_CONVERGED)

    def first_look(self) -> Smoother:
        """The smoother for while stamps are milliseconds off.

        A flight then seems to be full of hits, which would only let the offsets go; and where contacts do not fit, no
        step is good, while the offsets are nearly right after a few.
        """
        calm = replace(self.settings, find_events=False)
        return Smoother(self.model, self.surfaces, calm, replace(self.optimizer, max_iterations=FIRST_STEPS))

    def estimate_as_timed(self, track: Track) -> Estimate:
        """`estimate` with the stamps as they are: time offsets are estimated, but stamps do not move by them."""
        segmentation = self.segment(track)
        sigma = effective_sigmas(track, segmentation, self.settings)
        solution = self.solve(track, segmentation, sigma)
        return self.result(track, sigma, solution)

    def _ball(self, track: Track) -> BallModel:
        """The model with what is estimated along with this track."""
        sighted = isinstance(track, SightedTrack) and bool(self.settings.time_offsets)
        return trackwise_model(self.model, self.settings, track) if sighted else self.trackwise

    def segment(self, track: Track) -> Segmentation:
        """The events in a track."""
        sigma = sample_sigmas(self.settings, len(track), track.sigmas)
        physics = physics_of(self.model)
        found = segment(track.times, track.positions, sigma, surfaces=self.surfaces, physics=physics)
        return found if self.settings.find_events else found.only_contacts()

    def solve(self, track: Track, segmentation: Segmentation, sigma: Array, earlier: Earlier | None = None) -> Solution:
        """Minimise; where the motion still breaks the model by far more than its noise, a hit went unseen: mark it.

        Args:
            track: stamps and positions.
            segmentation: the events to start from.
            sigma: (n, 3) m, of the positions.
            earlier: what came before, where the track is the end of a longer one.
        """
        return run(self.search(track, segmentation, sigma, earlier))

    def search(
        self, track: Track, segmentation: Segmentation, sigma: Array, earlier: Earlier | None = None
    ) -> Search[Solution]:
        """`solve`, asking for linearisations, so that several tracks can be solved together."""
        solution = yield from self._settle(track, segmentation, sigma, earlier)
        for _ in range(MAX_UNSEEN_HITS if self.settings.find_events else 0):
            interval = _worst_break(solution)
            if interval is None:
                break
            segmentation = replace(segmentation, hits=np.union1d(segmentation.hits, [interval]))
            solution = yield from self._settle(track, segmentation, sigma, earlier)
        return solution

    def _settle(
        self, track: Track, segmentation: Segmentation, sigma: Array, earlier: Earlier | None
    ) -> Search[Solution]:
        """Minimise, move contacts to where the estimate says they are, and minimise again until they stay."""
        events, ball = Events(segmentation.contacts, segmentation), self._ball(track)
        if earlier is None:
            label = self.settings.spin_label(track)
            states = initial_states(track, events.contacts, segmentation, self.model, label)
            values = initial_values(states, ball, self.settings)
        else:
            values = earlier.start
        seen: dict[tuple[tuple[int, float], ...], Solution] = {}
        settled: tuple[Solution, ...] = ()
        for _ in range(MAX_REFINEMENTS):
            graph = build_graph(track, ball, events, sigma, self.settings)
            graph = graph if earlier is None else earlier.join(graph)
            minimum = yield from search_twice(self.optimizer, graph, values)
            solution = Solution(events, graph, minimum)
            seen[places_of(events.contacts)] = solution
            refined = refined_contacts(track.times, solution)
            if places_of(refined) == places_of(events.contacts):
                unseen = () if settled else contacts_at_ends(track.times, solution, ball, self.surfaces)
                if not unseen:  # a contact that only the end of the track suggests must also explain it better
                    return min((*settled, solution), key=lambda s: s.minimum.error)
                settled = (solution,)
                refined = tuple(sorted((*refined, *unseen), key=lambda c: c.time))
            if places_of(refined) in seen:
                break
            values = move_contacts(
                solution.minimum.values, track.times, places_of(events.contacts), places_of(refined), ball
            )
            events = Events(refined, segmentation)
        return min(seen.values(), key=lambda s: s.minimum.error)

    def result(self, track: Track, sigma: Array, solution: Solution) -> Estimate:
        """What a solution says about the track."""
        minimum, segmentation = solution.minimum, solution.events.segmentation
        n, p = len(track), len(minimum.values.coefficients)
        states, contacts = minimum.values.states, timed_contacts(track.times, solution)
        ball = self._ball(track)
        if minimum.step is None:
            covariances = _prior_covariances(n, sigma, self.settings, coefficient_sigmas(ball, self.settings))
        else:
            covariances = marginal_covariances(minimum.step.bayes_net, n, p)
        names = ball.names if isinstance(ball, AugmentedModel) else ()
        own, rest = slice(0, len(names)), slice(len(names), p)
        estimate = Estimate(
            name=track.name,
            times=track.times,
            states=states,
            covariances=widen_near_contacts(
                track.times, states, covariances.states, contacts, self.model, self.surfaces
            ),
            status=_status(minimum, n),
            whitened=_whitened(track, sigma, solution, covariances),
            coefficient_names=names,
            coefficients=minimum.values.coefficients[own],
            coefficient_covariance=covariances.coefficients[own, own],
            cross_covariances=covariances.cross[..., own],
            contacts=contacts,
            hits=segmentation.hits,
            quality=segmentation.quality,
            error=minimum.error,
            iterations=minimum.iterations,
        )
        if not isinstance(track, SightedTrack):
            return estimate
        found = ball.passengers if isinstance(ball, AugmentedModel) else ()
        return _with_offsets(
            estimate, track, found, minimum.values.coefficients[rest], covariances.coefficients[rest, rest]
        )


def _whitened(track: Track, sigma: Array, solution: Solution, covariances: Covariances) -> Array:
    """The innovations of positions (n, 3) or sightings (m, 2); NaN where there is no linear solution."""
    minimum = solution.minimum
    if minimum.step is None:
        return np.full((len(track.sightings), 2) if isinstance(track, SightedTrack) else (len(track), 3), np.nan)
    samples = solution.graph.kinds[0].linearize(minimum.values)
    if isinstance(track, SightedTrack):
        return leave_sighting_out(samples, covariances)
    return leave_one_out(minimum.values.states, covariances.states, track.positions, sigma, samples)


def _with_offsets(
    estimate: Estimate, track: SightedTrack, passengers: tuple[str, ...], found: Array, covariance: Array
) -> Estimate:
    """The estimate with the time offsets of all cameras of the track, those too that were not estimated."""
    names = track.sightings.cameras
    rows = [names.index(name.removeprefix(PASSENGER)) for name in passengers]
    offsets = np.array([camera.time_offset for camera in track.cameras])
    offsets[rows] += found
    spread = np.zeros((len(names), len(names)))
    spread[np.ix_(rows, rows)] = covariance
    return replace(estimate, cameras=names, time_offsets=offsets, time_offset_covariance=spread)


def _worst_break(solution: Solution) -> int | None:
    """The interval whose dynamics factor is broken most, if any is; intervals with a hit have theirs in the noise."""
    worst, where = BROKEN, None
    for kind in solution.graph.kinds:
        if isinstance(kind, DynamicsFactors):
            norm = np.linalg.norm(kind.linearize(solution.minimum.values).residual, axis=-1)
            norm[np.isin(kind.variables[:, 0], solution.events.segmentation.hits)] = 0.0
            if not norm.max() <= worst:
                worst, where = norm.max(), int(kind.variables[norm.argmax(), 0])
    return where


def _status(minimum: Minimum, samples: int) -> Status:
    if minimum.convergence is Convergence.NOT_FINITE or minimum.step is None:
        return Status.FAILED
    if samples < 2:
        return Status.NO_VELOCITY
    at_minimum = minimum.convergence in (Convergence.CONVERGED, Convergence.AT_KINK)
    return Status.OK if at_minimum else Status.NOT_CONVERGED


def _prior_covariances(n: int, sigma: Array, settings: Settings, coefficients: Array) -> Covariances:
    """What is known of each state by itself, where the graph could not be solved; sigmas (p,) of the coefficients."""
    spread = np.empty((n, STATE_DIM))
    spread[:, POSITION] = np.maximum(sigma, LEAST_POSITION_SIGMA)
    spread[:, VELOCITY], spread[:, SPIN] = settings.velocity_prior, settings.spin_prior
    states = spread[..., None] ** 2 * np.eye(STATE_DIM)
    return Covariances(states, np.diag(coefficients**2), np.zeros((n, STATE_DIM, len(coefficients))))
