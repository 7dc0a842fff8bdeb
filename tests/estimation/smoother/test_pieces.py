"""A long track in pieces: the same minimum, covariances and events as the whole track at once."""

from __future__ import annotations

from contextlib import nullcontext
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation.observations.reading import RadarSpeed
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother import smoother as smoother_module
from ballfg.estimation.smoother.pieces import joining
from ballfg.estimation.smoother.pieces.joining import joined_minimum, share_of
from ballfg.estimation.smoother.pieces.reduction import Point, Reduction
from ballfg.estimation.smoother.pieces.section import bounds_of, cut_between, look, part_of
from ballfg.estimation.smoother.pieces.whole import in_pieces
from ballfg.estimation.smoother.second_look import spin_ambiguity
from ballfg.estimation.smoother.smoother import PiecewiseSmoother, Smoother
from ballfg.factors.graph import LevenbergMarquardt
from ballfg.factors.linear.step import solve
from ballfg.parallel.parts import with_jobs
from ballfg.tracks import Track
from tests.faults.large import HEIGHT, rally

MODEL, TABLE = nominal_model(), Surfaces.table_tennis(HEIGHT)
TIGHT = LevenbergMarquardt(tolerance=1e-8)
"""Posterior standard deviations: both ways end much nearer to the minimum than they are compared."""
SAMENESS = 1e-6


def at_once(smoother: Smoother, track: Track, length: int) -> Estimate:
    """The whole graph minimised at once, with the events and the contact times that the pieces began with.

    The process noise of a contact hangs on the time that it had when the graph was made, in 64ths of an interval.
    """
    found = joined_minimum(smoother, track, length)
    assert found is not None
    problem = smoother.problem(track, found.segmentation)
    return smoother.result(problem, smoother.settle(problem))


def assert_same(found: Estimate, whole: Estimate) -> None:
    sigma = whole.sigmas
    assert np.abs((found.states - whole.states) / sigma).max() < SAMENESS
    both = sigma[:, :, None] * sigma[:, None, :]
    assert np.abs((found.covariances - whole.covariances) / both).max() < SAMENESS
    assert np.abs((found.other_sides - whole.other_sides) / both).max() < SAMENESS
    for name, whitened in whole.innovations.items():
        assert np.abs(found.innovations[name] - whitened).max() < SAMENESS
    assert [(c.interval, c.height) for c in found.contacts] == [(c.interval, c.height) for c in whole.contacts]
    assert np.allclose([c.time for c in found.contacts], [c.time for c in whole.contacts], rtol=0, atol=1e-9)
    assert found.hits.tolist() == whole.hits.tolist()
    assert found.quality.tolist() == whole.quality.tolist()
    assert found.error == pytest.approx(whole.error, rel=1e-9)
    assert found.status is whole.status is Status.OK
    assert found.notes == whole.notes
    spread = np.sqrt(np.diag(whole.coefficient_covariance))
    assert np.abs((found.coefficients - whole.coefficients) / spread).max(initial=0.0) < SAMENESS
    own = spread[:, None] * spread
    assert np.abs((found.coefficient_covariance - whole.coefficient_covariance) / own).max(initial=0.0) < SAMENESS
    cross = (found.cross_covariances - whole.cross_covariances) / (sigma[:, :, None] * spread)
    assert np.abs(cross).max(initial=0.0) < SAMENESS


CASES = {
    "coefficients": (Settings.for_measured(MODEL), 50),
    "exact model": (Settings(), 4),
    "memory": (Settings.for_measured(MODEL, memory=(0.001,) * 3, stamp_jitter=1e-4), 7),
}
"""Settings, and the shots after which the ball vanishes for a second."""


@pytest.mark.parametrize(
    "case", ["exact model", *(pytest.param(case, marks=pytest.mark.thorough) for case in ("coefficients", "memory"))]
)
def test_pieces_find_the_minimum_of_the_whole_track(case):
    settings, every = CASES[case]
    smoother, track = Smoother(MODEL, TABLE, settings, TIGHT), rally(3000, seed=3, every=every)
    found = in_pieces(smoother, track, 500)
    assert found is not None
    assert_same(found, at_once(smoother, track, 500))


