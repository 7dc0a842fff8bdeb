"""Several datasets: what their balls have in common is a prior for the ball of another one."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
import pytest
from scipy.optimize import minimize

from ballfg.dynamics import AnalyticModel, load_model, nominal_model
from ballfg.estimation import Smoother, dataset_settings, dataset_surfaces
from ballfg.estimation.configure import fitted_settings
from ballfg.learning.calibration import sets
from ballfg.learning.calibration.coefficients import choose, values_of
from ballfg.learning.calibration.run import take_steps
from ballfg.learning.calibration.sets import Abroad, OneSet, calibrate_sets
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import checked_config
from ballfg.progress import unwatched
from ballfg.tracks import read_dataset, write_dataset
from tests.learning.conftest import PLANTED, simulated

DRAG = "flight.drag.k"
DRAGS = (0.15, 0.175, 0.165)  # 1/m, of the balls of three sets; the nominal one has 0.12
FEW: dict[str, Any] = {"max_iterations": 2, "jobs": 1}


def sets_of(means: np.ndarray, sigma: np.ndarray, spread: np.ndarray) -> list[OneSet]:
    """Calibrated sets with means (n, 1) of the drag, and its standard errors and spreads."""
    problem = SimpleNamespace(chosen=choose(nominal_model(), [DRAG]))
    steps = [
        SimpleNamespace(mean=tuple(m), sigma=tuple(s), spread=tuple(d))
        for m, s, d in zip(means, sigma, spread, strict=True)
    ]
    return [cast(OneSet, SimpleNamespace(problem=problem, last=step)) for step in steps]


def test_mean_and_spread_of_balls_come_back() -> None:
    rng = np.random.default_rng(44)
    sigma = rng.uniform(0.002, 0.01, (200, 1))
    balls = rng.normal(0.13, 0.02, (200, 1))
    found = Abroad.of(sets_of(balls + rng.normal(size=(200, 1)) * sigma, sigma, np.full((200, 1), 0.015)))
    (mean,), (error,), (spread,) = found.population.mean, found.population.sigma, found.population.spread
    assert abs(mean - 0.13) < 3.0 * error
    assert error == pytest.approx(0.021 / np.sqrt(200), rel=0.15)  # of balls and errors together
    assert spread == pytest.approx(0.02, rel=0.15)
    assert found.sigma[0] == pytest.approx(np.hypot(0.02, 0.015), rel=0.12)


@pytest.mark.parametrize("count", [1, 2, 4])
def test_few_balls_have_the_most_probable_mean_and_spread(count: int) -> None:
    """Against the density of all sets, written down again and maximised by another program."""
    means, sigma = np.array([0.09, 0.15, 0.11, 0.14])[:count, None], np.array([0.004, 0.01, 0.002, 0.03])[:count, None]
    prior = choose(nominal_model(), [DRAG])

    def cost(numbers: np.ndarray) -> float:
        mean, spread = numbers[0], np.exp(numbers[1])
        # the prior of each set's mean is taken out of what the set found
        own = sigma[:, 0] ** 2 / (1.0 - (sigma[:, 0] / prior.sigma[0]) ** 2)
        bare = own * (means[:, 0] / sigma[:, 0] ** 2 - prior.start[0] / prior.sigma[0] ** 2)
        variance = own + spread**2
        density = 0.5 * (np.log(variance) + (bare - mean) ** 2 / variance).sum()
        rayleigh = (spread / prior.sigma[0]) ** 2 / 2.0 - np.log(spread)
        return float(density + ((mean - prior.start[0]) / prior.sigma[0]) ** 2 / 2.0 + rayleigh)

    best = minimize(cost, [0.12, np.log(0.03)], method="Nelder-Mead", options={"xatol": 1e-10, "fatol": 1e-13})
    found = Abroad.of(sets_of(means, sigma, np.zeros((count, 1)))).population
    np.testing.assert_allclose([found.mean[0], found.spread[0]], [best.x[0], np.exp(best.x[1])], rtol=1e-4)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, ...]:
    """Of three balls, ten tracks each."""
    top, found = tmp_path_factory.mktemp("sets"), []
    for number, drag in enumerate(DRAGS):
        plain = simulated(top / f"plain_{number}", 10, drag=drag, seed=30 + number)
        dataset = read_dataset(plain)
        write_dataset(top / f"ball_{number}", replace(dataset.info, name=f"ball {number}"), dataset)
        found.append(top / f"ball_{number}")
    return tuple(found)


@pytest.fixture(scope="module")
def run(folders: tuple[Path, ...], tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, int]:
    """The folder of a calibration of the three, and its exit status."""
    out = tmp_path_factory.mktemp("run") / "out"
    config = CalibrationConfig(data=tuple(map(str, folders)), **FEW)
    return out, calibrate_sets(config, out, resume=False, jobs=1, watch=unwatched)


def test_a_run_writes_what_the_sets_have_in_common(run: tuple[Path, int]) -> None:
    out, status = run
    assert status == 0  # every set is predicted better by what the others say than by the nominal ball
    report = json.loads((out / "report.json").read_text())
    assert report["outcome"] == "better"
    row = report["coefficients"][DRAG]
    for number, drag in enumerate(DRAGS):
        one = row["sets"][f"ball {number}"]
        assert abs(one["mean"] - drag) < 3.0 * one["sigma"]
        judged = report["judged"][f"ball {number}"]
        assert judged["after"]["rmse_median"] < 0.8 * judged["before"]["rmse_median"]
    assert abs(row["after"] - np.mean(DRAGS)) < 2.0 * row["sigma"]
    assert row["spread_between_sets"] > np.std(DRAGS)  # three balls leave room for more
    assert row["next_track_sigma"] > np.hypot(row["sigma"], row["spread_between_sets"]) * (1.0 - 1e-9)
    model = load_model(out / "model.yaml")
    assert isinstance(model, AnalyticModel)
    assert values_of(model, [DRAG]).tolist() == [row["after"]]
    assert model.noise is not None
    assert model.noise.coefficients[DRAG] == row["next_track_sigma"]


def test_another_set_has_it_as_its_prior_and_noise_of_its_own(run: tuple[Path, int], few_tracks: Path) -> None:
    dataset, model = read_dataset(few_tracks), load_model(run[0] / "model.yaml")
    assert model.noise is not None
    settings = dataset_settings(dataset, model)
    assert dict(settings.coefficients) == dict(model.noise.coefficients)
    shown = fitted_settings(dataset, model)
    assert shown.process != settings.process  # of its tracks, which the model says nothing of
    estimate = Smoother(model, dataset_surfaces(dataset), shown).estimate(dataset.track("000"))
    k = estimate.coefficient_names.index(DRAG)
    assert abs(estimate.coefficients[k] - PLANTED[DRAG]) < 3.0 * np.sqrt(estimate.coefficient_covariance[k, k])


def test_a_run_that_stopped_continues_to_the_same_bytes(
    run: tuple[Path, int], folders: tuple[Path, ...], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Any
) -> None:
    config, out = CalibrationConfig(data=tuple(map(str, folders)), **FEW), tmp_path / "out"

    def stopped(problem: Any, *others: Any) -> None:
        if problem.dataset.info.name == "ball 1":
            raise KeyboardInterrupt
        take_steps(problem, *others)

    monkeypatch.setattr(sets, "take_steps", stopped)
    with pytest.raises(KeyboardInterrupt):
        calibrate_sets(config, out, resume=False, jobs=1, watch=unwatched)
    assert f"continue with --resume {out}" in capsys.readouterr().err
    assert not (out / "model.yaml").exists()
    monkeypatch.undo()
    assert calibrate_sets(config, out, resume=True, jobs=1, watch=unwatched) == 0
    for name in ("model.yaml", "report.json"):
        assert (out / name).read_bytes() == (run[0] / name).read_bytes()


def test_what_does_not_go_together_is_refused(folders: tuple[Path, ...], tmp_path: Path) -> None:
    first, second = map(str, folders[:2])
    for fields in ({"kind": "auto"}, {"groups": "group", "correction": True}):
        with pytest.raises(ValueError, match=r"belong to one room and ball; got several datasets\. Give one"):
            checked_config({"kind": "calibrate", "data": [first, second], **fields}, "here")
    assert checked_config({"kind": "auto", "data": [first]}, "here").data == first
    info = read_dataset(first).info
    larger = replace(info, name="larger", ball=replace(info.ball, radius=0.03))
    write_dataset(tmp_path / "larger", larger, read_dataset(first))
    write_dataset(tmp_path / "renamed", replace(info, name="renamed"), read_dataset(first))
    for data, message in (
        ((first, str(tmp_path / "renamed")), r"each track once; got track '.*' of .*renamed also as"),
        ((first, first), "names that differ; got ball 0, ball 0"),
        ((first, str(tmp_path / "larger")), r"one kind of ball; got radii \[0.02, 0.03\]"),
    ):
        with pytest.raises(ValueError, match=message):
            calibrate_sets(CalibrationConfig(data=data), tmp_path / "out", resume=False, jobs=1, watch=unwatched)
    assert not (tmp_path / "out").exists()
