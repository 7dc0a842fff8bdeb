"""Forecasts of linearised tracks against a dense Gaussian, the estimators' own predictions, and differences."""

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation import Smoother, predict_tracks
from ballfg.estimation.noise.estimate import _Search
from ballfg.estimation.noise.forecasts import HORIZONS, Forecaster
from ballfg.estimation.noise.linear_tracks import linearise
from ballfg.estimation.noise.parameters import by_logs, noise_of, parameters_of
from ballfg.factors.noise import PROCESS_NOISE
from ballfg.simulation import MeasurementNoise
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks.stamps import STAMP_TOLERANCE
from tests.estimation.noise import in_torch


@pytest.fixture(scope="module")
def case(recorded):
    model, surfaces, settings, tracks = recorded(MeasurementNoise(position=0.003, memory=0.002), tracks=3)
    tracks = [track.until(float(track.times[0]) + 0.7) for track in tracks]
    linear = linearise(Smoother(model, surfaces, settings), tracks)
    return model, surfaces, settings, tracks, linear, Forecaster(linear, settings.velocity_prior)


def shifted_noise(settings, linear, shift=0.0):
    parameters = parameters_of(settings, linear, position_known=False)
    return noise_of(parameters, np.array([[np.log(p.start) + shift for p in parameters]]), settings)


def test_noise_without_parameters_is_the_settings(case):
    """And a first spread of coefficients that is once theirs."""
    *_, settings, _, _, _ = case
    noise = noise_of([], np.zeros((1, 0)), settings)
    assert noise.coefficients.item() == 1.0
    assert noise.position.tolist() == [[1.0, 1.0, 1.0]]
    assert noise.spin_label.item() == settings.spin_label_noise
    assert noise.spin_prior.item() == settings.spin_prior
    assert noise.process[0].tolist() == [getattr(settings.process, name) for name in PROCESS_NOISE]


def test_forecasts_start_a_fifth_of_a_second_after_the_first_sample(case):
    *_, linear, forecaster = case
    starts = linear.times[forecaster.starts[:, 0], forecaster.starts[:, 1]]
    assert 0.2 - STAMP_TOLERANCE <= starts.min() < 0.2 + 0.02


def dense(linear, forecaster, noise, track):
    """Mean (3 n,) and covariance of all measured positions of a track, as deviations, from the joint Gaussian."""
    n, own, width = linear.times.shape[1], forecaster.filter.own, forecaster.filter.width
    given = forecaster.filter, in_torch.leaves(noise)
    transitions, gathered, prior = (
        x[track].detach().numpy() for x in (*in_torch.motion(*given), in_torch.prior(*given))
    )
    mean, cov = np.zeros(n * width), np.zeros((n * width, n * width))
    mean[:own] = linear.starts[track]
    cov[:width, :width] = np.diag(np.concatenate((prior, noise.memory[0])))
    for k in range(1, n):
        now, last = slice(k * width, (k + 1) * width), slice((k - 1) * width, k * width)
        step = transitions[k - 1]
        mean[now] = step @ mean[last]
        mean[k * width : k * width + own] += linear.offsets[track, k - 1]
        cov[now, : k * width] = step @ cov[last, : k * width]
        cov[: k * width, now] = cov[now, : k * width].T
        cov[now, now] = step @ cov[last, last] @ step.T + gathered[k - 1]
    observe = np.kron(np.eye(n), in_torch.measure(forecaster.filter).numpy())
    spread = observe @ cov @ observe.T
    for k in range(n):
        spread[3 * k : 3 * k + 3, 3 * k : 3 * k + 3] += forecaster.filter.measured(noise)[track, k]
    return observe @ mean, spread


def test_score_is_that_of_the_joint_gaussian(case):
    *_, settings, _, linear, forecaster = case
    noise = shifted_noise(settings, linear)
    total, count = 0.0, 0
    horizons = np.array(HORIZONS)
    for track in range(len(linear)):
        mean, cov = dense(linear, forecaster, noise, track)
        times, used, errors = (x[track] for x in (linear.times, linear.used, linear.errors))
        for start in forecaster.starts[forecaster.starts[:, 0] == track, 1].tolist():
            seen = np.flatnonzero(np.repeat(used[: start + 1], 3))
            ahead = {
                int(np.flatnonzero(used & (times >= times[start] + h - STAMP_TOLERANCE))[0])
                for h in horizons
                if (used & (times >= times[start] + h - STAMP_TOLERANCE)).any()
            } - {start}
            gain = np.linalg.solve(cov[np.ix_(seen, seen)], cov[seen]).T
            known = mean + gain @ (errors.reshape(-1)[seen] - mean[seen])
            left = np.diag(cov - gain @ cov[seen])
            for k in ahead:
                rows = slice(3 * k, 3 * k + 3)
                z = np.abs(errors[k] - known[rows]) / np.sqrt(left[rows])
                loss = np.where(z < 3.0, z**2 / 2, 3 * z - 4.5)
                total, count = total + float((loss + 0.5 * np.log(left[rows])).sum()), count + 1
    measured = forecaster.filter.measured(noise)
    filtered = forecaster.filter.run(noise, measured)
    own = forecaster._look(filtered, noise, measured).scores
    assert len(own) == count
    np.testing.assert_allclose(own.mean(), total / count, rtol=1e-6)


