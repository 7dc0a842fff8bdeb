"""Planted spins of two launchers come back from unlabelled flights, and other flights are predicted better for it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces, load_model, nominal_model
from ballfg.dynamics.motion.paths import paths
from ballfg.dynamics.population import launch_axes
from ballfg.estimation import dataset_settings
from ballfg.estimation.launcher import launch_velocity
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.auto import CALIBRATED, GROUPED
from ballfg.learning.calibration.calibrate import calibrate, has_converged
from ballfg.learning.calibration.coefficients import with_values
from ballfg.learning.calibration.problem import Problem, Step, population_model, population_settings, pose, score
from ballfg.learning.calibration.run import run_calibration
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import summary
from ballfg.progress import unwatched
from ballfg.tracks import TABLE_TENNIS, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo
from tests.learning.calibration.measured_groups import Halves
from tests.places import DATA

NOISE = 0.001
PLANTED = {"back": ((0.0, -150.0, 10.0), (10.0, 25.0, 10.0)), "top": ((-20.0, 140.0, 0.0), (10.0, 20.0, 15.0))}
"""rad/s, mean and spread of each launcher's spins, forward, across and up."""
DIRECTIONS = {"back": 0.3, "top": 2.1}
"""rad, of the launchers' middle shots in the world."""


def shots(seed: int, count: int, drag: Mapping[str, float]) -> list[Track]:
    """Shots of both launchers, each in directions of its own, over 0.55 s and mostly one bounce."""
    rng, times = np.random.default_rng(seed), np.arange(0.0, 0.55, 0.01)
    found = []
    for number in range(count):
        group = ("back", "top")[number % 2]
        model = with_values(nominal_model(), ["flight.drag.k"], np.array([drag[group]]))
        mean, sigma = PLANTED[group]
        local = rng.normal(mean, sigma)
        turn = DIRECTIONS[group] + rng.normal(0.0, 0.2)
        forward, across = np.array([np.cos(turn), np.sin(turn), 0.0]), np.array([-np.sin(turn), np.cos(turn), 0.0])
        velocity = rng.normal(5.0, 0.3) * forward + np.array([0.0, 0.0, rng.normal(0.8, 0.2)])
        spin = local[0] * forward + local[1] * across + np.array([0.0, 0.0, local[2]])
        start = torch.from_numpy(np.concatenate(([0.0, 0.0, 0.3], velocity, spin)))[None]
        with torch.no_grad():
            path = paths(model, start, torch.from_numpy(times), Surfaces.table_tennis(0.0))[0, :, :3].numpy()
        labels = {"launcher": group}
        found.append(Track(times, path + rng.normal(0.0, NOISE, path.shape), name=f"{number:03}", labels=labels))
    return found


def written(parent: Path, drag: Mapping[str, float], count: int = 40) -> Path:
    info = DatasetInfo(name="two", table_height=0.0, ball=TABLE_TENNIS, position_noise=NOISE)
    write_dataset(parent / "data", info, shots(11, count, drag))
    return parent / "data"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("groups"), {"back": 0.12, "top": 0.12})


