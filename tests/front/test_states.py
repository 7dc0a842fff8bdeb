"""States of all estimators are of one type, which is predicted in one way."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import ballfg as bf
from ballfg.estimation import ConformalScales, dataset_settings
from ballfg.factors.loss import Loss
from ballfg.prediction import Belief, Propagator, apex, next_contact, plane_crossing
from tests.front.my_shots import written


def gaussian(shots: bf.Dataset) -> bf.Settings:
    """Squared losses and no events: what filter and smoother are told is then the same."""
    usual = dataset_settings(shots, bf.nominal_model())
    plain = Loss("squared")
    return replace(usual, loss=plain, spin_loss=plain, label_loss=plain, find_events=False)


def test_conformal_intervals_of_a_dataset(shots: bf.Dataset, track: bf.Track, tmp_path: Path) -> None:
    """From calibration tracks, from the scales that a prediction has, and from their file."""
    calibration = written(tmp_path / "calibration", tracks=12)
    options = {"observe": 0.35, "method": "ekf"}
    plain = bf.predict(shots, 0.2, **options)
    found = bf.predict(shots, 0.2, **options, conformal=calibration)
    scales = found["000"].conformal
    assert isinstance(scales, ConformalScales)
    assert scales.tracks.tolist() == [12] * 4
    assert 0.5 < scales.own_coverage <= 1.0
    assert 0.85 < scales.coverage <= 1.0
    factors = found["000"].sigmas / plain["000"].sigmas
    np.testing.assert_allclose(factors[[0, -1]], scales.scales[[0, -1]])
    np.testing.assert_array_equal(found["000"].positions, plain["000"].positions)
    scales.save(tmp_path / "scales.yaml")
    for again in (scales, tmp_path / "scales.yaml", bf.read(calibration)):
        same_sigmas = bf.predict(shots, 0.2, **options, conformal=again)["000"].sigmas
        np.testing.assert_array_equal(same_sigmas, found["000"].sigmas)
    with pytest.raises(ValueError, match="conformal must hold other tracks than those that are predicted"):
        bf.predict(shots, 0.2, conformal=shots)
    with pytest.raises(ValueError, match=r"with 0.25 s observed, by ekf; the scales from .* have 0.35 s by ekf"):
        bf.predict(shots, 0.2, method="ekf", conformal=scales)
    with pytest.raises(TypeError, match="conformal must be a dataset of calibration tracks"):
        bf.predict(shots, 0.2, conformal=track)
    for single in (track, bf.estimate(track)):
        with pytest.raises(ValueError, match="conformal must be None for a single ball; got ConformalScales"):
            bf.predict(single, 0.2, conformal=scales)


def test_states_of_all_estimators_predict_the_same(shots: bf.Dataset) -> None:
    """0.1 of a standard deviation, and 3 % of it: a filter does not go back to where it linearised."""
    model, surfaces, settings = bf.nominal_model(), bf.Surfaces.table_tennis(shots.table), gaussian(shots)
    track = shots["000"].until(0.35)
    live = bf.Online(model, surfaces, settings)
    label = bf.Track(track.times, track.positions, name="unlabelled")
    pushed = [live.push(float(t), p) for t, p in zip(label.times, label.positions, strict=True)][-1]
    sorts = (bf.Smoother, bf.Online, bf.ExtendedKalmanFilter)
    states = [sort(model, surfaces, settings).estimate(label).last for sort in sorts]
    smoother, *others = [state.predict(0.3) for state in [*states, pushed]]
    assert isinstance(pushed, bf.BallState)
    assert len({state.coefficient_names for state in [*states, pushed]}) == 1
    for ahead in others:
        np.testing.assert_allclose(ahead.times, smoother.times, atol=1e-12)
        assert (np.abs(ahead.positions - smoother.positions) / smoother.sigmas).max() < 0.1
        np.testing.assert_allclose(ahead.sigmas, smoother.sigmas, rtol=0.03)


def test_what_is_uncertain_of_the_coefficients_reaches_the_prediction(estimate: bf.Estimate) -> None:
    state = estimate.last
    assert "flight.drag.k" in state.coefficient_names
    exact = bf.BallState(state.time, state.state, state.covariance, (), state.world)
    assert (state.predict(0.5).sigmas[-1] > 1.05 * exact.predict(0.5).sigmas[-1]).any()


def test_live_balls_are_predicted(shots: bf.Dataset, track: bf.Track) -> None:
    live = bf.Online(shots.ball, shots.table)
    for time, position in zip(track.times, track.positions, strict=True):
        state = live.push(time, position)
    ahead = state.predict(0.3)
    measured = shots["000"].between(float(track.times[-1]), float(track.times[-1]) + 0.3)
    (row,) = np.flatnonzero(np.isclose(measured.times, ahead.times[9]))
    assert np.linalg.norm(ahead.positions[9] - measured.positions[row]) < 0.05


def test_a_state_without_a_model_says_so(estimate: bf.Estimate) -> None:
    homeless = replace(estimate.last, world=None)
    with pytest.raises(ValueError, match=r"a state must know its model to be predicted.*state.on"):
        homeless.predict(0.1)
    assert estimate.world is not None
    np.testing.assert_array_equal(homeless.on(estimate.world).predict(0.1).positions, estimate.predict(0.1).positions)


def test_events_ahead_are_those_of_the_room_prediction(shots: bf.Dataset) -> None:
    estimate = bf.estimate(shots["001"].until(0.15))
    ahead, world = estimate.predict(1.0), estimate.world
    assert world is not None
    propagator, belief = Propagator(world.surfaces, world.process), Belief.of(world.model, [estimate.last])
    across = float(ahead.positions[20, 0])
    pairs = (
        (ahead.next_contact, next_contact(propagator, belief, 1.0)),
        (ahead.apex, apex(propagator, belief, 1.0)),
        (ahead.crossing(x=across), plane_crossing(propagator, belief, [1.0, 0.0, 0.0], across, 1.0)),
        (ahead.crossing(z=0.9), plane_crossing(propagator, belief, [0.0, 0.0, 1.0], 0.9, 1.0)),
    )
    for found, expected in pairs:
        assert found is not None
        assert expected is not None
        assert (found.time, found.time_sigma) == (expected.time, expected.time_sigma)
        np.testing.assert_array_equal(found.state, expected.state)
        np.testing.assert_array_equal(found.covariance, expected.covariance)
    assert ahead.crossing(x=100.0) is None
    for planes in ({}, {"x": 1.0, "y": 0.0}):
        with pytest.raises(ValueError, match="crossing takes exactly one of x, y, z"):
            ahead.crossing(**planes)


@pytest.mark.parametrize(("horizon", "step"), [(0.0, 0.01), (-1.0, 0.01), (float("nan"), 0.01), (0.3, 0.0)])
def test_horizons_are_checked(estimate: bf.Estimate, folder: Path, horizon: float, step: float) -> None:
    if step > 0.0:
        with pytest.raises(ValueError, match="horizon must be a positive number of seconds"):
            bf.predict(folder, horizon)
    with pytest.raises(ValueError, match=r"(horizon|step) must be finite and above 0"):
        estimate.predict(horizon, step)


def test_states_are_equal_to_themselves_alone(estimate: bf.Estimate) -> None:
    first, second = estimate[0], estimate[0]
    assert first == first
    assert first != second
    assert first not in [second, estimate[1]]
    assert len({first, second, estimate}) == 3
    with pytest.raises(TypeError, match="slice"):
        estimate[1:3]  # type: ignore[index]
