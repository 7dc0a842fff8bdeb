"""Means that predict: against another solver and predictions, in a right world and where an effect is lacking."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy.optimize import least_squares

from ballfg.dynamics import load_model
from ballfg.estimation import Settings, predict_tracks
from ballfg.estimation.noise.estimate import NoiseEstimate
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.calibrate import about_population, calibrate, pose_correction
from ballfg.learning.calibration.forecasts import FAR
from ballfg.learning.calibration.predicting import (
    PRECISIONS,
    Finished,
    Numbers,
    Predicted,
    best_predicting,
    finished,
    predicted,
)
from ballfg.learning.calibration.problem import Problem, Step, population_model, population_settings, pose, score
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.split import tracks_of
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset, write_dataset
from tests.learning.calibration.test_correction import SLOPE, posed

NAMES = ("flight.drag.k", "bounce.restitution.e")
Calibrated = tuple[Problem, Step]


def simulated(folder: Path, seed: int, *effects: str) -> Calibrated:
    """A world without spin labels, calibrated."""
    write_simulation(folder / "labelled", SimulationConfig(tracks=48, seed=seed, undeclared=parse_effects(effects)))
    dataset, model = read_dataset(folder / "labelled"), load_model(folder / "labelled" / "model.yaml")
    write_dataset(folder / "data", dataset.info, [replace(track, labels={}) for track in dataset])
    problem = pose(read_dataset(folder / "data"), model, CalibrationConfig(coefficients=NAMES, groups="group"))
    *_, last = calibrate(problem)
    return problem, last


def log_scores(problem: Problem, step: Step, noise: NoiseEstimate | None) -> np.ndarray:
    """Of the judging tracks, by the population of a step."""
    assert noise is not None
    settings = about_population(noise, population_settings(problem, step)).settings
    return np.array([one.log_score for one in score(problem, population_model(problem, step), settings) if one])


@pytest.fixture(scope="module")
def windy(tmp_path_factory: pytest.TempPathFactory) -> Calibrated:
    """A head wind of 1.5 m/s, which drag, restitution and spins stand for as well as they can."""
    return simulated(tmp_path_factory.mktemp("windy"), 32, "wind.x=-1.5")


@pytest.fixture(scope="module")
def ended(windy: Calibrated) -> Finished:
    return finished(*windy, errors=False)


@pytest.fixture(scope="module")
def settings(windy: Calibrated, ended: Finished) -> Settings:
    """Of the calibration as it is most probable, with the noise that its tracks show."""
    assert ended.noise is not None
    return about_population(ended.noise, population_settings(*windy)).settings


@pytest.fixture(scope="module")
def made(windy: Calibrated, settings: Settings) -> Predicted:
    return predicted(*windy, settings)


def test_a_model_that_lacks_wind_predicts_other_tracks_better(windy: Calibrated, ended: Finished) -> None:
    problem, last = windy
    assert ended.step.predicting is not None
    assert ended.step.predicting > 0.005
    was, now = (log_scores(problem, step, ended.noise) for step in (last, ended.step))
    assert (now - was).mean() > 0.02
    assert np.all(np.array(ended.step.sigma) > np.array(last.sigma))  # the scatter shows more doubt


def test_a_right_model_predicts_as_before(tmp_path: Path) -> None:
    problem, last = simulated(tmp_path, 31)
    found = finished(problem, last, errors=False)
    moved = np.subtract(found.step.spins[0].mean, last.spins[0].mean)
    assert np.all(np.abs(moved) < 3.0 * np.array(found.step.spins[0].sigma))
    assert np.all(np.abs(np.subtract(found.step.mean, last.mean)) < 3.0 * np.array(found.step.sigma))
    was, now = (log_scores(problem, step, found.noise) for step in (last, found.step))
    assert (now - was).mean() > -0.01


def test_three_tracks_choose_nothing(windy: Calibrated) -> None:
    problem, last = windy
    few = replace(problem, split=replace(problem.split, fit=problem.split.fit[:3]))
    assert finished(few, last, errors=False).step is last


def test_without_predictions_the_means_stay(windy: Calibrated, settings: Settings) -> None:
    problem, last = windy
    none = predicted(replace(problem, split=replace(problem.split, fit=())), last, settings)
    assert none.slopes.shape == (0, 5)
    assert best_predicting(last, none) is last


def test_slopes_are_those_of_the_predictions(windy: Calibrated, settings: Settings, made: Predicted) -> None:
    """Of all numbers moved together, by predictions of the moved model itself."""
    problem, _ = windy
    numbers, away = made.numbers, np.array([0.5, -0.5, 0.4, -0.4, 0.3])
    step, groups = numbers.moved(numbers.last, away), problem.groups
    assert groups is not None
    moved = groups.settings(settings, groups.population(step.spins))
    smoothers = (
        make_estimator("smoother", population_model(problem, one), problem.surfaces, given)
        for one, given in ((numbers.last, settings), (step, moved))
    )
    tracks = list(tracks_of(problem.dataset, made.tracks[:18]))
    true, linear, share = list[np.ndarray](), list[np.ndarray](), problem.config.observed_share
    was, now = (
        list(
            predict_tracks(smoother, tracks, len(tracks), lambda track: share * track.duration, horizon=problem.horizon)
        )
        for smoother in smoothers
    )
    for before, after in zip(was, now, strict=True):
        k = [number for number, name in enumerate(made.tracks) if name == before.name][1]  # from the share itself
        part = slice(made.ends[k], made.ends[k + 1])
        whitened = [((one.positions - one.measured) / before.sigmas).ravel() for one in (before, after)]
        np.testing.assert_allclose(made.errors[part], whitened[0], atol=1e-9)
        true.append(whitened[1] - whitened[0])
        linear.append(made.slopes[part] @ away)
    size = np.linalg.norm(np.concatenate(true))
    assert np.linalg.norm(np.concatenate(true) - np.concatenate(linear)) < 0.05 * size
    assert size > 0.1


def test_the_fit_is_that_of_another_solver(made: Predicted) -> None:
    """The trust region of scipy, with Huber's loss of each prediction as a whole, beside the same prior."""
    precision, about = 0.1, np.linspace(-0.2, 0.2, made.numbers.size)
    kept = np.ones(len(made.tracks), dtype=bool)
    kept[::5] = False

    def all_errors(away: np.ndarray) -> np.ndarray:
        found = [np.sqrt(made.numbers.prior(precision)) * (away - about)]
        for here, a, b in zip(kept, made.ends[:-1], made.ends[1:], strict=True):
            if here:
                errors = made.errors[a:b] + made.slopes[a:b] @ away
                miss = np.sqrt(np.mean(errors**2))
                loss = miss**2 if miss < FAR else 2.0 * FAR * miss - FAR**2
                found.append(np.sqrt(3.0 / made.shares * loss)[None])
        return np.concatenate(found)

    other = least_squares(all_errors, about, x_scale="jac", ftol=1e-12, xtol=1e-12).x
    np.testing.assert_allclose(made.fitted(precision, about, kept), other, atol=0.02 * np.abs(other - about).max())
    np.testing.assert_array_equal(made.fitted(np.inf, about, kept), about)