def test_gradient_is_that_of_differences(case):
    *_, settings, _, linear, forecaster = case
    parameters = parameters_of(settings, linear, position_known=False)
    logs = np.log([[p.start for p in parameters]])
    noise = noise_of(parameters, logs, settings)
    gradient = by_logs(parameters, noise, forecaster.score(noise).slopes).sum(axis=0)
    for k in range(len(parameters)):
        step = np.zeros(len(parameters))
        step[k] = 1e-5
        up, down = (forecaster.score(noise_of(parameters, logs + s * step, settings)).value for s in (1, -1))
        assert float(gradient[k]) == pytest.approx((up - down) / 2e-5, rel=1e-4, abs=1e-8)


def test_forecast_has_the_sigmas_of_a_prediction(case):
    """What the linear filter says 0.2 s ahead, the smoother of the seen part and the propagator say too."""
    model, surfaces, settings, tracks, linear, forecaster = case
    noise = shifted_noise(settings, linear)
    parameters = parameters_of(settings, linear, position_known=False)
    own = replace(
        settings,
        memory=tuple(np.sqrt(noise.memory[0]).tolist()),
        memory_time=float(noise.memory_time[0]),
        stamp_jitter=float(np.sqrt(noise.stamp_jitter[0])),
        find_events=False,
    )
    assert {p.name for p in parameters} >= {"position", "memory", "acceleration"}
    transitions, gathered = (x.detach().numpy() for x in in_torch.motion(forecaster.filter, in_torch.leaves(noise)))
    measured = forecaster.filter.measured(noise)
    observe = in_torch.measure(forecaster.filter).numpy()
    covariances = forecaster.filter.run(noise, measured).covariances
    for track in range(len(tracks)):
        start = int(np.searchsorted(linear.times[track], 0.25))
        end = int(np.searchsorted(linear.times[track], 0.35))
        covariance = covariances[track, start]
        for k in range(start, end):
            covariance = transitions[track, k] @ covariance @ transitions[track, k].T + gathered[track, k]
        spread = observe @ covariance @ observe.T + measured[track, end]
        seen = float(linear.times[track, start]) + 1e-6
        (prediction,) = predict_tracks(Smoother(model, surfaces, own), [tracks[track]], 1, seen)
        if prediction.estimate.contacts:
            continue  # the seen part moves its contact; the linear filter keeps that of the whole track
        np.testing.assert_allclose(np.sqrt(spread.diagonal()), prediction.sigmas[end - start - 1], rtol=0.06)


def test_linear_tracks_follow_the_smoother(case):
    *_, tracks, linear, _ = case
    assert len(linear) == len(tracks)
    assert linear.transitions.shape[-1] == STATE_DIM + len(linear.coefficient_sigmas)
    assert np.abs(linear.errors[linear.used]).max() < 0.02
    steps = np.diagonal(linear.transitions[:, :, POSITION, POSITION], axis1=-2, axis2=-1)
    assert np.abs(steps[..., :2] - 1.0).max() < 0.01  # a bounce turns z alone


def test_what_is_known_of_a_start_is_told_as_a_deviation_from_the_estimate(case):
    """The measured place, no velocity, the label or no spin, the usual coefficients: less what the smoother finds."""
    model, surfaces, settings, tracks, linear, _ = case
    smoother = Smoother(model, surfaces, replace(settings, memory=(0.0, 0.0, 0.0), stamp_jitter=0.0))
    usual = [float(dict(model.named_parameters())[name].detach()) for name in settings.coefficients]
    for own, track in zip(linear.starts, tracks, strict=True):
        estimate = smoother.estimate(track)
        assert 0 not in estimate.hits
        spin = np.zeros(3) if track.spin_label is None else track.spin_label
        known = np.concatenate((track.positions[0], np.zeros(3), spin, usual))
        assert estimate.coefficient_names == tuple(settings.coefficients)
        found = np.concatenate((estimate.states[0], estimate.coefficients))
        np.testing.assert_allclose(own, known - found, rtol=1e-3, atol=1e-4)


def test_curvature_and_scatter_behind_the_error_bars(case):
    """H and G of H^-1 (G + P) H^-1, by second differences of the objective itself and by the tracks one by one."""
    *_, settings, _, linear, forecaster = case
    known = parameters_of(settings, linear, position_known=True)
    search = _Search(
        forecaster, [p for p in known if p.name == "acceleration" or (p.name, p.axis) == ("memory", 2)], settings
    )
    logs, step = np.log([0.003, 0.1]), 0.05
    moves = step * np.eye(2)
    hessian = np.empty((2, 2))
    for i, j in ((0, 0), (0, 1), (1, 1)):
        ends = ((a, b, search.value(logs + a * moves[i] + b * moves[j])[0]) for a in (-1, 1) for b in (-1, 1))
        hessian[i, j] = hessian[j, i] = sum(a * b * value for a, b, value in ends) / (4.0 * step**2)
    assert (np.linalg.eigvalsh(hessian) > 1.0 / search.spread.max() ** 2).all()
    profile, inverse = search.profile(logs), np.linalg.inv(hessian)
    assert search.names == ["memory.z", "acceleration"]
    np.testing.assert_allclose(profile._inverse(logs), inverse, rtol=0.02)
    moves = [[logs + s * 1e-5 * move for s in (1, -1)] for move in np.eye(len(logs))]
    by_track = [
        [forecaster.score(noise_of(search.parameters, end[None], settings)).by_track for end in ends] for ends in moves
    ]
    own = np.array([(up - down) / 2e-5 for up, down in by_track]).T
    scatter = np.cov(own.T) * len(own) * search.weight**2
    np.testing.assert_allclose(search._scatter(logs), scatter, rtol=1e-5)
