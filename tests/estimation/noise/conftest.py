"""Simulated trackers with known noise, linearised once."""

import pytest

from ballfg.dynamics import load_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Settings, dataset_settings, dataset_surfaces
from ballfg.simulation import MeasurementNoise, MotionNoise, SimulationConfig, write_simulation
from ballfg.tracks import Track, read_dataset


@pytest.fixture(scope="session")
def recorded(tmp_path_factory):
    """recorded(noise, process, tracks): model, surfaces, usual settings and tracks of a simulated launcher."""

    def make(noise: MeasurementNoise, process: MotionNoise | None = None, tracks: int = 16, seed: int = 5):
        folder = tmp_path_factory.mktemp("noise") / "shots"
        config = SimulationConfig(tracks, 120.0, seed=seed, noise=noise, process=process or MotionNoise())
        write_simulation(folder, config)
        dataset = read_dataset(folder)
        model = load_model(folder / "model.yaml", radius=dataset.ball.radius)
        return model, dataset_surfaces(dataset), dataset_settings(dataset, model), list(dataset)

    return make


Recorded = tuple[object, Surfaces, Settings, list[Track]]
