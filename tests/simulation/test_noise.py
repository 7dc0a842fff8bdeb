"""Noise of the measurement and of the motion, against what was asked for."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy import stats

from ballfg.dynamics import nominal_model
from ballfg.dynamics.model_file import model_from_dict
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, simulate, table_tennis
from ballfg.simulation.balls import with_model
from ballfg.simulation.motion import KickedModel, process_noise
from ballfg.simulation.synthetic import SimulatedTrack
from ballfg.tracks.track import SPIN_LABELS

QUIET = MeasurementNoise(position=0.0, spin=0.0)


def run(tracks: int = 60, **changes: object) -> list[SimulatedTrack]:
    return list(simulate(SimulationConfig(**{"tracks": tracks, "seed": 5, "noise": QUIET, **changes})))  # type: ignore[arg-type]


def assert_sigma(samples: np.ndarray, sigma: float) -> None:
    """The sample variance lies within the 99.9 % chi-square band of independent normals of that sigma."""
    low, high = stats.chi2.interval(0.999, samples.size)
    assert low < np.sum((samples / sigma) ** 2) < high


def test_position_noise_and_label_noise() -> None:
    tracks = run(noise=MeasurementNoise(position=0.004, spin=6.0))
    assert_sigma(np.concatenate([t.track.positions - t.true_states[:, :3] for t in tracks]), 0.004)
    labels = np.array([[t.track.labels[name] for name in SPIN_LABELS] for t in tracks])
    assert_sigma(labels - np.array([t.true_states[0, 6:] for t in tracks]), 6.0)


def test_without_noise_the_track_is_the_truth() -> None:
    for simulated in run(5):
        np.testing.assert_array_equal(simulated.track.positions, simulated.true_states[:, :3])
        np.testing.assert_array_equal(simulated.track.times, simulated.true_times)
        np.testing.assert_array_equal(simulated.track.spin_label, simulated.true_states[0, 6:])


def test_dropped_fraction() -> None:
    whole = sum(len(t.track) for t in run())
    kept = sum(len(t.track) for t in run(noise=MeasurementNoise(dropout=0.2)))
    low, high = stats.binom.interval(0.999, whole, 0.8)
    assert low < kept < high


def test_a_track_keeps_two_samples_however_many_are_dropped() -> None:
    assert min(len(t.track) for t in run(noise=MeasurementNoise(dropout=0.95))) >= 2


def test_jitter_moves_stamps_and_keeps_their_order() -> None:
    tracks = run(noise=MeasurementNoise(position=0.0, jitter=0.0015))
    assert min(np.diff(t.track.times).min() for t in tracks) > 0
    shift = np.concatenate([t.track.times - t.true_times for t in tracks])
    assert np.std(shift) == pytest.approx(0.0015, rel=0.03)
    assert np.abs(shift).max() <= 3 * 0.0015 + 1e-12


def test_outliers_are_as_many_and_as_large_as_asked_for() -> None:
    tracks = run(noise=MeasurementNoise(position=0.0, outliers=0.05, outlier_size=0.2))
    away = np.concatenate([np.linalg.norm(t.track.positions - t.true_states[:, :3], axis=1) for t in tracks])
    low, high = stats.binom.interval(0.999, away.size, 0.05)
    assert low < np.count_nonzero(away) < high
    assert 0.1 - 1e-9 <= away[away > 0].min() < away.max() <= 0.3 + 1e-9


def test_process_noise_has_the_covariance_of_white_acceleration() -> None:
    dt, noise, n = 0.02, MotionNoise(acceleration=0.3, spin=5.0), 40_000
    steps = [process_noise(n, dt / 4, noise, np.random.default_rng(i)).numpy() for i in range(4)]
    total = np.zeros((n, 9))
    for step in steps:  # four steps must make one of four times the length
        total[:, :3] += total[:, 3:6] * (dt / 4)
        total += step
    q2 = 0.3**2
    covariance = np.cov(total[:, 0], total[:, 3])
    expected = q2 * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
    np.testing.assert_allclose(covariance, expected, rtol=0.03)
    assert np.var(total[:, 6:]) == pytest.approx(25.0 * dt, rel=0.03)


def test_process_noise_of_whole_tracks_matches_the_closed_form() -> None:
    """The same launches with and without process noise, compared in free flight 0.2 s after the launch."""
    noise = MotionNoise(acceleration=0.2, spin=3.0)
    vacuum = with_model(table_tennis(), model_from_dict({"flight": {"gravity": {}}, "bounce": {}}))  # drag would damp
    pairs = zip(run(400, process=noise, ball=vacuum), run(400, ball=vacuum), strict=True)
    change = np.array([a.true_states[20] - b.true_states[20] for a, b in pairs])
    assert_sigma(change[:, 3:6], 0.2 * np.sqrt(0.2))
    assert_sigma(change[:, :3], 0.2 * np.sqrt(0.2**3 / 3))
    assert_sigma(change[:, 6:], 3.0 * np.sqrt(0.2))


def test_contact_kicks() -> None:
    noise = MotionNoise(contact_velocity=0.05, contact_spin=4.0)
    model = nominal_model()
    before = torch.tensor([[0.0, 0.0, 0.0, 3.0, 0.2, -3.0, 20.0, 100.0, 30.0]], dtype=torch.float64).expand(20_000, 9)
    kick = (
        (KickedModel(model, noise, np.random.default_rng(0)).after_bounce(before) - model.after_bounce(before))
        .detach()
        .numpy()
    )
    assert np.all(kick[:, :3] == 0)
    assert_sigma(kick[:, 3:6], 0.05)
    assert_sigma(kick[:, 6:], 4.0)


def test_kicked_contacts_leave_upwards_and_change_what_follows_only() -> None:
    kicked = run(20, process=MotionNoise(contact_velocity=0.1))
    for simulated, plain in zip(kicked, run(20), strict=True):
        contact = int(np.flatnonzero(np.diff(plain.true_states[:, 5]) > 0.5)[0])
        # not to the last bit: a model that draws random numbers runs in torch
        before, same = simulated.true_states[: contact + 1], plain.true_states[: contact + 1]
        np.testing.assert_allclose(before, same, rtol=1e-12, atol=1e-12)
        assert not np.array_equal(simulated.true_states[contact + 1], plain.true_states[contact + 1])


def test_noise_of_one_kind_leaves_the_rest_as_it_was() -> None:
    quiet, noisy = run(10), run(10, noise=MeasurementNoise(position=0.0, spin=9.0, outliers=0.3))
    for a, b in zip(quiet, noisy, strict=True):
        np.testing.assert_array_equal(a.true_states, b.true_states)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: MeasurementNoise(dropout=1.0), "dropout must be at least 0, at most 0.95; got 1"),
        (lambda: MeasurementNoise(position=float("nan")), "position must be"),
        (lambda: MotionNoise(acceleration=-1.0), "acceleration must be at least 0"),
        (lambda: SimulationConfig(noise=MeasurementNoise(jitter=0.01)), "jitter must be at most 0.15 frames"),
        (lambda: SimulationConfig(tracks=0), r"tracks must lie in 1 \.\."),
        (lambda: SimulationConfig(seed=-1), "seed must lie in"),
        (lambda: SimulationConfig(rate=0.0), "rate must be at least 5"),
    ],
)
def test_bad_values_are_refused_by_name(make: object, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()  # type: ignore[operator]


def test_wrong_types_are_refused_by_name() -> None:
    with pytest.raises(TypeError, match=r"tracks must be a whole number; got 1\.5"):
        SimulationConfig(tracks=1.5)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="spin must be a number; got '4'"):
        MeasurementNoise(spin="4")  # type: ignore[arg-type]


def test_process_noise_is_that_of_the_estimators() -> None:
    """Two rooms discretise the same densities: drawn here, as covariances in the factors. 200,000 draws give 0.5 %."""
    dt, noise = 0.013, MotionNoise(acceleration=0.7, spin=3.0)
    drawn = process_noise(200_000, dt, noise, np.random.default_rng(5)).numpy()
    declared = ProcessNoise(acceleration=0.7, spin=3.0).flight(np.array([dt]))[0]
    scale = np.sqrt(np.diagonal(declared))
    np.testing.assert_allclose(np.cov(drawn.T) / np.outer(scale, scale), declared / np.outer(scale, scale), atol=0.02)


@pytest.mark.parametrize("name", ["acceleration", "spin"])
def test_any_density_disturbs_the_flight(name: str) -> None:
    noise = MotionNoise(**{name: 1e-3})
    assert noise.in_flight
    assert not noise.in_contact


@pytest.mark.parametrize("name", ["contact_velocity", "contact_spin"])
def test_any_kick_disturbs_contacts(name: str) -> None:
    noise = MotionNoise(**{name: 1e-3})
    assert noise.in_contact
    assert not noise.in_flight