def test_pieces_leave_out_the_readings_beside_contacts_that_the_whole_track_does():
    """A reading may be near the edge of what is known of a contact's time, and the two know it a little differently."""
    smoother, track = Smoother(MODEL, TABLE, Settings.for_measured(MODEL)), rally(1000, seed=3, every=4)
    dt = np.diff(track.times)
    seen = np.flatnonzero(dt < 0.05)
    speeds = np.linalg.norm(smoother.estimate(track).states[seen, 3:6], axis=1)
    track = track.observed(RadarSpeed.at(track, (track.times[:-1] + 0.3 * dt)[seen], speeds, 0.5))
    found, whole = in_pieces(smoother, track, 500), smoother.estimate(track)
    assert found is not None
    left_out, wanted = (np.isnan(one.innovations["speed"][:, 0]) for one in (found, whole))
    assert 0 < wanted.sum() < len(whole.contacts)
    assert (left_out != wanted).sum() <= 0.05 * len(whole.contacts)
    both = ~(left_out | wanted)
    assert np.abs(found.innovations["speed"][both] - whole.innovations["speed"][both]).max() < 0.1


def test_inner_states_follow_the_ends_as_the_whole_problem_says():
    """Eliminated and taken up again, they take the step of the whole linear problem."""
    smoother = Smoother(MODEL, TABLE, Settings.for_measured(MODEL))
    track = rally(40)
    problem = smoother.problem(track)
    solution = smoother.settle(problem)
    values = problem.start(solution.minimum.values.states + 1e-3)
    linearized = solution.graph.linearize(values)
    step = solve(linearized, values)
    assert step is not None
    reduction = Reduction(linearized, values)
    found = reduction.steps(Point(step.states[0], step.states[-1], step.coefficients))
    assert np.abs((found - step.states) / np.abs(step.states).max(axis=0)).max() < 1e-6
    assert np.abs(step.states[1:-1]).max() > 1e-4


def test_pieces_say_how_many_are_done(monkeypatch):
    said = []

    class Stage:
        text = property(lambda self: said[-1], lambda self, text: said.append(text))

    monkeypatch.setattr(joining, "doing", lambda text: nullcontext(Stage()))
    assert list(joining.watched(abs, [-1, -2, 3], "looked at")) == [1, 2, 3]
    assert said == [f"{k} of 3 pieces looked at" for k in (1, 2, 3)]


def test_events_are_those_of_the_whole_track():
    """Contacts, hits and bad samples, some of them planted where pieces meet."""
    smoother, track = Smoother(MODEL, TABLE, Settings.for_measured(MODEL)), rally(2000, seed=11)
    positions = track.positions.copy()
    positions[[498, 500, 700, 1003, 1501]] += [0.0, 0.2, 0.1]
    track = replace(track, positions=positions)
    found, whole = in_pieces(smoother, track, 500), smoother.estimate(track)
    assert found is not None
    assert [(c.interval, c.height) for c in found.contacts] == [(c.interval, c.height) for c in whole.contacts]
    assert len(found.contacts) >= 25
    assert found.hits.tolist() == whole.hits.tolist()
    assert found.quality.tolist() == whole.quality.tolist()
    assert set(np.flatnonzero(found.quality)) >= {498, 500, 700, 1003, 1501}
    assert found.error == pytest.approx(whole.error, abs=0.5)


def test_a_ball_that_lies_still_across_many_pieces():
    """Its vertical spin is remembered over the whole rest: no overlap of pieces would do."""
    throw, rest = rally(60, seed=5), 900
    times = 0.01 * np.arange(60 + rest)
    lying = np.tile([0.3, 0.2, HEIGHT + MODEL.radius], (rest, 1))
    noise = np.random.default_rng(0).normal(0.0, 0.0015, lying.shape)
    track = Track(
        times, np.concatenate((throw.positions, lying + noise)), labels={"spin_x": 0.0, "spin_y": 0.0, "spin_z": 90.0}
    )
    smoother = Smoother(MODEL, TABLE, Settings(), TIGHT)
    found = in_pieces(smoother, track, 300)
    assert found is not None
    assert_same(found, at_once(smoother, track, 300))


