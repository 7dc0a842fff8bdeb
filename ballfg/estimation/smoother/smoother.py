"""The smoother finds the most probable states of a whole track by Levenberg-Marquardt on its factor graph."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_instance
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.window_velocity import window_velocities
from ballfg.estimation.plausible import LEAST_POSITION_SIGMA, measured_only, plausible
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation.batch import assembled
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.estimation.segmentation.segmenter import USUAL, Segmenter
from ballfg.estimation.settings import Settings, sample_sigmas, spin_start, total_sigmas
from ballfg.estimation.sides.monitor import widened_near_contacts
from ballfg.estimation.smoother.problem import Events, TrackProblem
from ballfg.estimation.smoother.second_look.at_end import (
    Solved,
    from_before_a_bounce,
    log_evidence,
    with_both_sides,
    with_fall_at_end,
    with_hit_at_end,
    with_other_beginning,
)
from ballfg.estimation.smoother.second_look.low_hops import LowHops, counted, low_hops, uncounted_note, with_low_hops
from ballfg.estimation.smoother.second_look.spin_ambiguity import rival_note, with_other_spins
from ballfg.estimation.smoother.settle import (
    ROUGH,
    ContactSearch,
    Earlier,
    Solution,
    initial_states,
    leads_nowhere,
    minimise_with_restart,
    timed_contacts,
    worst_break,
)
from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.graph import Convergence, LevenbergMarquardt
from ballfg.factors.linear.covariance import Covariances
from ballfg.state import STATE_DIM
from ballfg.tracks import Ball, Track

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

MAX_UNSEEN_HITS = 8
"""Largest number of hits that the estimate adds to the segmentation's; measured logs needed three at most."""
LONG: Final = 10_000
"""Number of samples from which a track is smoothed in pieces that are then joined (docs/derivations/long_tracks.md)."""
AT_MINIMUM = (Convergence.CONVERGED, Convergence.AT_KINK)
OFFSET_ROUNDS = 6
"""Largest number of corrections of stamps by estimated time offsets; 4 ms need three."""
FIRST_STEPS = 15
"""Linear solutions of the first round, after which stamps are corrected in any case."""


