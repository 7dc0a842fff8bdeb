"""Designed shots against random ones, flown and fitted: what they bring, and how well that is foretold.

The launcher is learned from shots, and flights are planned with it, against the simulation's own launcher and motion.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from ballfg.arrays import Array
from ballfg.diagnosis import design_shots, hold_out
from ballfg.diagnosis.design.choice import combinations, parse_levels
from ballfg.diagnosis.design.goal import hypothesis_of, separating, shrinking
from ballfg.diagnosis.design.information import View, planned_flights
from ballfg.diagnosis.design.plan import ShotPlan, _launcher, learn_launcher
from ballfg.diagnosis.fit.fit import covariance_of, fit_problem
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.sensitivity import predict
from ballfg.diagnosis.search.evaluation import on_all
from ballfg.diagnosis.search.refits import with_hypothesis
from ballfg.diagnosis.search.stamp_effects import first_fit
from ballfg.dynamics import AnalyticModel, nominal_model
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate, table_tennis
from ballfg.simulation.settings import all_settings
from ballfg.tracks import Dataset, Track
from tests.diagnosis.design.shot_lists import dataset_of, shots

LEVELS = parse_levels("topspin=-3..5,sidespin=-5..5,speed=8..14")
GRID = combinations(LEVELS)
FEW, DESIGNED, RANDOM = 8, 10, 25
"""Tracks at first; shots chosen by design; as many random ones must not do better: a ratio of 0.4."""


def fitted(dataset: Dataset) -> Fit:
    model = nominal_model(dataset.ball)
    holdout = hold_out(dataset, model)
    return on_all(first_fit(model, holdout), holdout.held_out)


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


def test_a_track_that_begins_late_does_not_say_where_the_launcher_stands(tmp_path: Path) -> None:
    """A hit that cuts off the first eight samples must not move the launcher by the way that the ball flew in them."""
    rng = np.random.default_rng(8)
    tracks = shots(GRID[rng.integers(len(GRID), size=9)], 8)
    late = tracks[4].positions.copy()
    late[:8] += np.linspace(-8.0, 0.0, 8)[:, None] * (0.1, 0.05, 0.05)  # as if it came from elsewhere, to be hit
    dataset = dataset_of(tmp_path / "shots", [*tracks[:4], replace(tracks[4], positions=late), *tracks[5:]])
    model = nominal_model(dataset.ball)
    holdout = hold_out(dataset, model)
    fit = on_all(first_fit(model, holdout), holdout.held_out)
    begins = fit.unknowns.starts[fit.problem.stretches.names.index("004"), :3]
    assert np.linalg.norm(begins - tracks[4].positions[0]) > 0.1
    places = _launcher(fit, holdout.tracks, NAMES).states(GRID)[:, :3]
    np.testing.assert_allclose(places, np.broadcast_to(tracks[0].positions[0], places.shape), atol=0.03)


NAMES = ("topspin", "sidespin", "speed")
STEADY = {"position_spread": 0.0, "speed_spread": 0.0, "aim_spread": 0.0, "spin_spread": 0.0}


def test_the_simulated_launcher_is_learned_exactly() -> None:
    """Its speed, elevation and spin are lines in the settings; twelve shots tell all others."""
    launcher, settings = table_tennis().launcher.with_fields(STEADY), all_settings()
    states = launcher.launch(settings, 0.76, np.random.default_rng(0)).numpy()
    some = np.random.default_rng(1).integers(len(settings), size=12)
    learned = learn_launcher(NAMES, settings[some].astype(float), states[some])
    # axes of a launch fade out towards the vertical: 1.24 rad up is 1.1 m/s forward
    np.testing.assert_allclose(learned.states(settings.astype(float)), states, atol=0.6)
    np.testing.assert_allclose(learned.states(settings.astype(float))[:, :6], states[:, :6], atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        (np.ones((4, 2)), "at least 5 shots"),
        (np.column_stack((np.arange(9.0), np.ones(9))), "label b must change"),
        (np.column_stack((np.arange(9.0), 2 * np.arange(9.0))), "independently"),
    ],
)
def test_shots_that_do_not_tell_what_settings_do(settings: np.ndarray, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        learn_launcher(("a", "b"), settings, np.ones((len(settings), 9)))


def test_planned_flights_are_those_that_are_shot() -> None:
    kind = table_tennis()
    kind = replace(kind, launcher=kind.launcher.with_fields(STEADY))
    config = SimulationConfig(40, ball=kind, seed=4, noise=MeasurementNoise(position=0.0))
    simulated = list(simulate(config))
    starts = np.stack([s.true_states[0] for s in simulated])
    view = View(
        np.array((-0.4, -1.2, 0.76)), np.array((3.2, 1.2, np.inf)), 1.32, 0.01, np.full(3, 0.003), labelled=True
    )
    flights, kept = planned_flights(kind.model, starts, np.zeros((40, 0)), kind.surfaces, view)
    assert kept.all()
    for number, shot in enumerate(simulated):
        used = flights.used[number]
        positions = flights.positions[number][used].numpy()
        both = min(len(positions), len(shot.true_states))
        assert both > 0.9 * len(shot.true_states) or flights.contacts[number].isfinite().all()
        np.testing.assert_allclose(positions[:both], shot.true_states[:both, :3], atol=1e-5)
        bounces = (np.diff(shot.true_states[:both, 5]) > 0.5).sum()
        assert int(flights.contacts[number].isfinite().sum()) == bounces
    assert isinstance(flights.times, torch.Tensor)


@pytest.mark.parametrize(
    "effects",
    [
        ["frame_tilt.x=0.05", "frame_tilt.y=-0.1", "scale.y=0.1"],
        ["time_offset.x=0.004", "velocity_lag.lag=0.003"],
        ["time_scale.s=0.2", "spin_label_scale.s=0.5"],
    ],
)
def test_planned_flights_are_measured_as_those_that_are_shot(effects: list[str]) -> None:
    kind, measured = table_tennis(), parse_effects(effects)
    kind = replace(kind, launcher=kind.launcher.with_fields(STEADY))
    noise = MeasurementNoise(position=0.0, spin=0.0)
    simulated = list(simulate(SimulationConfig(20, ball=kind, seed=4, noise=noise, undeclared=measured)))
    starts = np.stack([s.true_states[0] for s in simulated])
    model = AnalyticModel([*kind.model.flight.values(), *kind.model.bounce.values(), *measured])
    interval = float(np.diff(simulated[0].track.times).mean())
    everywhere = np.full(3, -9.0), np.full(3, 9.0)
    view = View(*everywhere, 1.3, interval, np.full(3, 0.003), labelled=True)
    flights, kept = planned_flights(model, starts, np.zeros((20, 0)), kind.surfaces, view)
    assert kept.all()
    fitted = predict(model, flights, starts, {})
    for number, shot in enumerate(simulated):
        used = flights.used[number].numpy()
        count = min(used.sum(), len(shot.track))
        assert count > 50
        np.testing.assert_allclose(flights.positions[number][:count], shot.track.positions[:count], atol=2e-5)
        # the last sample may be read behind a contact that the stretch leaves out
        np.testing.assert_allclose(fitted.positions[number, : count - 1], shot.track.positions[: count - 1], atol=2e-5)
        np.testing.assert_allclose(flights.times[number][:count], shot.track.times[:count], atol=1e-9)
        np.testing.assert_allclose(flights.labels[number], shot.track.spin_label, atol=1e-9)