@pytest.fixture(scope="module")
def few(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return written(tmp_path_factory.mktemp("few"), {"back": 0.12, "top": 0.12}, 12)


def posed(folder: Path, **fields: Any) -> Problem:
    return pose(read_dataset(folder), nominal_model(), CalibrationConfig(**{"groups": "launcher"} | fields))


@pytest.fixture(scope="module")
def steps(folder: Path) -> list[Step]:
    return list(calibrate(posed(folder)))


def test_planted_groups_come_back(steps: list[Step], folder: Path) -> None:
    problem, last = posed(folder), steps[-1]
    assert problem.groups is not None
    assert has_converged(problem.config, last)
    assert problem.groups.names == ("back", "top")
    assert last.by_group == {}  # one drag, one table
    for name, spin in zip(problem.groups.names, last.spins, strict=True):
        mean, sigma = PLANTED[name]
        assert np.all(np.abs(np.subtract(spin.mean, mean)) < 3.5 * np.array(spin.sigma)), (name, spin)
        assert np.all(np.array(spin.sigma) < 25.0)
        assert np.all(np.array(spin.spread) < 2.0 * np.array(sigma) + 15.0), (name, spin)


def test_other_tracks_are_predicted_better_with_intervals_that_hold(steps: list[Step], folder: Path) -> None:
    problem, last = posed(folder), steps[-1]
    with_groups = population_settings(problem, last)
    without = replace(with_groups, spins=None, group=None)
    found, plain = (
        summary([s for s in score(problem, population_model(problem, last), settings) if s is not None])
        for settings in (with_groups, without)
    )
    assert found is not None
    assert plain is not None
    assert found.tracks == plain.tracks == 20
    assert found.rmse_median < 0.6 * plain.rmse_median
    assert found.coverage_90 > 0.85


def test_groups_of_numbers_are_whole_numbers_and_found_again(few: Path, tmp_path: Path) -> None:
    """The column is one of numbers here, and of text in a table with another group: the spins are the same."""
    data = read_dataset(few)
    numbers = {"back": 1.0, "top": 2.0}
    for name, other in (("sessions", {}), ("more", {"011": "practice"})):
        tracks = [
            replace(track, labels={"launcher": other.get(track.name, numbers[str(track.labels["launcher"])])})
            for track in data
        ]
        write_dataset(tmp_path / name, data.info, tracks)
    problem = posed(tmp_path / "sessions", max_iterations=1)
    steps = list(calibrate(problem))
    assert problem.groups is not None
    assert problem.groups.names == ("1", "2")
    found = population_settings(problem, steps[-1])
    one, other = (read_dataset(tmp_path / name)["001"] for name in ("sessions", "more"))
    assert (one.labels, other.labels) == ({"launcher": 2.0}, {"launcher": "2.0"})
    spins = [found.spin_label(track) for track in (one, other)]
    assert spins[0] is not None
    assert spins[1] is not None
    np.testing.assert_array_equal(spins[0].spin, spins[1].spin)
    across = launch_axes(launch_velocity(one))[1]
    assert spins[0].spin @ across == pytest.approx(steps[-1].spins[1].mean[1])


def test_a_run_writes_the_groups_into_the_model(few: Path, tmp_path: Path) -> None:
    config = CalibrationConfig(groups="launcher", data=str(few), max_iterations=1)
    run_calibration(config, tmp_path / "out", resume=False, jobs=1, watch=unwatched)
    spins = load_model(tmp_path / "out" / "model.yaml").spins
    assert spins is not None
    assert spins.by == "launcher"
    assert {name: group.tracks for name, group in spins.groups.items()} == {
        name: sum(track.labels["launcher"] == name for track in read_dataset(few) if track.name in fitted(few))
        for name in PLANTED
    }
    again = replace_steps(config)
    run_calibration(again, tmp_path / "out", resume=True, jobs=1, watch=unwatched)  # from the checkpoint
    later = load_model(tmp_path / "out" / "model.yaml").spins
    assert later is not None
    assert later != spins


def fitted(folder: Path) -> tuple[str, ...]:
    return tuple(posed(folder).split.fit)


def replace_steps(config: CalibrationConfig) -> CalibrationConfig:
    return config.model_copy(update={"max_iterations": 2})


def test_a_drag_of_each_launcher_comes_back(tmp_path: Path) -> None:
    planted = {"back": 0.15, "top": 0.10}
    config = CalibrationConfig(groups="launcher", data=str(written(tmp_path, planted, 24)))
    run_calibration(config, tmp_path / "out", resume=False, jobs=1, watch=unwatched)
    model = load_model(tmp_path / "out" / "model.yaml")
    assert set(model.variations) == {"flight.drag.k"}
    values = model.variations["flight.drag.k"].values
    assert values == pytest.approx(planted, abs=0.012)
    # a track without the label has the drag of the group that the settings name
    track = shots(2, 1, planted)[0]
    settings = replace(dataset_settings(read_dataset(tmp_path / "data"), model), group="top")
    estimator = make_estimator("smoother", model, Surfaces.table_tennis(0.0), settings)
    drags = [
        dict(estimator.of(one).model.named_parameters())["flight.drag.k"].item()
        for one in (track, replace(track, labels={}))
    ]
    assert drags == [values["back"], values["top"]]


@pytest.mark.thorough
def test_groups_predict_measured_shots_better() -> None:
    folder = DATA / "ballgun"
    if not folder.is_dir():
        pytest.skip(f"measured tracks are absent: {folder}")
    halves = Halves.of(folder, 0, None)
    found = halves.judged(range(len(halves.train)))
    before, after = found[CALIBRATED], found[GROUPED]
    assert np.median(after[:, 0]) < 0.85 * np.median(before[:, 0])
    assert after[:, 2:].mean() > 80.0


def test_a_label_that_no_track_has_is_refused(folder: Path) -> None:
    with pytest.raises(ValueError, match=r"groups must be a label of .*has launcher; got 'player'.*labels\.csv"):
        posed(folder, groups="player")


def test_tracks_without_the_label_are_one_group_of_the_datasets_name(folder: Path) -> None:
    groups = posed(folder, groups="group").groups
    assert groups is not None
    assert groups.names == ("two",)
    assert set(groups.tracks.values()) == {"two"}
