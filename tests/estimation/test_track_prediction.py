"""Tracks: what is observed, what is predicted, and whether the intervals hold what is measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.dynamics.motion.rollout import advance
from ballfg.estimation import Settings, Status, dataset_settings, dataset_surfaces, predict_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import Belief
from ballfg.state import SPIN, VZ
from ballfg.tracks import Track, read_dataset
from tests.places import DATA

TABLE = Surfaces(0.0)
NOISE = ProcessNoise(acceleration=0.1, spin=1.0, contact_velocity=0.02, contact_spin=5.0)
SETTINGS = Settings(position_noise=(0.002, 0.002, 0.003), process=NOISE, spin_label_noise=5.0)
METHODS = ("smoother", "online", "ekf", "sliding-window")


def simulated(count: int, samples: int = 50, dt: float = 0.01) -> list[Track]:
    """Tracks that bounce at 0.3 to 0.5 s, with the noise that `SETTINGS` declares."""
    rng = np.random.default_rng(11)
    state = np.array([0, 0, 0.3, 4, 0.2, 1.0, 0, 40, 5]) + rng.normal(
        0, [0, 0, 0.03, 1, 0.3, 0.15, 20, 20, 20], (count, 9)
    )
    labels = state[:, SPIN] + rng.normal(0, 5.0, (count, 3))
    spread = np.linalg.cholesky(NOISE.flight(np.array([dt]))[0])
    model, step = nominal_model(), torch.full((count,), dt, dtype=torch.float64)
    measured = []
    for _ in range(samples):
        measured.append(state[:, :3] + rng.normal(0, SETTINGS.position_noise, (count, 3)))
        with torch.no_grad():
            later = advance(model, torch.from_numpy(state), step, TABLE).numpy()
        kick = rng.normal(0, [0.02] * 3 + [5.0] * 3, (count, 6))
        bounced = later[:, VZ] > state[:, VZ] + 1.0
        state = later + rng.normal(size=(count, 9)) @ spread.T
        state[bounced, 3:] += kick[bounced]
    times = np.arange(samples) * dt
    return [
        Track(times, positions, labels=dict(zip(("spin_x", "spin_y", "spin_z"), label, strict=True)), name=f"{i}")
        for i, (positions, label) in enumerate(zip(np.stack(measured, axis=1), labels, strict=True))
    ]


@pytest.fixture(scope="module")
def tracks() -> list[Track]:
    return simulated(120)


def estimator(method: str = "ekf", settings: Settings = SETTINGS):
    return make_estimator(method, nominal_model(), TABLE, settings)


# --- bookkeeping -------------------------------------------------------------------------------------------------


def test_the_stamp_at_the_limit_is_observed(tracks):
    shifted = replace(tracks[0], times=tracks[0].times + 1.7e9)  # s since 1970: stamps are rounded to 2e-7 s
    for track in (tracks[0], shifted):
        (result,) = predict_tracks(estimator(), [track], 1, 0.25)
        assert len(result.estimate.times) == 26
        np.testing.assert_array_equal(result.times, track.times[26:])
        np.testing.assert_array_equal(result.measured, track.positions[26:])
        assert result.positions.shape == result.sigmas.shape == (24, 3)
        assert result.status is Status.OK
        (short,) = predict_tracks(estimator(), [track], 1, 0.25, horizon=0.1)
        np.testing.assert_array_equal(short.times, track.times[26:36])
        np.testing.assert_allclose(short.positions, result.positions[:10], atol=1e-9)


def test_tracks_of_all_lengths_and_rates_together(tracks):
    """Blocks hold tracks of other lengths and stamps: each comes out as if it were alone, in order."""
    keep = [np.arange(50), np.arange(20), np.arange(26), np.arange(27), np.r_[0:26, 40:50], np.r_[0:30, 33, 49]]
    mixed = [
        Track(t.times[k], t.positions[k], labels=t.labels, name=f"m{i}")
        for i, (t, k) in enumerate(zip(tracks, keep))  # noqa: B905
    ]
    together = list(predict_tracks(estimator(), iter(mixed), len(mixed), 0.25))
    assert [r.name for r in together] == [f"m{i}" for i in range(len(keep))]
    assert [len(r.times) for r in together] == [24, 0, 0, 1, 10, 6]
    for track, result in zip(mixed, together, strict=True):
        (alone,) = predict_tracks(estimator(), [track], 1, 0.25)
        np.testing.assert_allclose(result.positions, alone.positions, atol=1e-6)
        np.testing.assert_allclose(result.sigmas, alone.sigmas, rtol=0.01)


def test_sigmas_are_those_of_a_measurement(tracks):
    """A track's own sigmas are added where it brings them, the settings' elsewhere."""
    own = replace(tracks[0], sigmas=np.where(np.arange(50)[:, None] < 30, 0.002, 0.05) * np.ones(3))
    (plain,), (wide,) = (list(predict_tracks(estimator(), [t], 1, 0.25)) for t in (tracks[0], own))
    assert (plain.sigmas > SETTINGS.position_noise).all()
    assert (wide.sigmas[:4] < 0.02).all()
    assert (wide.sigmas[4:] > 0.05).all()


@pytest.mark.parametrize("method", METHODS)
@pytest.mark.parametrize("observed", [1, 2, 3, 5])
def test_few_samples_give_wide_intervals(tracks, method, observed):
    (result,) = predict_tracks(estimator(method), tracks[:1], 1, (observed - 0.5) * 0.01)
    assert len(result.estimate.times) == observed
    assert np.isfinite(result.positions).all()
    assert np.isfinite(result.sigmas).all()
    assert (np.abs(result.measured - result.positions) < 5 * result.sigmas).all()
    if observed == 1:
        assert result.status is Status.NO_VELOCITY


def test_wrong_arguments_are_refused_at_once(tracks):
    for observe in (0.0, -1.0, np.nan):
        with pytest.raises(ValueError, match="observe must be a positive number of seconds; got"):
            predict_tracks(estimator(), tracks, 1, observe)
    with pytest.raises(ValueError, match="horizon must be a positive number of seconds; got"):
        predict_tracks(estimator(), tracks, 1, 0.2, horizon=0.0)


# --- beliefs -----------------------------------------------------------------------------------------------------

COEFFICIENTS = {"flight.drag.k": 0.03, "bounce.restitution.e": 0.02}


def test_coefficients_come_with_their_correlations(tracks):
    settings = replace(SETTINGS, coefficients=COEFFICIENTS)
    estimate = estimator("smoother", settings).estimate(tracks[0])
    belief = Belief.of(nominal_model(), [estimate.last], COEFFICIENTS)
    assert belief.mean.shape == (1, 11)
    np.testing.assert_array_equal(belief.mean[0, 9:], estimate.coefficients)
    np.testing.assert_array_equal(belief.covariance[0, :9, 9:], estimate.cross_covariances[-1])
    np.testing.assert_allclose(belief.covariance[0, 9:, 9:], estimate.coefficient_covariance)


def test_an_estimator_without_coefficients_has_their_prior(tracks):
    """So that the sliding window's intervals say what it does not know about drag and bounce."""
    settings = replace(SETTINGS, coefficients=COEFFICIENTS)
    windowed, smoothed = (estimator(m, settings).estimate(tracks[0]) for m in ("sliding-window", "smoother"))
    belief = Belief.of(nominal_model(), [windowed.last, smoothed.last], COEFFICIENTS)
    parameters = dict(nominal_model().named_parameters())
    assert belief.mean[0, 9:].tolist() == [float(parameters[name].detach()) for name in COEFFICIENTS]
    np.testing.assert_allclose(belief.covariance[0, 9:, 9:], np.diag([0.03**2, 0.02**2]))
    assert not belief.covariance[0, :9, 9:].any()
    np.testing.assert_array_equal(belief.mean[1, 9:], smoothed.coefficients)
    (without,) = predict_tracks(estimator("sliding-window"), tracks[:1], 1, 0.2)
    (with_,) = predict_tracks(estimator("sliding-window", settings), tracks[:1], 1, 0.2)
    assert (with_.sigmas[-1, [0, 2]] > 1.001 * without.sigmas[-1, [0, 2]]).all()


