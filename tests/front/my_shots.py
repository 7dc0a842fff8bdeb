"""Simulated shots in a folder, and what is asked of two estimates."""

from __future__ import annotations

from pathlib import Path

import numpy as np

import ballfg as bf
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation


def written(folder: Path, tracks: int = 3, **changes: object) -> Path:
    noise = MeasurementNoise(position=0.003)
    write_simulation(folder, SimulationConfig(tracks, 100.0, seed=1, noise=noise, **changes))
    (folder / "model.yaml").unlink()
    return folder


def same(one: bf.Estimate, other: bf.Estimate) -> None:
    np.testing.assert_array_equal(one.states, other.states)
    np.testing.assert_array_equal(one.covariances, other.covariances)
