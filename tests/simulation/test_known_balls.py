"""A simulated flight of each known ball, estimated back with the right errors and covariances."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.stats import chi2

from ballfg.dynamics.known_balls import KNOWN_BALLS
from ballfg.estimation import Settings, Smoother, Status
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, simulate
from ballfg.simulation.balls import ball_kind
from ballfg.tracks import TABLE_TENNIS

TRACKS = 3
DURATIONS = {"golf": 2.6}
"""s. Flights end before the ball comes to rest: at rest a state has no covariance to speak of."""
PROCESS = {"acceleration": 0.1, "spin": 1.0, "contact_velocity": 0.02, "contact_spin": 5.0}


@pytest.mark.parametrize("name", [name for name in KNOWN_BALLS if name not in ("table_tennis", "tennis")])
def test_flights_are_estimated_back_with_nees_in_bounds(name: str) -> None:
    kind = ball_kind(name)
    kind = replace(kind, launcher=replace(kind.launcher, duration=DURATIONS.get(name, 1.3)))
    config = SimulationConfig(
        tracks=TRACKS, seed=5, ball=kind, process=MotionNoise(**PROCESS), noise=MeasurementNoise(position=0.005)
    )
    settings = Settings(
        position_noise=(0.005,) * 3,
        process=ProcessNoise(**PROCESS),
        spin_label_noise=4.0,
        loss=Loss(),
        label_loss=Loss(),
        spin_loss=Loss(),
    )
    smoother = Smoother(kind.model, kind.surfaces, settings)
    means = []
    for simulated in simulate(config):
        estimate = smoother.estimate(simulated.track)
        assert estimate.status is Status.OK
        error = estimate.states - simulated.true_states
        means.append(np.einsum("ni,nij,nj->n", error, np.linalg.inv(estimate.covariances), error).mean())
        assert np.abs(error[:, :3]).max() < 0.03
    low, high = chi2.ppf([0.001, 0.999], 9 * TRACKS) / TRACKS
    assert low < np.mean(means) < high


@pytest.mark.parametrize("name", [name for name in KNOWN_BALLS if name != "table_tennis"])
def test_balls_bounce_on_the_ground_and_stay_above_it(name: str) -> None:
    kind = ball_kind(name)
    states = np.concatenate([t.true_states for t in simulate(SimulationConfig(tracks=20, ball=kind, seed=1))])
    assert states[:, 2].min() > kind.ball.radius - 1e-9
    assert (np.diff(states[:, 5]) > 0.5).sum() >= 10  # most of them bounce


def test_no_ball_takes_the_place_of_the_one_that_is_meant(tmp_path: Path) -> None:
    assert ball_kind("table-tennis").ball == TABLE_TENNIS
    with pytest.raises(ValueError, match="a badminton shuttle is no ball"):
        ball_kind("badminton")
