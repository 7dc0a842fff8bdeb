"""Spins that the analytic model finds in tracks: those that were simulated, and only where tracks tell."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from ballfg.dynamics import nominal_model
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.estimation import Smoother
from ballfg.learning.config.training import TrainConfig
from ballfg.learning.end_to_end.build import SPIN_PRIOR, _spin
from ballfg.learning.run.training import build
from ballfg.simulation import MeasurementNoise, SimulationConfig, table_tennis, write_simulation
from ballfg.tracks import read_dataset, write_dataset

LEVELS = ("topspin", "sidespin")


@pytest.fixture(scope="module")
def launched(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("launched") / "data"
    write_simulation(folder, SimulationConfig(8, seed=2, noise=MeasurementNoise(position=0.001), spin_labels=False))
    return folder


def learned(data: Path, labels: tuple[str, ...], **launcher: str):
    given = {"data": [str(data)], "split": {"by": "none"}, "observe": {"samples": 25}, "kind": "a-tune"}
    trainee, *_ = build(TrainConfig.model_validate(given | {"launcher": {"labels": list(labels)} | launcher}))
    return trainee.learnables.embedding


def test_levels_mean_what_was_simulated(launched: Path) -> None:
    embedding = learned(launched, LEVELS, start="tracks")
    launcher = table_tennis().launcher
    topspin, sidespin = embedding.local(torch.eye(2, dtype=torch.float64)).detach().numpy()
    np.testing.assert_allclose(topspin, [0.0, launcher.topspin_scale, 0.0], atol=15.0)
    np.testing.assert_allclose(sidespin, [0.0, 0.0, launcher.sidespin_scale], atol=15.0)


def test_groups_get_the_mean_of_their_shots(launched: Path, tmp_path: Path) -> None:
    dataset, launcher = read_dataset(launched), table_tennis().launcher
    tracks = [
        replace(t, labels={**t.labels, "group": "much" if t.labels["topspin"] > 1 else "little"}) for t in dataset
    ]
    write_dataset(tmp_path / "data", dataset.info, tracks)
    embedding = learned(tmp_path / "data", ("group",), start="tracks")
    local = embedding.local(torch.eye(2, dtype=torch.float64)).detach().numpy()
    for row, name in zip(local, embedding.categories["group"], strict=True):
        mine = [t.labels["topspin"] for t in tracks if t.labels["group"] == name]
        assert row[1] == pytest.approx(launcher.topspin_scale * np.mean(mine), abs=25.0)


def test_names_stay_the_default_and_tracks_that_tell_their_spin_are_passed_over(tmp_path: Path, launched: Path) -> None:
    assert torch.equal(learned(launched, LEVELS).weight, learned(launched, LEVELS, start="names").weight)
    write_simulation(tmp_path / "data", SimulationConfig(3, seed=2, spin_labels=True))
    untouched = learned(tmp_path / "data", LEVELS, start="tracks")
    assert torch.equal(untouched.weight, learned(launched, LEVELS).weight)


def test_a_spin_is_about_the_axes_of_the_launch(launched: Path) -> None:
    """Forward is where the ball flies at its first sample, not later: a sidespin of 150 rad/s turns it on the way."""
    given = {"data": [str(launched)], "split": {"by": "none"}, "observe": {"samples": 25}, "kind": "a-tune"}
    trainee, *_ = build(TrainConfig.model_validate(given | {"launcher": {"labels": list(LEVELS)}}))
    shot, model = trainee.shots[0], nominal_model()
    wide = replace(shot.settings, launcher=None, coefficients=coefficient_sigmas(model), spin_prior=SPIN_PRIOR)
    launch = Smoother(model, shot.surfaces, wide).estimate(shot.track).states[0]
    heading = np.arctan2(launch[4], launch[3])
    expected = Rotation.from_euler("z", -heading).apply(launch[6:9])
    np.testing.assert_allclose(_spin(shot, model), expected, atol=1e-9)