def test_what_the_model_states_holds_whatever_share_of_the_likelihood_counts(
    windy: Calibrated, made: Predicted
) -> None:
    """The precision about the posterior's mean is that of the stated prior and of some share of all tracks together."""
    problem, last = windy
    known = problem.model.declared_coefficients()
    stated = 1.0 / np.square([known[name].sigma for name in problem.chosen.names])
    every = 1.0 / np.square(last.sigma)
    for share in (1.0, 0.1, 0.0):
        own = made.numbers.prior(share)[: len(stated)] / np.square(last.sigma)
        np.testing.assert_allclose(own, stated + share * (every - stated))


def test_the_covariance_is_that_of_tracks_left_out(made: Predicted) -> None:
    """The jackknife: numbers fitted without each track; one of the prior's mean besides."""
    precision, about = 0.1, np.zeros(made.numbers.size)
    kept = np.ones(len(made.tracks), dtype=bool)
    away = made.fitted(precision, about, kept)
    covariance = made.covariance(precision, away, kept)
    names = sorted(set(made.tracks))
    without = [made.fitted(precision, about, kept & (np.array(made.tracks) != name)) for name in names]
    jackknife = (len(names) - 1) / len(names) * sum(np.outer(w - away, w - away) for w in without)
    own = np.diag(made.numbers.prior(precision))
    inverse = np.linalg.inv(made.weighed(away, kept)[:, :-1, :-1].sum(axis=0) + own)
    prior = inverse @ own**2 @ inverse
    ratio = np.diag(covariance - prior) / np.diag(jackknife)
    assert np.all((ratio > 0.5) & (ratio < 1.6)), ratio


def test_numbers_move_a_step_and_are_read_from_it(tmp_path: Path) -> None:
    """Of coefficients, spins and a correction, with bounds."""
    problem = posed(tmp_path, SLOPE, 12)
    *_, last = calibrate(problem)
    corrected = pose_correction(problem, last)
    *_, end = calibrate(corrected)
    numbers = Numbers(corrected, end)
    assert numbers.size == 1 + 3 + 4
    away = np.array([0.3, 1.0, -2.0, 0.5, 0.2, -0.7, 1.5, -0.1])
    moved = numbers.moved(end, away)
    np.testing.assert_allclose(numbers.between(moved), away, atol=1e-6)
    assert moved.sigma == pytest.approx(end.sigma)
    spin = moved.spins[0]
    np.testing.assert_allclose(
        np.subtract(spin.mean, end.spins[0].mean), np.array([1.0, -2.0, 0.5]) * end.spins[0].sigma, rtol=1e-9
    )
    np.testing.assert_array_equal(moved.doubts, end.doubts)
    wider = numbers.moved(end, np.zeros(8), np.array([2.0, 3.0, 1.0, 1.0, 4.0, 1.0, 1.0, 5.0]))
    assert wider.sigma[0] == pytest.approx(2.0 * end.sigma[0])
    assert wider.spins[0].sigma == pytest.approx(np.array([3.0, 1.0, 1.0]) * end.spins[0].sigma)
    scale = np.array([4.0, 1.0, 1.0, 5.0, *np.ones(7)])[:, None]
    np.testing.assert_allclose(wider.doubts, scale * np.array(end.doubts))
    far = numbers.moved(end, np.concatenate(([1e6], np.zeros(7))))
    assert far.mean[0] == corrected.chosen.high[0]
    low, high = numbers.bounds()
    assert low[0] < 0.0 < high[0]
    assert np.isinf(high[1:]).all()


def test_the_prior_is_chosen_from_the_most_probable_numbers_to_next_to_none() -> None:
    assert PRECISIONS[0] == np.inf
    assert list(PRECISIONS) == sorted(PRECISIONS, reverse=True)


def test_left_out_tracks_have_no_part(made: Predicted) -> None:
    out = tuple(dict.fromkeys(made.tracks))[::5]
    spoilt = made.errors.copy()
    for name, a, b in zip(made.tracks, made.ends[:-1], made.ends[1:], strict=True):
        spoilt[a:b] *= 30.0 if name in out else 1.0
    last = made.numbers.last
    one, other = best_predicting(last, made, out), best_predicting(last, replace(made, errors=spoilt), out)
    assert one == other
    assert one != best_predicting(last, made)
