from __future__ import annotations

import dataclasses

import pytest

from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate, table_tennis
from ballfg.tracks import Track


def simulated(tracks: int, *, rate: float = 60.0, seed: int = 0, noise: float = 0.001) -> list[Track]:
    ball = table_tennis()
    ball = dataclasses.replace(ball, launcher=ball.launcher.with_fields({"duration": 1.0}))
    config = SimulationConfig(tracks, rate, seed, ball, noise=MeasurementNoise(position=noise), spin_labels=False)
    return [each.track for each in simulate(config)]


@pytest.fixture(scope="session")
def tracks() -> list[Track]:
    """Of different lengths, 47 to 61 samples."""
    return simulated(12)