def test_coefficients_are_held_within_their_bounds(tracks):
    settings = replace(SETTINGS, coefficients=COEFFICIENTS)
    estimate = estimator("smoother", settings).estimate(tracks[0])
    beyond = replace(estimate, coefficients=np.array([-0.01, 1.05]))
    belief = Belief.of(nominal_model(), [beyond.last])
    np.testing.assert_allclose(belief.mean[0, 9:], [0.0, 1.0], atol=1e-15)
    change = np.linalg.solve(estimate.coefficient_covariance, [0.01, -0.05])
    expected = estimate.states[-1] + estimate.cross_covariances[-1] @ change
    np.testing.assert_allclose(belief.mean[0, :9], expected)
    np.testing.assert_allclose(belief.covariance, Belief.of(nominal_model(), [estimate.last]).covariance)


def test_a_coefficient_that_another_s_bound_pulls_out_is_held_too(tracks):
    """A restitution above one is held at one; drag goes down with it, and would become negative."""
    settings = replace(SETTINGS, coefficients=COEFFICIENTS)
    estimate = estimator("smoother", settings).estimate(tracks[0])
    together = np.array([[0.03**2, 0.9 * 0.03 * 0.02], [0.9 * 0.03 * 0.02, 0.02**2]])
    beyond = replace(estimate, coefficients=np.array([0.01, 1.05]), coefficient_covariance=together)
    belief = Belief.of(nominal_model(), [beyond.last])
    np.testing.assert_allclose(belief.mean[0, 9:], [0.0, 1.0], atol=1e-15)