class Smoother(Estimator):
    """Maximum a posteriori estimate of all states of a track.

    The segmentation finds contacts, hits and outliers; the estimate then refines contacts: one whose estimated time
    lies outside its interval moves to the right one, and the graph is solved again.

    If observations add unknowns that change stamps (`settings.time_offsets` of cameras), stamps are corrected by their
    estimates until they converge.

    A track is smoothed at once, whatever its length, with 20 kB a sample. bf.estimate and `make_estimator` give the
    `PiecewiseSmoother`, which smooths long ones in pieces.

    Args:
        model: the ball.  surfaces: table and floor.  settings: noise and priors.
        optimizer: settings of the minimisation; None: those of the settings' solver.
    """

    name = "smoother"
    has_graph = True
    takes_one_view = True

    def __init__(
        self,
        model: BallModel | Ball,
        surfaces: Surfaces | float,
        settings: Settings | None = None,
        optimizer: LevenbergMarquardt | None = None,
    ) -> None:
        super().__init__(model, surfaces, settings)
        if optimizer is None and self.settings.solver == "gtsam":
            from ballfg.factors.gtsam_solver import GtsamLevenbergMarquardt  # a tenth of a second

            optimizer = GtsamLevenbergMarquardt()
        self.optimizer = LevenbergMarquardt() if optimizer is None else optimizer
        check_instance("optimizer", self.optimizer, LevenbergMarquardt, "Leave it out for the usual one.")

    def estimate(self, track: Track, factors: Sequence[FactorBatch] = (), *, move_stamps: bool = True) -> Estimate:
        """The states of a track, one per stamp, with the covariances of the Laplace approximation.

        Args: track, factors: as for every estimator.  move_stamps: False leaves stamps unchanged.
        """
        track = self.prepared(track, factors)
        moving = move_stamps and bool(self.settings.time_offsets)
        joined = self.in_pieces(track)
        if joined is not None:
            return joined
        smoother = self.first_look() if moving else self
        for _ in range(OFFSET_ROUNDS):
            problem, *rivals = smoother.problems(track.since_first())  # as `solved`, which would lengthen the way
            problem, solution = smoother.likeliest(problem, smoother.settle(problem), rivals)
            problem, solution = smoother.bridged(problem, solution)
            found = smoother.result(problem, solution)
            estimate = found.dated(track.times)
            if not moving or estimate.status.failed:
                return estimate
            retimed = [later for one in problem.observations if (later := one.retimed(track, estimate)) is not None]
            if not retimed and smoother is self:
                return estimate
            track, smoother = retimed[0] if retimed else track, self
        return replace(estimate, status=Status.NOT_CONVERGED)

    def in_pieces(self, track: Track) -> Estimate | None:
        """The estimate of a track that is too long to be smoothed at once; None for all others, and always here.

        `PiecewiseSmoother` has one. Args: track: prepared.
        """
        return None

    def first_look(self) -> Smoother:
        """The smoother for stamps with errors of milliseconds.

        A flight then seems to be full of hits, which would absorb the offsets; and with wrong contacts no step reduces
        the objective, while the offsets are nearly right after a few steps.
        """
        calm = replace(self.settings, find_events=False)
        return Smoother(self.model, self.surfaces, calm, replace(self.optimizer, max_iterations=FIRST_STEPS))

    def segment(self, track: Track, longest_gap: float = USUAL.longest_gap) -> Segmentation:
        """The events in a track; longest_gap: s, from which on the two sides are explained by themselves."""
        return self._segmented(track, longest_gap)[0]

    def _segmented(
        self, track: Track, longest_gap: float = USUAL.longest_gap
    ) -> tuple[Segmentation, tuple[LowHops, ...]]:
        """The events in a track, and the compatible low hops."""
        for observation in track.observations:
            shown = observation.segmentation()
            if shown is not None:
                return shown, ()
        settings, prices = self.settings.for_track(track), replace(USUAL, longest_gap=longest_gap)
        white = sample_sigmas(settings, len(track), track.sigmas)
        sigma = total_sigmas(settings, white, partial(window_velocities, track.times, track.positions))
        ball = physics_of(self.model)
        passed = Segmenter(self.surfaces, ball, prices).push_all(track.times, track.positions, sigma)
        found = assembled((*passed.final, *passed.pending), track.times, track.positions, ball, prices)
        found = found if self.settings.find_events else found.only_contacts()
        hops = self.low_hops(track, found)
        return counted(found, hops, track.times), hops

    def low_hops(self, track: Track, events: Segmentation) -> tuple[LowHops, ...]:
        """The stretches with hops too low for distinguishing single bounces."""
        return low_hops(track, events, self.model, self.surfaces, self.settings)

    def problems(self, track: Track) -> list[TrackProblem]:
        """The minimisation problem of a track, from each start that its observations offer."""
        starts = [track]
        for observation in track.observations:
            starts = [start for one in starts for start in observation.starts(one, self.model, self.surfaces)]
        return [self.problem(start) for start in starts]

    def solved(self, track: Track) -> tuple[TrackProblem, Solution]:
        """The most probable problem among those of a track's starts, and its solution.

        Args: track: prepared, with stamps since its first.
        """
        problem, *rivals = self.problems(track)
        return self.bridged(*self.likeliest(problem, self.settle(problem), rivals))

    def bridged(self, problem: TrackProblem, solution: Solution) -> Solved:
        """The problem and its solution, or those with a more probable number of contacts in gaps between samples."""
        if np.diff(problem.track.times).max(initial=0.0) <= USUAL.short_gap:
            return problem, solution
        from ballfg.estimation.smoother.second_look.gaps import bridged  # few tracks have gaps

        return bridged(self, problem, solution)

    def likeliest(self, problem: TrackProblem, solution: Solution, rivals: Sequence[TrackProblem]) -> Solved:
        """A problem with its solution, or the most probable of its rivals with its own."""
        if not problem.one_view:
            return problem, solution
        from ballfg.estimation.smoother.second_look.explanations import most_probable  # of one camera's tracks

        return most_probable(self, (problem, solution), rivals)

    def problem(
        self, track: Track, segmentation: Segmentation | None = None, sigma: Array | None = None
    ) -> TrackProblem:
        """The minimisation problem of a track.

        Args:
            track: with its observations.
            segmentation: the initial events; None: found in the track.
            sigma: (n, 3) m, of the positions; None: the settings' or the track's own.
        """
        events, hops = self._segmented(track) if segmentation is None else (segmentation, None)
        return TrackProblem(track, self.model, self.settings, events, sigma, hops)

    def settle(self, problem: TrackProblem, earlier: Earlier | None = None) -> Solution:
        """The minimum with its events.

        Contacts and hits move to their estimated intervals; without a label that determines the spin, lower minima with
        another spin are searched; if the motion still contradicts the model by far more than its noise, an unseen hit
        is added. All this is decided at rough minima (`ROUGH`).

        Args: problem: of a track.  earlier: information from before, if the track is the end of a longer one.
        """
        rough = replace(self.optimizer, tolerance=max(ROUGH, self.optimizer.tolerance))
        segmentation, before = problem.segmentation, None
        label = problem.settings.spin_label(problem.track)
        starts = (one.loosened(problem.track) for one in problem.observations) if earlier is None else ()
        loose = next((start for start in starts if start is not None), None)
        if loose is not None:  # an observation asks for more noise, to be solved first
            near = self.settle(self.problem(loose, problem.segmentation))
            earlier = Earlier(near.minimum.values)
            segmentation = replace(near.events.segmentation, contacts=near.events.contacts)
        for left in range(MAX_UNSEEN_HITS if self.settings.find_events else 0, -1, -1):
            search = ContactSearch(problem, self.surfaces)
            if earlier is None:
                states = initial_states(problem.track, segmentation.contacts, segmentation, self.model, label)
            start = problem.start(states) if earlier is None else earlier.start
            arrangement: tuple[Events, Values] | None = Events(segmentation.contacts, segmentation), start
            while arrangement is not None:
                events, values = arrangement
                graph = problem.graph(events)
                graph = graph if earlier is None else earlier.join(graph)
                minimum = minimise_with_restart(rough, graph, values)
                arrangement = search.after(Solution(events, graph, minimum))
            solution = search.best
            segmentation = solution.events.segmentation
            if earlier is None and not spin_start(label, problem.settings).measured:
                solution = with_other_spins(solution, problem.ball, rough)
            if before is not None and leads_nowhere(solution, before):
                break
            interval = worst_break(solution) if left else None
            if interval is None:
                break
            segmentation, before = replace(segmentation, hits=np.union1d(segmentation.hits, [interval])), solution
        found = solution.minimum
        if found.convergence is Convergence.CONVERGED and found.distance >= self.optimizer.tolerance:
            found = self.optimizer.minimize(solution.graph, found)
        return replace(solution, minimum=found.bare())

    def result(self, problem: TrackProblem, solution: Solution, *, begins: bool = True) -> Estimate:
        """The estimate of a track from a solution.

        Args: begins: True if the first state is the track's, False if earlier samples are known.
        """
        rival: Solved | None = from_before_a_bounce(self, problem, solution) if begins else None
        odds = np.inf if rival is None else log_evidence(solution) - log_evidence(rival[1])
        others = solution.others
        if rival is not None and odds < 0.0:
            others = tuple(one._replace(odds=one.odds - odds) for one in others)
            (problem, solution), rival, odds = rival, (problem, solution), -odds
        estimate = self.explained(problem, solution)
        if rival is not None:
            estimate = with_other_beginning(estimate, self.explained(*rival), odds)
        for one in others:
            from ballfg.estimation.smoother.second_look.gaps import with_other_contacts

            other = self.explained(one.problem, one.solution)
            estimate = with_other_contacts(estimate, other, one.odds, one_view=problem.one_view)
        if problem.one_view:  # the first samples alone, as a second look takes them, would not show their depth
            return problem.judged(estimate)
        estimate = with_hit_at_end(self, problem, with_both_sides(self, problem, estimate))
        estimate = with_fall_at_end(self, problem, estimate)
        segmentation = solution.events.segmentation
        hops = problem.hops if segmentation is problem.segmentation else None
        hops = self.low_hops(problem.track, segmentation) if hops is None else hops
        uncounted = uncounted_note(hops, problem.track.times)
        estimate = replace(estimate, notes=estimate.notes + uncounted) if uncounted else estimate
        return with_low_hops(estimate, hops, self.model)

    def explained(self, problem: TrackProblem, solution: Solution) -> Estimate:
        """The estimate by one explanation of a track, over all distances that it leaves open to one camera."""
        known = self.optimizer.covariances(solution.graph, solution.minimum)
        estimate = self.at_minimum(problem, solution, known)
        return estimate if solution.depths is None else problem.judged(solution.depths.onto(estimate))

    def at_minimum(self, problem: TrackProblem, solution: Solution, known: Covariances | None) -> Estimate:
        """The estimate at a minimum, before a second look at the end of the track and at low hops.

        Args: problem: of a track.  solution: of it.  known: covariances there; None if undetermined.
        """
        minimum, segmentation = solution.minimum, solution.events.segmentation
        track, values = problem.track, solution.minimum.values
        n, p, covariances = len(track), len(values.coefficients), known
        if covariances is None:  # each state by itself
            least = np.maximum(problem.sigma, LEAST_POSITION_SIGMA)
            _, states = measured_only(track.positions, least, problem.settings)
            covariances = Covariances(states, np.diag(problem.coefficient_sigmas**2), np.zeros((n, STATE_DIM, p)))
        status = Status.OK if minimum.convergence in AT_MINIMUM else Status.NOT_CONVERGED
        if minimum.convergence is Convergence.NOT_FINITE or minimum.step is None:
            status = Status.FAILED
        elif n - 1 <= len(np.unique(segmentation.restarts)):
            status = Status.NO_VELOCITY
        own, rest = slice(0, problem.width), slice(problem.width, p)
        estimate = Estimate(
            name=track.name,
            times=track.times,
            states=values.states,
            covariances=covariances.states[:, :STATE_DIM, :STATE_DIM],
            status=status,
            innovations=problem.innovations(solution.events, values, known),
            coefficient_names=tuple(self.settings.coefficients),
            coefficients=values.coefficients[own],
            coefficient_covariance=covariances.coefficients[own, own],
            cross_covariances=covariances.cross[:, :STATE_DIM, own],
            unknown_names=problem.unknowns.names,
            unknowns=problem.unknowns.origins + values.coefficients[rest],
            unknown_covariance=covariances.coefficients[rest, rest],
            contacts=timed_contacts(track.times, solution),
            hits=segmentation.hits,
            quality=segmentation.quality,
            error=minimum.error,
            iterations=minimum.iterations,
            world=replace(self.world, process=problem.settings.process),
            notes=(*self.doubts(track), *problem.notes(solution.events)),
        )
        estimate = plausible(estimate, track, problem.sigma, self.settings)
        estimate = problem.judged(estimate)
        rival = rival_note(solution.rival, values.states[0], estimate.covariances[0])
        estimate = replace(estimate, notes=estimate.notes + rival) if rival else estimate
        return widened_near_contacts(estimate, problem.ball, segmentation.restarts)


class PiecewiseSmoother(Smoother):
    """The smoother, with pieces around it for long tracks; arguments as for `Smoother`."""

    def is_long(self, track: Track) -> bool:
        """True if a track is smoothed in pieces; with changing stamps or GTSAM's solver it is smoothed at once."""
        return len(track) >= LONG and not self.settings.time_offsets and self.settings.solver != "gtsam"

    def in_pieces(self, track: Track) -> Estimate | None:
        """The estimate of a long track; None for any other, or if its pieces cannot be joined."""
        if not self.is_long(track):
            return None
        from ballfg.estimation.smoother.pieces.whole import in_pieces  # most tracks do not need it

        joined = in_pieces(self, track.since_first())
        return None if joined is None else joined.dated(track.times)

    def in_sections(self, track: Track) -> Iterator[Estimate]:
        """The estimate of a long track section by section, of any other as a whole."""
        if self.is_long(track):
            from ballfg.estimation.smoother.pieces.whole import sections

            found = sections(self, self.prepared(track).since_first())
            if found is not None:
                begin = 0
                for part in found:
                    yield part.dated(track.times[begin : begin + len(part)], float(track.times[0]))
                    begin += len(part)
                return
        yield self.estimate(track)
