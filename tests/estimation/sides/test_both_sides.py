"""The first state after a bounce, by every estimator: 40 balls; `both_sides.py` has the whole measurement."""

from __future__ import annotations

from functools import cache

import numpy as np
import pytest

import ballfg as bf
from ballfg.estimation.online.online import Online
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.prediction.belief import Belief
from ballfg.state import VZ
from tests.estimation import both_sides
from tests.estimation.both_sides import ESTIMATORS, MODEL, SURFACES, Bounced, bounced, settings_of

COUNT, SEED = 40, 11
NOISE, RATE = 0.002, 200.0
made = cache(lambda: bounced(COUNT, SEED, NOISE, RATE))


@pytest.mark.parametrize("name", [pytest.param("push", marks=pytest.mark.thorough), "live", "EKF", "track end"])
def test_the_first_state_after_a_bounce_is_honest(name: str) -> None:
    """Without a look at the other side one in four is off by more than 30, and the mean NEES is above 2,000.

    That of 40 balls has a standard deviation of 0.7 about 9, and the share in a 90 % interval one of 5 %.
    """
    held = both_sides.held(name, made(), NOISE)
    assert held.wrong <= 1 / COUNT
    assert 6.5 < held.nees.mean() < 11.5
    assert held.inside.min() > 0.78
    assert np.median(held.sharpness) < 0.5


def test_sides_are_followed_until_they_are_clear_at_a_high_rate() -> None:
    """At 1000 Hz a surface known to 4 mm shows it late: after eight samples alone three balls are 150 sigma off."""
    for ball in bounced(8, SEED, NOISE, 1000.0):
        online = Online(MODEL, SURFACES, settings_of(NOISE))
        told = [online.push(t, p) for t, p in zip(ball.track.times.tolist(), ball.track.positions, strict=True)]
        near = range(ball.first - both_sides.BEFORE, len(told))
        off = [np.abs(told[k].state - ball.truth[k])[: VZ + 1] / told[k].sigmas[: VZ + 1] for k in near]
        assert np.max(off) < 8.0


@pytest.fixture(scope="module")
def doubtful() -> Bounced:
    """A ball of which the smoother does not know the side at the end of a track."""
    smoother = Smoother(MODEL, SURFACES, settings_of(NOISE))
    return max(made(), key=lambda ball: smoother.estimate(ball.until(ball.first)).other_sides[-1, VZ, VZ])


def test_a_prediction_starts_from_the_more_probable_side(doubtful: Bounced) -> None:
    """`other_side` is in the state's covariance, and is not in what a prediction carries on."""
    for name in ESTIMATORS:
        state = ESTIMATORS[name](settings_of(NOISE))(doubtful, doubtful.first)
        assert state.other_side is not None
        assert state.other_side[VZ, VZ] > 1.0
        assert np.linalg.eigvalsh(state.other_side / np.outer(state.sigmas[:9], state.sigmas[:9])).min() > -1e-9
        np.linalg.cholesky(state.joint)
        carried = Belief.of(MODEL, [state]).covariance[0]
        np.linalg.cholesky(carried)
        assert carried[VZ, VZ] < 0.05
        ahead = state.predict(0.06)
        later = doubtful.truth[doubtful.first + 12 - 1]
        assert abs(ahead.states[-1, 2] - later[2]) < 4.0 * ahead.sigmas[-1, 2] + 0.01


def test_a_copy_of_a_stream_beside_a_contact_goes_on_alike(doubtful: Bounced) -> None:
    """What either takes in is its own, and what is told of the two sides is copied with the rest."""
    online, track = Online(MODEL, SURFACES, settings_of(NOISE)), doubtful.track
    samples = list(zip(track.times.tolist(), track.positions, strict=True))
    for t, p in samples[: doubtful.first + 1]:
        online.push(t, p)
    other = online.copy()
    for t, p in samples[doubtful.first + 1 :]:
        first, second = online.push(t, p), other.push(t, p)
        np.testing.assert_array_equal(first.mean, second.mean)
        np.testing.assert_array_equal(first.joint, second.joint)


def test_states_far_from_the_contact_are_those_of_the_window(
    doubtful: Bounced, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Bit for bit: what is told beside a contact never goes back into an estimator."""

    def pushed() -> list[bf.BallState]:
        online = Online(MODEL, SURFACES, settings_of(NOISE))
        return [online.push(t, p) for t, p in zip(doubtful.track.times, doubtful.track.positions, strict=True)]

    told = pushed()
    monkeypatch.setattr("ballfg.estimation.sides.monitor.ContactMonitor.step", lambda *given: None)
    alone = pushed()
    same = [
        np.array_equal(a.mean, b.mean) and np.array_equal(a.joint, b.joint) for a, b in zip(told, alone, strict=True)
    ]
    differing = np.flatnonzero(~np.array(same))
    assert doubtful.first in differing
    assert len(differing) <= 4
    assert np.abs(differing - doubtful.first).max() <= 3
