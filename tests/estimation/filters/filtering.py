"""Simulated tracks for the filters, and how far an estimate of one is from its truth."""

from __future__ import annotations

import numpy as np
import torch

from ballfg.dynamics import nominal_model
from ballfg.dynamics.motion.arrays import advance_jacobian
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION
from ballfg.tracks import Track

LOW = Surfaces(table_height=-100.0)
TABLE = Surfaces.table_tennis(0.0)
SPIN_SIGMA = 5.0
PLAIN = Settings(
    position_noise=(0.002, 0.002, 0.002),
    process=ProcessNoise(acceleration=0.3, spin=2.0, contact_velocity=0.03, contact_spin=3.0),
    spin_label_noise=SPIN_SIGMA,
    loss=Loss("squared"),
)
SERVE = np.array([0.0, 0.0, 0.3, 5.0, 0.5, 1.0, 10.0, 60.0, 20.0])


def tensor(state: np.ndarray) -> torch.Tensor:
    """(1, 9) of a state (9,)."""
    return torch.from_numpy(np.array(state, dtype=np.float64)[None])


def simulate(model, settings: Settings, start, times, rng, surfaces=TABLE, label=True) -> tuple[np.ndarray, Track]:
    """True states (n, 9) with process noise exactly as the settings declare it, and their measured track."""
    truth = [np.array(start)]
    noise = settings.process
    for dt in np.diff(times):
        motion = advance_jacobian(model, truth[-1], dt, surfaces)
        covariance = noise.flight(np.array([dt]))[0]
        for time, _ in motion.contacts:
            kick = noise.contact(np.array([dt]), np.array([time]))[0]
            covariance = covariance + kick
        truth.append(motion.after + rng.multivariate_normal(np.zeros(9), covariance, method="eigh"))
    truth = np.array(truth)
    measured = truth[:, POSITION] + settings.position_noise * rng.standard_normal((len(times), 3))
    spin = truth[0, 6:] + settings.spin_label_noise * rng.standard_normal(3)
    labels = dict(zip(("spin_x", "spin_y", "spin_z"), spin, strict=True)) if label else {}
    return truth, Track(times, measured, labels=labels, name="simulated")


def with_positions(track: Track, positions: np.ndarray) -> Track:
    """The track, measured elsewhere."""
    return Track(track.times, positions, labels=track.labels, name=track.name)


def run(track: Track, **options) -> Estimate:
    """An estimate of the filter that is finite, with covariances that are positive definite."""
    result = ExtendedKalmanFilter(nominal_model(), TABLE, PLAIN, **options).estimate(track)
    assert np.isfinite(result.states).all()
    assert (np.linalg.eigvalsh(result.covariances)[:, 0] > 0).all()
    assert result.quality.shape == (len(track),)
    return result
