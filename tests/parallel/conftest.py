"""A simulated dataset that states its noise: nothing is learned of it before its tracks are estimated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import read_dataset, write_dataset
from ballfg.tracks.noise import TrackNoise

TRACKS = 24


@pytest.fixture(scope="session")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("scale")
    write_simulation(path / "simulated", SimulationConfig(tracks=TRACKS, rate=50.0, seed=5))
    dataset = read_dataset(path / "simulated")
    info = replace(dataset.info, noise=TrackNoise(position=(0.003, 0.003, 0.003)))
    write_dataset(path / "shots", info, dataset, "parquet")
    return path / "shots"
