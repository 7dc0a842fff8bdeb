"""Memory and jitter by the marginal likelihood: planted ones come back with their size; white noise has no name."""

from dataclasses import replace

import numpy as np
import pytest

import ballfg as bf
from ballfg.benchmarks.diagnosis.changes import CHANGES
from ballfg.dynamics import nominal_model
from ballfg.estimation import dataset_settings, dataset_surfaces
from ballfg.estimation.noise import tracker_errors
from ballfg.estimation.noise.estimate import linearised
from ballfg.estimation.noise.linear_filter import LinearFilter
from ballfg.estimation.noise.marginal import MarginalFit
from ballfg.estimation.noise.parameters import noise_of, parameters_of
from ballfg.estimation.noise.tracker_errors import JITTER, MEMORY, tracker_noise
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise
from tests.places import DATA

WHITE, LASTING, TIME, JITTERED = 0.003, 0.003, 0.012, 0.001


@pytest.fixture(scope="module")
def shots(recorded):
    """shots(noise): settings with all errors as white noise, and linearised parts of 24 tracks."""

    def make(noise, seed):
        model, surfaces, settings, tracks = recorded(noise, tracks=24, seed=seed)
        total = np.sqrt(noise.position**2 + noise.memory**2 + (3.0 * noise.jitter) ** 2) / noise.position
        exact = ProcessNoise(acceleration=0.01, contact_velocity=0.004, contact_tangential=0.015, contact_spin=3.0)
        spread = {name: 0.1 * sigma for name, sigma in settings.coefficients.items()}
        settings = replace(settings, position_scale=total, process=exact, coefficients=spread)
        parts = [track.until(float(track.times[0]) + 0.8) for track in tracks]
        return settings, linearised(model, surfaces, settings, parts)

    return make


@pytest.fixture(scope="module")
def lasting(shots):
    return shots(MeasurementNoise(position=WHITE, memory=LASTING, memory_time=TIME), 7)


def every_second(linear):
    return linear.numbers % 2 == 1


def test_memory_has_a_name_and_its_size(lasting):
    settings, linear = lasting
    (part,) = tracker_noise(linear, every_second(linear), settings, WHITE).parts
    assert part.evidence.name == MEMORY
    assert part.evidence.p_value < 1e-4
    for name, planted in (("sigma", LASTING), ("time", TIME)):
        value, sigma = part.values[name]
        assert value == pytest.approx(planted, rel=0.15)
        assert abs(value - planted) < 4.0 * sigma
    assert part.gains.sum() > 20.0


def test_a_white_noise_that_tracks_contradict_is_not_believed(lasting):
    """The dataset states the whole error of a position: the white part is found beside the memory all the same."""
    settings, linear = lasting
    found = tracker_noise(linear, every_second(linear), settings, np.sqrt(WHITE**2 + LASTING**2))
    np.testing.assert_allclose(found.noise.position, WHITE, rtol=0.2)
    np.testing.assert_allclose(found.noise.memory, LASTING, rtol=0.3)


def test_a_part_of_hardly_known_size_has_no_name(lasting, monkeypatch):
    monkeypatch.setattr(tracker_errors, "KNOWN", 100.0)  # sizes of fewer standard deviations do not count
    settings, linear = lasting
    found = tracker_noise(linear, every_second(linear), settings, WHITE)
    assert found.parts == ()
    assert found.noise.memory is None
    assert max(found.noise.position) < 1.5 * np.hypot(WHITE, LASTING)


def test_jitter_has_a_name_and_its_size(shots):
    settings, linear = shots(MeasurementNoise(position=WHITE, jitter=JITTERED), 8)
    found = tracker_noise(linear, every_second(linear), settings, WHITE)
    (part,) = found.parts
    assert part.evidence.name == JITTER
    assert part.values["sigma"][0] == pytest.approx(JITTERED, rel=0.15)
    assert found.noise.stamp_jitter == part.values["sigma"][0]
    assert found.noise.memory is None


def test_white_noise_has_no_name(shots):
    settings, linear = shots(MeasurementNoise(position=WHITE), 9)
    found = tracker_noise(linear, every_second(linear), settings, WHITE)
    assert found.parts == ()
    np.testing.assert_allclose(found.noise.position, WHITE, rtol=0.1)


def test_what_is_declared_is_not_looked_for(lasting):
    settings, linear = lasting
    declared = replace(settings, position_scale=1.0, memory=(LASTING,) * 3, memory_time=TIME)
    assert tracker_noise(linear, every_second(linear), declared, WHITE).parts == ()


def test_few_tracks_tell_nothing(lasting):
    settings, linear = lasting
    usual = replace(settings, position_noise=(0.001, 0.002, 0.004), position_scale=1.5)
    found = tracker_noise(linear, linear.numbers < 4, usual, WHITE)
    assert found.parts == ()
    assert found.noise.position == pytest.approx((0.0015, 0.003, 0.006))


def test_a_filter_without_biases_is_one_without_memory(lasting):
    settings, linear = lasting
    full, lean = (LinearFilter(linear, settings.velocity_prior, biased=b) for b in (True, False))
    noise = noise_of([], np.zeros((1, 0)), settings)
    np.testing.assert_allclose(full.losses(noise)[0], lean.losses(noise)[0], rtol=1e-9)


def test_the_fit_is_a_minimum_and_its_error_bars_are_of_the_curvature(lasting):
    settings, linear = lasting
    numbers = [p for p in parameters_of(settings, linear, False, True) if p.name in ("position", "acceleration")]
    fit = MarginalFit(LinearFilter(linear, settings.velocity_prior, biased=False), settings, numbers)
    for k in range(3):  # the white noise is well known: two per cent to either side are worse
        for step in (-0.02, 0.02):
            moved = fit.logs.copy()
            moved[k] += step
            assert fit.at(moved)[0].sum() > fit.losses.sum()
    sigmas = np.sqrt(np.diagonal(fit.covariance()))
    assert np.all((sigmas[:3] * np.sqrt(2.0 * int(linear.used.sum())) > 0.2) & (sigmas[:3] < 0.05))


@pytest.mark.skipif(not (DATA / "robot_rallies").is_dir(), reason="the measured tracks are not there")
def test_a_track_about_whose_estimate_the_motion_is_not_linear_is_left_out():
    """Stamps that err by 2.5 ms: in the second track a contact near a sample never comes about the estimate."""
    dataset = bf.read(DATA / "robot_rallies")
    tracks = CHANGES[JITTER](dataset, list(dataset), np.random.default_rng(0)).tracks[:8]
    model = nominal_model(dataset.ball.radius)
    settings, surfaces = dataset_settings(dataset, model), dataset_surfaces(dataset)
    linear = linearised(model, surfaces, replace(settings, stamp_jitter=0.0), [track.opening(1.0) for track in tracks])
    assert 5 <= len(linear) < len(tracks)
    assert np.isfinite(linear.transitions).all()
    lean = LinearFilter(linear, settings.velocity_prior, biased=False)
    assert np.isfinite(lean.losses(noise_of([], np.zeros((1, 0)), settings))[0]).all()
