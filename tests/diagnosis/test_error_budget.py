"""Budgets of prediction errors: parts of simulated tracks against their measured errors, and what is told of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.budget import EXPECTED, PARTS, RECORDED, ErrorBudget
from ballfg.diagnosis.error_budget import expected_squares
from ballfg.diagnosis.search.evaluation import prediction_errors
from ballfg.estimation.noise.sources import SOURCES
from ballfg.estimation.settings import Settings
from ballfg.factors.noise import ProcessNoise
from tests.diagnosis.search.test_evaluation import evaluated

QUIET = ProcessNoise(acceleration=1e-3, spin=0.05, contact_velocity=1e-3, contact_spin=0.1)


@pytest.fixture(scope="module")
def flown(make_ball, make_launches, make_shots):
    """24 flights without random motion, 3 mm of noise, labels that err by 4 rad/s."""
    return evaluated(make_shots(make_ball(), make_launches(24, 54), 54, duration=0.5).stretches)


SETTINGS = Settings(position_noise=(0.003,) * 3, spin_label_noise=4.0, process=QUIET)


def test_flights_of_an_exact_model_err_as_expected(flown, make_ball, surfaces):
    """24 tracks of some three directions each: chance moves the squares by a quarter."""
    expected, tracks = expected_squares(make_ball(), flown, surfaces, SETTINGS)
    assert tracks == len(flown)
    errors = prediction_errors(make_ball(), flown, surfaces, SETTINGS)
    assert sum(expected.values()) == pytest.approx(errors.prediction_rmse_mm**2, rel=0.35)
    budget = ErrorBudget.of(expected, tracks, errors.prediction_rmse_mm, errors.prediction_rmse_mm)
    assert budget.exact == pytest.approx(budget.floor, rel=0.02)
    assert budget.samples == pytest.approx(3.0 * 3.0**0.5, rel=1e-12)
    assert (budget.tracker, budget.coefficients) == (0.0, 0.0)


def test_a_wrong_model_has_the_same_floor_and_much_left(flown, make_ball, surfaces):
    right, wrong = make_ball(), make_ball(drag={"k": 0.3})
    budgets = []
    for model in (right, wrong):
        expected, tracks = expected_squares(model, flown, surfaces, replace(SETTINGS, process=ProcessNoise()))
        error = prediction_errors(model, flown, surfaces, SETTINGS).prediction_rmse_mm
        budgets.append(ErrorBudget.of(expected, tracks, error, error))
    assert budgets[1].floor == pytest.approx(budgets[0].floor, rel=0.1)
    assert budgets[1].left > budgets[1].floor > abs(budgets[0].left)


def test_a_track_whose_observed_samples_are_outliers_does_not_count(flown, make_ball, surfaces):
    """Stamps of one track that count frames, of which every fifth was lost: its motion jumps all the time."""
    right, _ = expected_squares(make_ball(), flown, surfaces, SETTINGS)
    track, kept = flown[0].track, np.arange(len(flown[0].track)) % 5 != 4
    counted = replace(track, times=track.times[: kept.sum()], positions=track.positions[kept])
    others = [replace(flown[0], track=counted), *flown[1:]]
    expected, tracks = expected_squares(make_ball(), others, surfaces, SETTINGS)
    assert tracks == len(flown) - 1
    assert sum(expected.values()) == pytest.approx(sum(right.values()), rel=0.1)


def test_without_a_flight_nothing_is_expected(make_ball, surfaces):
    assert expected_squares(make_ball(), [], surfaces, SETTINGS) is None


def made(before: float = 9.0, after: float = 7.0) -> ErrorBudget:
    """A budget with a floor of 6 mm."""
    return ErrorBudget.of(dict(zip(EXPECTED, (16.0, 4.0, 1.0, 2.0, 9.0, 3.0, 1.0), strict=True)), 20, before, after)


def test_squares_add_up() -> None:
    assert EXPECTED == SOURCES
    budget = made()
    assert (budget.observed, budget.floor, budget.measured, budget.total) == pytest.approx((4.0, 6.0, 7.0, 9.0))
    assert budget.exact**2 == pytest.approx(23.0)
    assert set(RECORDED) < set(EXPECTED)
    assert (budget.left**2, budget.named**2) == pytest.approx((13.0, 32.0))
    assert sum(budget.squares.values()) == pytest.approx(81.0, rel=1e-12)


def test_errors_below_the_floor_and_harmful_effects_are_negative() -> None:
    budget = made(before=4.0, after=5.0)
    assert (budget.named, budget.left) == pytest.approx((-3.0, -(11.0**0.5)))
    assert (budget.floor, budget.measured, budget.total) == pytest.approx((6.0, 5.0, 4.0))


def test_a_budget_prints_as_a_table() -> None:
    lines = repr(made()).splitlines()
    assert [line[:46].strip() for line in lines[1:10]] == list(PARTS.values())
    assert lines[1].split()[-1] == "4.00"
    assert lines[-2].startswith("floor: all but the last two")
    assert lines[-2].endswith("6.00")
    assert made().sentence == (
        "Predictions are off by 7.0 mm, 1.17 times the floor of 6.0 mm that the model with its noise expects. "
        "44 % of the floor's square is noise of the observed part."
    )