def test_beliefs_refuse_what_does_not_fit(tracks):
    settings = replace(SETTINGS, coefficients=COEFFICIENTS)
    windowed, smoothed = (estimator(m, settings).estimate(tracks[0]) for m in ("sliding-window", "smoother"))
    with pytest.raises(ValueError, match="at least one"):
        Belief.of(nominal_model(), [])
    with pytest.raises(ValueError, match="states must share their coefficients; that of track '0'"):
        Belief.of(nominal_model(), [smoothed.last, windowed.last])
    with pytest.raises(ValueError, match="states must share their coefficients; that of track '0'"):
        Belief.of(nominal_model(), [smoothed.last], {})


# --- do the intervals hold? --------------------------------------------------------------------------------------


def inside(whitened, half_width: float) -> float:
    return float((np.abs(whitened) < half_width).mean())


@pytest.mark.parametrize("method", ["smoother", "ekf"])
def test_intervals_hold_as_often_as_they_say(tracks, method):
    """At single stamps before and after the bounce; over 360 coordinates each share is good to 4 binomial sigmas."""
    results = list(predict_tracks(estimator(method), tracks, len(tracks), 0.2))
    for stamp in (25, 49):
        whitened = np.stack([((r.measured - r.positions) / r.sigmas)[stamp - 21] for r in results])
        n = whitened.size
        for share, half_width in ((0.5, 0.6745), (0.9, 1.6449)):
            assert abs(inside(whitened, half_width) - share) < 4 * np.sqrt(share * (1 - share) / n), (stamp, share)


@pytest.mark.skipif(not DATA.is_dir(), reason="the measured tracks are not on this machine")
@pytest.mark.parametrize("name", ["aimy", "ballgun"])
def test_measured_tracks(name):
    """Every fourth track: 0.25 s observed, 0.3 s predicted, nominal model. A plain least-squares fit has 27 mm."""
    dataset = read_dataset(DATA / name)
    model = nominal_model(dataset.info.ball)
    smoother = make_estimator("smoother", model, dataset_surfaces(dataset), dataset_settings(dataset, model))
    some = list(dataset)[::4]
    results = [r for r in predict_tracks(smoother, some, len(some), 0.25, horizon=0.3) if len(r.times)]
    errors = [r.measured - r.positions for r in results]
    assert np.median([np.sqrt((e**2).sum(-1).mean()) for e in errors]) < 0.022
    whitened = np.concatenate([e / r.sigmas for e, r in zip(errors, results, strict=True)])
    assert 0.80 <= inside(whitened, 1.6449) <= 0.97


def test_a_track_whose_rest_cannot_be_metres_is_refused() -> None:
    """The observed part alone would pass."""
    (track,) = simulated(1)
    positions = track.positions.copy()
    positions[track.times > 0.3] *= 1e5
    with pytest.raises(ValueError, match="track '0'"):
        list(predict_tracks(estimator(), [replace(track, positions=positions)], 1, 0.25))


def test_predictions_say_how_far_they_are_from_where_a_network_was_trained() -> None:
    """None for a model that knows no such place; else what is left of its trust there."""
    (track,) = simulated(1)
    (plain,) = predict_tracks(estimator(), [track], 1, 0.25)
    assert plain.outside is None
    model = nominal_model()
    model.inside = lambda states: torch.full((len(states),), 0.25, dtype=torch.float64)
    (found,) = predict_tracks(make_estimator("ekf", model, TABLE, SETTINGS), [track], 1, 0.25)
    assert found.outside is not None
    assert found.outside.tolist() == [0.75] * len(found.times)
