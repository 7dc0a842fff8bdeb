"""Designed shots against random ones, flown and fitted: what they bring, and how well that is foretold."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.arrays import Array
from ballfg.diagnosis import design_shots, hold_out
from ballfg.diagnosis.design.choice import combinations, parse_levels
from ballfg.diagnosis.design.goal import hypothesis_of, separating, shrinking
from ballfg.diagnosis.design.plan import ShotPlan, _fit_of_all
from ballfg.diagnosis.fit.fit import covariance_of, fit_problem
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.search.refits import with_hypothesis
from ballfg.dynamics import nominal_model
from ballfg.simulation import parse_effects
from ballfg.tracks import Dataset, Track
from tests.diagnosis.design.shot_lists import dataset_of, shots

LEVELS = parse_levels("topspin=-3..5,sidespin=-5..5,speed=8..14")
GRID = combinations(LEVELS)
FEW, DESIGNED, RANDOM = 8, 10, 25
"""Tracks at first; shots chosen by design; as many random ones must not do better: a ratio of 0.4."""


def fitted(dataset: Dataset) -> Fit:
    model = nominal_model(dataset.ball)
    return _fit_of_all(model, hold_out(dataset, model))


def error_bars(dataset: Dataset, pair: tuple[str, str]) -> Array:
    """(p,) standard deviations of the strengths of both effects, each beside the other, after a fit of all tracks."""
    fit = fitted(dataset)
    goal, problem = separating(fit, [pair]), fit.problem
    for hypothesis in goal.hypotheses:
        problem = with_hypothesis(problem, hypothesis)
    values = problem.declared | fit.unknowns.values
    unknowns = replace(fit.unknowns, values={name: values[name] for name in problem.free})
    both = fit_problem(problem, unknowns, fit.noise, settle_noise=False)
    return np.sqrt(np.diagonal(covariance_of(both, goal.names)))


@pytest.fixture(scope="module")
def campaign(tmp_path_factory: pytest.TempPathFactory) -> tuple[ShotPlan, Array, Array]:
    """The plan of ten shots after eight, and the error bars with these ten and with 25 random ones in their place."""
    pair = "wind.x", "drag.k"
    folder, effects, rng = tmp_path_factory.mktemp("design"), parse_effects(["wind.x=0.1"]), np.random.default_rng(21)
    begun = shots(GRID[rng.integers(len(GRID), size=FEW)], 21, effects)
    dataset = dataset_of(folder / "begun", begun)
    plan = design_shots(dataset, nominal_model(dataset.ball), LEVELS, between=[pair], shots=DESIGNED)

    def with_more(name: str, more: list[Track]) -> Array:
        return error_bars(dataset_of(folder / name, begun + more), pair)

    designed = with_more("designed", shots(plan.settings, 22, effects))
    random = with_more("random", shots(GRID[rng.integers(len(GRID), size=RANDOM)], 23, effects))
    return plan, designed, random


def test_designed_shots_bring_as_much_as_two_and_a_half_times_as_many(campaign: tuple[ShotPlan, Array, Array]) -> None:
    plan, designed, random = campaign
    assert plan.as_random > DESIGNED / 0.4
    assert np.log(designed).mean() < np.log(random).mean()


def test_error_bars_come_out_as_foretold(campaign: tuple[ShotPlan, Array, Array]) -> None:
    plan, designed, _ = campaign
    np.testing.assert_allclose(designed, plan.sigmas[-1], rtol=0.25)


def test_a_coefficient_shrinks(tmp_path: Path) -> None:
    rng = np.random.default_rng(5)
    dataset = dataset_of(tmp_path / "shots", shots(GRID[rng.integers(len(GRID), size=8)], 5))
    model = nominal_model(dataset.ball)
    plan = design_shots(dataset, model, LEVELS, shrink="drag.k", shots=3)
    fit = fitted(dataset)
    assert plan.names == ("drag.k",)
    assert plan.units == ("1/m",)
    now = float(np.sqrt(covariance_of(fit, ["flight.drag.k"])[0, 0]))
    assert plan.sigmas[0, 0] == pytest.approx(now, rel=1e-9)  # what the fit itself says of its tracks
    assert plan.sigmas[-1, 0] < 0.8 * now
    assert shrinking(fit, "wind").sides == (("flight.wind.x", "flight.wind.y", "flight.wind.z"),)
    for text, message in (
        ("wnd", "effect 'wnd' is not known. Did you mean 'wind'"),
        ("wind.w", "has the strengths x, y, z; got 'w'"),
        ("rolling", "not known"),
    ):
        with pytest.raises(ValueError, match=message):
            hypothesis_of(fit, text)
    with pytest.raises(ValueError, match=r"two different effects; got wind,wind\.x"):
        separating(fit, [("wind", "wind.x")])
    with pytest.raises(ValueError, match="either between or shrink"):
        design_shots(dataset, model, LEVELS)


def test_shots_will_lose_as_many_frames_as_the_tracks_did(tmp_path: Path) -> None:
    """Information is that of the samples: with 55 % of them an error bar of many shots is 1 / sqrt(0.55) as large."""
    rng, share, sigmas = np.random.default_rng(6), 0.55, []
    tracks = shots(GRID[rng.integers(len(GRID), size=8)], 6)
    kept = [np.append(True, rng.random(len(track) - 1) < share) for track in tracks]
    fewer = [replace(t, times=t.times[k], positions=t.positions[k]) for t, k in zip(tracks, kept, strict=True)]
    for name, seen in (("all", tracks), ("fewer", fewer)):
        dataset = dataset_of(tmp_path / name, seen)
        levels = parse_levels("topspin=0,sidespin=-2..2:2,speed=10")
        plan = design_shots(dataset, nominal_model(dataset.ball), levels, shrink="restitution.e", shots=200)
        sigmas.append(plan.sigmas[-1, 0])
    assert sigmas[1] / sigmas[0] == pytest.approx(1 / np.sqrt(share), rel=0.08)
