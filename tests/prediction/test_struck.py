"""Predictions after a last sample that contradicts its flight: an outlier, or a hit that nothing tells yet."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

import ballfg as bf
from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation import Online, Settings
from ballfg.prediction import Belief, Propagator
from tests.estimation.smoother.serve import SERVE, truth

RATE, NOISE, SEEN = 150.0, 0.002, 38
TIMES = np.arange(90) / RATE
FLIGHT = truth([0.0, 0.0, 1.6, 5.0, 0.2, 1.5, *SERVE[6:]], TIMES)
SETTINGS = Settings.for_measured(nominal_model(), position_noise=(NOISE,) * 3)


def seen(off: float, seed: int = 0) -> bf.Track:
    """The first quarter of a second of a flight, with the last sample off by so many m."""
    measured = FLIGHT[:SEEN, :3] + NOISE * np.random.default_rng(seed).normal(size=(SEEN, 3))
    measured[-1] += off * np.array([0.6, 0.64, 0.48])
    return bf.Track(TIMES[:SEEN], measured)


def estimated(off: float, seed: int = 0) -> bf.Estimate:
    return bf.estimate(seen(off, seed), settings=SETTINGS, surfaces=0.0)


@pytest.mark.parametrize("off", [0.03, 0.1])
def test_the_path_is_that_of_a_ball_that_flies_on_and_the_covariance_holds_a_struck_one(off: float) -> None:
    good, doubtful = estimated(0.0), estimated(off)
    assert good.last.struck is None
    assert doubtful.last.struck is not None
    ahead = doubtful.predict(0.3)
    reached = np.array([np.interp(ahead.times, TIMES, FLIGHT[:, axis]) for axis in range(3)]).T
    assert np.abs(ahead.positions - reached).max() < 0.03
    spread = np.sqrt(np.diagonal(doubtful.last.struck)[3:6])
    assert ahead.sigmas[-1] == pytest.approx(0.3 * spread, rel=0.02)
    assert np.linalg.eigvalsh(ahead.covariances).min() >= 0.0


def test_it_holds_online_and_in_the_middle_of_a_track_that_goes_on() -> None:
    track = seen(0.03)
    online = Online(nominal_model(), Surfaces(0.0), SETTINGS)
    for time, position in zip(track.times, track.positions, strict=True):
        state = online.push(time, position)
    assert state.struck is not None
    ahead = state.predict(0.3)
    assert np.abs(ahead.positions[-1] - FLIGHT[SEEN - 1 + 45, :3]).max() < 0.05
    assert ahead.sigmas[-1].min() > 0.1
    more = np.concatenate((track.positions, FLIGHT[SEEN:60, :3]))
    assert bf.estimate((TIMES[:60], more), settings=SETTINGS, surfaces=0.0).struck == {}


def test_the_share_is_taken_out_and_put_back_over_no_time_with_any_coefficients() -> None:
    estimate = estimated(0.03)
    state = estimate.last
    names = ("bounce.friction.mu", *reversed(state.coefficient_names))
    known = Belief.of(estimate.world.model, [state, estimate[0]], dict.fromkeys(names, 0.01))
    assert known.struck.shape == known.covariance.shape
    assert not known.struck[1].any()
    still = Propagator(estimate.world.surfaces, estimate.world.process).rollout(known, known.time[:, None])
    assert still.covariances[:, 0] == pytest.approx(known.covariance[:, :9, :9], abs=1e-9)


def test_a_state_without_doubt_is_predicted_as_before() -> None:
    state = estimated(0.0).last
    none = replace(state, struck=np.zeros_like(state.joint)).predict(0.3)
    assert none.covariances == pytest.approx(state.predict(0.3).covariances, rel=1e-9, abs=1e-15)
