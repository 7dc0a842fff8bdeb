"""Covariances are honest on tracks of a tracker with memory and jittering stamps, where it is declared as it is.

Bounces, process noise in flight and in contacts, label noise; NEES per track, averaged over its stamps, in the band of
one chi-square number a track. White noise of the same size, declared in place of what lasts, falls out of the band.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.online.online import Online
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, MotionNoise as TrueNoise, SimulationConfig, simulate
from tests.estimation.nees import GAUSSIAN, band, nees
from tests.estimation.tracker_noise import measured_by

TRACKS = 16
CONFIG = SimulationConfig(
    tracks=TRACKS,
    seed=11,
    process=TrueNoise(acceleration=0.1, spin=1.0, contact_velocity=0.02, contact_spin=5.0),
    noise=MeasurementNoise(position=0.003, spin=4.0),
)
DECLARED = replace(
    GAUSSIAN,
    position_noise=(0.002, 0.002, 0.003),
    memory=(0.003, 0.004, 0.003),
    memory_time=0.02,
    stamp_jitter=0.0005,
    process=ProcessNoise(acceleration=0.1, spin=1.0, contact_velocity=0.02, contact_spin=5.0),
    spin_label_noise=4.0,
)
WHITE = replace(
    DECLARED,
    position_noise=tuple(np.hypot(DECLARED.position_noise, DECLARED.memory)),
    memory=(0.0, 0.0, 0.0),
    stamp_jitter=0.0,
)


@pytest.fixture(scope="module")
def tracks() -> list:
    return [(s.true_states, measured_by(s.track, s.true_states, DECLARED, k)) for k, s in enumerate(simulate(CONFIG))]


ESTIMATORS = {
    "smoother": (Smoother, {}),
    "ekf": (ExtendedKalmanFilter, {}),
    "ekf+rts": (ExtendedKalmanFilter, {"smooth": True}),
    "ekf from a window": (ExtendedKalmanFilter, {"initialise": "window"}),
    "online": (Online, {}),
}


@pytest.mark.parametrize(
    "name",
    [
        "smoother",
        "ekf",
        *(pytest.param(n, marks=pytest.mark.thorough) for n in ("ekf+rts", "ekf from a window", "online")),
    ],
)
def test_nees_is_inside_its_band(tracks, name) -> None:
    build, options = ESTIMATORS[name]
    model, surfaces = CONFIG.ball.model, CONFIG.ball.surfaces
    told, white, last, whitened = [], [], [], []
    for truth, track in tracks:
        for settings, values in ((DECLARED, told), (WHITE, white)):
            estimate = build(model, surfaces, settings, **options).estimate(track)
            distances = nees(estimate, truth)
            values.append(distances[5:].mean())
            if settings is DECLARED:
                last.append(distances[-1])
                whitened.append(estimate.whitened[6:])
    low, high = band(9, TRACKS)
    print(name, low, high, np.mean(told), np.mean(last), np.mean(white))  # shown by -s
    assert low < np.mean(told) < high
    assert low < np.mean(last) < high
    assert np.mean(white) > high
    np.testing.assert_allclose(np.concatenate(whitened).std(axis=0), 1.0, atol=0.04)
