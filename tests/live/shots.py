"""Simulated shots that the tests of live tracking share."""

from __future__ import annotations

from functools import cache

import numpy as np

from ballfg.dynamics import AnalyticModel, nominal_model
from ballfg.estimation import Settings
from ballfg.simulation import SimulationConfig, simulate
from ballfg.tracks import Track

RATE = 60.0
SURFACES = SimulationConfig().ball.surfaces


@cache
def shots(count: int = 2, seed: int = 2) -> list[Track]:
    """Shots with a bounce and 0.8 s, each on a clock that begins at 0."""
    return [shot.track.until(0.8) for shot in simulate(SimulationConfig(tracks=count, rate=RATE, seed=seed))]


@cache
def ball_model() -> AnalyticModel:
    return nominal_model()


@cache
def ball_settings() -> Settings:
    return Settings.for_measured(ball_model(), position_noise=(0.003,) * 3)


def rows(track: Track, later: float = 0.0, beside: float = 0.0) -> np.ndarray:
    """(n, 4) t, x, y, z of a track, `later` s on the clock and `beside` m along y."""
    return np.column_stack((track.times + later, track.positions + np.array([0.0, beside, 0.0])))
