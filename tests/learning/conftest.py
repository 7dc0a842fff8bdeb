from __future__ import annotations

from pathlib import Path

import pytest

from ballfg.dynamics.model_file import model_from_dict
from ballfg.simulation import MeasurementNoise, SimulationConfig, table_tennis, write_simulation
from ballfg.simulation.balls import with_model

PLANTED = {"flight.drag.k": 0.155, "bounce.restitution.e": 0.88, "bounce.table_height.offset": 0.006}


def simulated(
    folder: Path, tracks: int, *, spin_labels: bool = True, drag: float = PLANTED["flight.drag.k"], seed: int = 3
) -> Path:
    """A dataset of balls that drag more and bounce less than the nominal one, on a table that lies higher."""
    content = {
        "flight": {"gravity": {}, "drag": {"k": drag}, "magnus": {"k": 0.0028}},
        "bounce": {
            "restitution": {"e": PLANTED["bounce.restitution.e"]},
            "friction": {"mu": 0.25},
            "tangential_restitution": {"e_t": 0.15},
            "table_height": {"offset": PLANTED["bounce.table_height.offset"]},
        },
    }
    ball = with_model(table_tennis(), model_from_dict(content))
    noise = MeasurementNoise(position=0.0015)
    write_simulation(folder, SimulationConfig(tracks, 80.0, seed=seed, ball=ball, noise=noise, spin_labels=spin_labels))
    return folder


@pytest.fixture(scope="session")
def few_tracks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("few") / "data", 6)


@pytest.fixture(scope="session")
def many_tracks(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("many") / "data", 24)


@pytest.fixture(scope="session")
def no_spin_labels(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return simulated(tmp_path_factory.mktemp("plain") / "data", 3, spin_labels=False)
