"""A residual network that was trained knows where: its fading, its rooms and their noise come with the export."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.dynamics import load_model
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.estimation import dataset_settings
from ballfg.learning import TrainConfig, build
from ballfg.learning.end_to_end.elsewhere import by_room
from ballfg.simulation import SimulationConfig, write_simulation
from ballfg.tracks import read_dataset
from tests.small_networks import SMALL

pytestmark = pytest.mark.usefixtures("all_networks_in_torch")


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("elsewhere")
    write_simulation(folder / "hall", SimulationConfig(tracks=12, rate=60.0, seed=1, spin_labels=False))
    config = TrainConfig.model_validate(
        {
            "kind": "mnn+gs",
            "data": str(folder / "hall"),
            "architecture": SMALL | {"residual": True},
            "observe": {"samples": 20},
            "split": {"by": "none"},
        }
    )
    trainee, _, _ = build(config)
    return folder, trainee, trainee.export(folder)


def test_the_exported_model_names_its_room_and_the_noise_there(exported):
    folder, _, file = exported
    model = load_model(file)
    assert model.trained.rooms == ("simulated table-tennis",)
    noise = model.trained.elsewhere
    assert 0.003 < noise.acceleration < 0.3  # simulated flights are exact: far less than usual noise times three
    assert set(noise.coefficients) == {f"base.{name}" for name in ("flight.drag.k", "bounce.restitution.e")} | {
        "base.bounce.table_height.offset"
    }
    hall = read_dataset(folder / "hall")
    assert not dataset_settings(hall, model).coefficients


@pytest.mark.thorough
def test_training_tracks_lie_inside_and_other_speeds_outside(exported):
    _, trainee, file = exported
    model = load_model(file)
    assert isinstance(model, LearnedModel)
    shot = trainee.shots[0]
    states = torch.from_numpy(trainee.solver((0,), {})[0][0].solution.minimum.values.states)
    assert len(states) == shot.observed
    assert model.inside(states).median() > 0.5
    fast = states.clone()
    fast[:, 3:6] *= 6.0
    assert (model.inside(fast) < 0.05).all()


def test_twelve_tracks_of_each_room_spread_over_it_tell_its_noise(exported):
    shot = exported[1].shots[0]
    many = [replace(shot, observed=number, room="hall" if number % 2 else "lab") for number in range(46)]
    hall, lab, yard = ([shot.observed for shot in room] for room in by_room([*many[::-1], shot]))
    assert (len(hall), hall[0], hall[-1]) == (12, 45, 1)
    assert (len(lab), lab[0], lab[-1]) == (12, 44, 0)
    assert set(np.diff(hall).tolist()) == {-4}
    assert len(yard) == 1
    assert [len(room) for room in by_room(many[:9])] == [5, 4]
