"""A bounce has a minimum where the ball slides and one where it grips; the lower one is found."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import ballfg.estimation.smoother.smoother as room
from ballfg.dynamics.motion.impact import slip_velocity
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.smoother.second_look.spin_ambiguity import Bounce, bounces_of, other_sides
from ballfg.estimation.smoother.settle import Solution
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.batch import Values
from tests.estimation.smoother.one_bounce import FALSE, MODEL, SETTINGS, SURFACES, excess, flown, measured, one_bounce

DEFAULT, SQUARED, _, _ = SETTINGS.values()
KEPT = {
    "slid for grips": ([0, 0, 0.37, 5.99, 0.54, -2.38, -106.26, 190.55, 58.79], 50, 120, 0, DEFAULT),
    "the same, squared losses": ([0, 0, 0.37, 5.99, 0.54, -2.38, -106.26, 190.55, 58.79], 50, 120, 0, SQUARED),
    "on the way the slip overshoots": ([0, 0, 0.45, 7.72, -0.23, -1.56, 78.9, 312.74, 120.5], 41, 100, 1, DEFAULT),
    "a long track": ([0, 0, 0.18, 4.94, 0.04, -0.46, -0.53, 162.11, 153.73], 85, 200, 1, DEFAULT),
}
"""Start, samples, rate Hz, seed of the noise, settings. From one start alone these tracks end 30 to 180 above the lower
minimum."""


@pytest.fixture(params=KEPT, ids=lambda name: name)
def kept(request: pytest.FixtureRequest) -> tuple:
    start, count, rate, seed, settings = KEPT[request.param]
    times = np.arange(count) / rate
    truth = flown(np.array(start, float), times)
    return truth, measured(truth, times, np.random.default_rng(seed), 0.0015), settings


def test_the_lower_minimum_is_found(kept: tuple, monkeypatch: pytest.MonkeyPatch) -> None:
    truth, track, settings = kept
    assert excess(truth, track, settings) < 1e-3
    estimate = Smoother(MODEL, SURFACES, settings).estimate(track)
    away = estimate.states[0, 6:] - truth[0, 6:]
    assert away @ np.linalg.solve(estimate.covariances[0, 6:, 6:], away) < 16.3  # 0.1 % of chi-square, 3 axes

    def one_start(solution: Solution, *_: object) -> Solution:
        return solution

    monkeypatch.setattr(room, "with_other_spins", one_start)
    assert excess(truth, track, settings) > 30.0


@pytest.mark.parametrize("name", SETTINGS)
def test_one_bounce_tracks_end_where_a_start_from_the_truth_does(name: str) -> None:
    settings = SETTINGS[name]
    tracks = one_bounce(40, 401, 100.0, settings.position_noise[0])
    assert sum(excess(truth, track, settings) > FALSE for truth, track in tracks) == 0


def test_another_spin_that_explains_the_track_is_named() -> None:
    settings = replace(DEFAULT, position_noise=(0.002,) * 3, spin_prior=100.0)
    _, track = one_bounce(27, 78, 120.0, 0.002)[26]
    (note,) = Smoother(MODEL, SURFACES, settings).estimate(track).notes
    assert note == (
        "two spins explain the track nearly as well: (-133, 143, -22) and (-167, 140, -59) rad/s at its start; "
        "a spin label decides"
    )
    labelled = replace(track, labels={"spin_x": -133.0, "spin_y": 143.0, "spin_z": -22.0})
    assert Smoother(MODEL, SURFACES, settings).estimate(labelled).notes == ()


def test_the_other_side_keeps_the_direction_of_the_slip() -> None:
    truth, track = one_bounce(1, 3, 30.0, 0.0015)[0]
    smoother = Smoother(MODEL, SURFACES, DEFAULT)
    solution = smoother.settle(smoother.problem(track))
    (bounce,) = bounces_of(solution)
    assert (bounce.first, bounce.last) == (0, len(track) - 1)
    assert truth[bounce.interval, 5] < 0.0 < truth[bounce.interval + 1, 5]
    (side,) = other_sides(solution.minimum.values, [bounce], MODEL)
    assert side is not None
    assert side.holds(side.values)
    assert not side.holds(solution.minimum.values)

    def slip(values) -> np.ndarray:
        state = torch.from_numpy(values.states[bounce.interval])
        return slip_velocity(state[3:6], state[6:], MODEL.radius).numpy()

    before, after = slip(solution.minimum.values), slip(side.values)
    assert abs(before[0] * after[1] - before[1] * after[0]) < 1e-9
    moved = side.values.states - solution.minimum.values.states
    assert np.abs(moved[:, :6]).max() == 0.0
    assert np.ptp(moved[: bounce.interval + 1, 6:], axis=0).max() < 1e-9
    assert np.abs(moved[:, 8]).max() < 1e-9


def test_a_bounce_is_one_up_to_the_last_interval() -> None:
    """Of n states the last interval is n - 2; a contact beyond it has no state behind it."""
    smoother = Smoother(MODEL, SURFACES, DEFAULT)
    solution = smoother.settle(smoother.problem(one_bounce(1, 3, 30.0, 0.0015)[0][1]))
    last = len(solution.minimum.values.states) - 2
    for interval, expected in ((last - 1, [last - 1]), (last, [last]), (last + 1, [])):
        contacts = (Contact(interval, 0.0, 0.0),)
        moved = replace(solution, events=replace(solution.events, contacts=contacts))
        assert [bounce.interval for bounce in bounces_of(moved)] == expected


@pytest.mark.parametrize(("share", "slides"), [(0.3, True), (0.55, True), (0.7, True), (1.4, False), (3.0, False)])
def test_the_other_side_of_a_slip_at_which_the_ball_grips_is_one_at_which_it_slides(share: float, slides: bool) -> None:
    """A ball that falls at 2 m/s, with a share of the slip at which friction just fails to stop it."""
    state = np.array([0.0, 0.0, 0.02, 3.0, 0.0, -2.0, 0.0, 0.0, 0.0])

    def with_slip(slip: float) -> np.ndarray:
        spun = state.copy()
        spun[7] = (3.0 - slip) / MODEL.radius
        return spun

    slips = np.linspace(0.1, 6.0, 600)
    after = MODEL.after_bounce(torch.from_numpy(np.stack([with_slip(slip) for slip in slips]))).detach().numpy()
    kicks = 3.0 - after[:, 3]
    gripping = float(slips[np.argmax(kicks > 0.99 * kicks.max())])  # from here on more slip gives no more friction
    values = Values(np.stack([with_slip(share * gripping)] * 4), np.zeros(0))
    (side,) = other_sides(values, [Bounce(1, 0, 3)], MODEL)
    assert side is not None
    assert side.slides is slides
    speed = np.linalg.norm(slip_velocity(*torch.from_numpy(side.values.states[1]).split(3)[1:], MODEL.radius).numpy())
    assert speed > gripping if slides else speed == pytest.approx(0.0, abs=1e-9)
