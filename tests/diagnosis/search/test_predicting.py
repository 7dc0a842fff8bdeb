"""Coefficients fitted to predictions: against another solver, in a right world, and in one that lacks an effect."""

from __future__ import annotations

import copy

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.search.evaluation import errors_of
from ballfg.diagnosis.search.predicting import (
    best_predicting,
    fitted_to_predictions,
    forecasts,
    told_shifts,
)
from ballfg.dynamics import load_model
from ballfg.learning.calibration.coefficients import choose
from ballfg.simulation import SimulationConfig, parse_effects, write_simulation
from ballfg.tracks import read_dataset
from ballfg.tracks.noise import TrackNoise

NAMES = ("flight.drag.k", "bounce.restitution.e")


@pytest.fixture(scope="module")
def right(tmp_path_factory):
    """Twenty-four simulated tracks in halves, their own model, and the priors of the coefficients that are fitted."""
    folder = tmp_path_factory.mktemp("predicting") / "right"
    write_simulation(folder, SimulationConfig(tracks=24, seed=31))
    model = load_model(folder / "model.yaml")
    model.noise = TrackNoise(acceleration=0.05, coefficients=dict(zip(NAMES, (0.002, 0.004), strict=True)))
    return hold_out(read_dataset(folder), model), model, {n: declared_free(model)[n] for n in NAMES}


def off(model, **values):
    """The model with other values of some coefficients."""
    changed = copy.deepcopy(model)
    with torch.no_grad():
        for name, parameter in changed.named_parameters():
            if name in values:
                parameter.fill_(values[name])
    return changed


def value(model, name):
    return float(dict(model.named_parameters())[name].detach())


def test_wrong_coefficients_come_back(right):
    """Of a right model: nothing else explains where the balls go."""
    holdout, model, free = right
    k, e = (value(model, name) for name in NAMES)
    wrong = off(model, **{"flight.drag.k": 1.25 * k, "bounce.restitution.e": e - 0.03})
    fitted = fitted_to_predictions(wrong, free, holdout)
    assert value(fitted, "flight.drag.k") == pytest.approx(k, rel=0.04)
    assert value(fitted, "bounce.restitution.e") == pytest.approx(e, abs=0.004)
    assert value(wrong, "flight.drag.k") == pytest.approx(1.25 * k)  # the model that is given stays
    assert fitted.noise == model.noise


def test_the_same_coefficients_as_by_another_solver(right):
    """Trust region with differences at each point, by scipy, of the same errors and priors."""
    holdout, model, free = right
    wrong = off(model, **{"flight.drag.k": 1.25 * value(model, "flight.drag.k")})
    chosen = choose(wrong, NAMES)
    asked = forecasts(wrong, chosen, holdout, 1)
    weights = asked.weights(asked.own)
    np.testing.assert_array_equal(asked.errors([np.zeros(2)])[0], asked.own)

    def all_errors(away):
        return np.concatenate((weights * asked.errors([away])[0], away))

    other = least_squares(all_errors, np.zeros(2), diff_step=0.01, xtol=1e-4, ftol=1e-5).x
    fitted = fitted_to_predictions(wrong, free, holdout)
    away = [(value(fitted, n) - value(wrong, n)) / free[n].sigma for n in chosen.names]
    assert abs(away[0]) > 0.5
    np.testing.assert_allclose(away, other, atol=0.05)  # prior deviations


def test_a_right_model_predicts_as_before(right):
    holdout, model, free = right
    best = best_predicting(model, free, holdout)
    was, now = (errors_of(one, holdout, holdout.held_out_tracks, 1) for one in (model, best))
    assert now.log_likelihood > was.log_likelihood - 0.02
    assert now.prediction_rmse_mm < 1.03 * was.prediction_rmse_mm


def test_a_model_that_lacks_wind_predicts_other_tracks_better(tmp_path):
    """1.5 m/s along the shots, which drag can partly stand for; the judging tracks were not fitted to."""
    write_simulation(
        tmp_path / "windy", SimulationConfig(tracks=24, seed=32, undeclared=parse_effects(("wind.x=1.5",)))
    )
    still = load_model(tmp_path / "windy" / "model.yaml")
    still.noise = TrackNoise(acceleration=0.05, coefficients=dict(zip(NAMES, (0.002, 0.004), strict=True)))
    holdout = hold_out(read_dataset(tmp_path / "windy"), still)
    free = {name: declared_free(still)[name] for name in NAMES}
    best = best_predicting(still, free, holdout)
    was, now = (errors_of(one, holdout, holdout.held_out_tracks, 1) for one in (still, best))
    assert now.prediction_rmse_mm < 0.8 * was.prediction_rmse_mm
    assert now.log_likelihood > was.log_likelihood + 0.1
    sentence = told_shifts(best, still, free)
    assert sentence.startswith("Something is lacking still: ")
    assert f"drag.k {value(best, 'flight.drag.k'):.3g} for {value(still, 'flight.drag.k'):.3g} 1/m" in sentence
    assert told_shifts(still, still, free) == ""