def test_results_do_not_depend_on_the_number_of_processes(monkeypatch):
    monkeypatch.setattr(smoother_module, "LONG", 1000)
    smoother, track = PiecewiseSmoother(MODEL, TABLE, Settings.for_measured(MODEL)), rally(3000, seed=2)
    one, two = (with_jobs(jobs, smoother.estimate, track) for jobs in (1, 2))
    assert one.states.tobytes() == two.states.tobytes()
    assert one.covariances.tobytes() == two.covariances.tobytes()


def test_sections_follow_one_another_and_are_the_whole(monkeypatch):
    monkeypatch.setattr(smoother_module, "LONG", 1000)
    smoother, track = PiecewiseSmoother(MODEL, TABLE, Settings.for_measured(MODEL)), rally(4500, seed=4)
    parts, whole = list(smoother.in_sections(track)), smoother.estimate(track)
    assert len(parts) == 2
    assert np.array_equal(np.concatenate([part.states for part in parts]), whole.states)
    assert np.array_equal(np.concatenate([part.sigmas for part in parts]), whole.sigmas)
    assert np.array_equal(np.concatenate([part.times for part in parts]), track.times)
    assert sum(len(part.contacts) for part in parts) == len(whole.contacts)
    assert sum(len(part.hits) for part in parts) == len(whole.hits)


@pytest.mark.parametrize("bend", [1.9, 1.0, 0.6])
def test_steps_that_lead_back_and_forth_become_shorter(bend):
    """A step that is 1.9 times as long as it should be in one direction: whole ones would take 130 rounds to 1e-6."""
    rng = np.random.default_rng(0)
    true = np.eye(6)[0], rng.normal(size=6)  # directions in which steps are wrong, and right
    off, before, share = np.outer(np.ones(4), true[0] + 1e-4 * true[1]), None, 1.0
    for _ in range(40 if bend < 1.0 else 12):
        step = -off - (bend - 1.0) * np.outer(off @ true[0], true[0])
        share = share_of(step, step if before is None else before, share)
        off, before = off + share * step, step
    assert np.abs(off).max() < 1e-6


def test_a_cut_keeps_away_from_what_happens():
    smoother, track = Smoother(MODEL, TABLE, Settings(), LevenbergMarquardt(tolerance=1e-2)), rally(1000, seed=6)
    looks = [look(smoother, (a, part_of(track, a, b))) for a, b in bounds_of(1000, 250, 64)]
    for one, other in pairwise(looks):
        assert one is not None
        assert other is not None
        cut = cut_between(one, other)
        assert other.begin + 30 <= cut <= one.end - 30
        assert np.abs(np.concatenate((one.busy(), other.busy())) - cut).min() >= 8


def test_a_bounce_that_is_looked_at_by_itself_first_ends_in_the_same_minimum(monkeypatch):
    """Searching the whole chain for every bounce finds nothing that the short look has left out."""
    smoother, track = Smoother(MODEL, TABLE, Settings.for_measured(MODEL)), rally(900, seed=7)
    short = smoother.estimate(track)
    monkeypatch.setattr(spin_ambiguity, "LONG_CHAIN", 10_000)
    full = smoother.estimate(track)
    assert short.error == pytest.approx(full.error, abs=1e-6)
    assert np.abs((short.states - full.states) / full.sigmas).max() < 1e-4


def test_sigmas_that_are_far_too_small_cost_no_more_than_a_few_searches():
    """Hits would have to explain every sample; the search for them ends where they explain nothing."""
    track = rally(120, seed=8)
    found = Smoother(MODEL, TABLE, Settings.for_measured(MODEL)).estimate(
        replace(track, sigmas=np.full((120, 3), 1e-9))
    )
    assert found.status is Status.NOT_CONVERGED
    assert len(found.hits) <= 4
