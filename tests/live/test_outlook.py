"""What lies ahead: the events of the prediction, or a sentence on why there are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from ballfg.estimation import Online, Status
from ballfg.estimation.online.state import OnlineState
from ballfg.live.outlook import look_out
from ballfg.prediction.plane import Plane
from ballfg.state import VZ
from tests.live.shots import SURFACES, ball_model, ball_settings, shots


@pytest.fixture(scope="module")
def state() -> OnlineState:
    track, online = shots(1)[0], Online(ball_model(), SURFACES, ball_settings())
    return [online.push(t, p) for t, p in zip(track.times[:20], track.positions[:20], strict=True)][-1]


def test_events_are_those_of_the_prediction(state: OnlineState) -> None:
    ahead, seen = state.predict(0.5), look_out(state, 0.5, Plane.parse("x=1.5"))
    assert seen.note == ""
    for mine, theirs in ((seen.bounce, ahead.next_contact), (seen.crossing, ahead.crossing(x=1.5))):
        assert mine is not None
        assert theirs is not None
        assert mine.time == pytest.approx(theirs.time, abs=1e-9)
        np.testing.assert_allclose(mine.state, theirs.state, atol=1e-9)
    assert (seen.apex is None) == (ahead.apex is None)
    assert look_out(state, 0.01, Plane.parse("x=50")).crossing is None


@pytest.mark.parametrize("plane", [None, Plane.parse("x=1.5")])
def test_an_apex_that_may_just_have_been_is_that_of_the_prediction(state: OnlineState, plane: Plane | None) -> None:
    mean, joint = state.mean.copy(), state.joint.copy()
    mean[VZ], joint[VZ, VZ] = 0.1, 0.04
    doubtful = replace(state, mean=mean, joint=joint)
    ahead, seen = doubtful.predict(0.8).apex, look_out(doubtful, 0.8, plane).apex
    assert ahead is not None
    assert seen is not None
    assert seen.time_sigma == ahead.time_sigma > 0.05
    np.testing.assert_array_equal(seen.covariance, ahead.covariance)


@pytest.mark.parametrize("plane", ["x=1.5", "z=0.9,down", "z=0.9,up,after=1", "x=50"])
def test_probabilities_are_those_of_the_prediction(state: OnlineState, plane: str) -> None:
    seen = look_out(state, 0.5, Plane.parse(plane))
    expected = {"bounce": "next-contact", "apex": "apex", "crossing": plane}
    for step in (0.005, 0.01, 0.02):  # as the command predict has it, as predict, as a step of the motion
        ahead = state.predict(0.5, step)
        assert seen.probability == {what: ahead.event(event).probability for what, event in expected.items()}
    assert look_out(state, 0.5, None).probability is None


def test_what_cannot_be_predicted_says_why(state: OnlineState) -> None:
    assert "too few samples" in look_out(replace(state, status=Status.NO_VELOCITY), 0.5, None).note
    vague = replace(state, joint=state.joint * 1e6)
    assert "the velocity is not known to 3 m/s" in look_out(vague, 0.5, None).note
    lost = replace(state, mean=np.full_like(state.mean, np.nan))
    assert "not finite" in look_out(lost, 0.5, None).note
    nowhere = look_out(replace(state, world=None), 0.5, None)
    assert nowhere.note.startswith("no prediction: ValueError: a state must know its model")
    assert nowhere.bounce is nowhere.apex is nowhere.crossing is None


def test_a_sample_off_the_flight_is_named_as_the_reason() -> None:
    """The velocity was known before it; after an outlier the predictions are back with the next samples."""
    live, times, notes = Online(nominal_model(), 0.0), np.arange(30) / 100, list[str]()
    path = np.array([0.0, 0.0, 0.3]) + np.outer(times, [3.0, 0.0, 2.0]) - np.outer(times**2, [0.0, 0.0, 4.905])
    path += np.random.default_rng(0).normal(0.0, 0.0015, path.shape)
    path[20] += (0.04, 0.0, 0.05)
    for time, position in zip(times.tolist(), path, strict=True):
        notes.append(look_out(live.push(time, position), 0.5, None).note)
    assert "is an outlier or follows a hit" in notes[20]
    assert not any(notes[5:20])
    assert not any(notes[23:])
