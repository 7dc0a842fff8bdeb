"""Factors and observations of a user's own: estimates as with those of the package, and unknowns of an instrument."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest

from ballfg.arrays import Array, Index
from ballfg.dynamics import nominal_model
from ballfg.estimation import ExtendedKalmanFilter, Online, RadarSpeed, Settings, Smoother
from ballfg.estimation.observations.observation import Context, Unknowns
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Values
from ballfg.factors.check import check_factor
from ballfg.factors.loss import Loss
from ballfg.state import STATE_DIM, VELOCITY
from ballfg.tracks import Track
from tests.estimation.observations.flights import (
    NOWHERE,
    PLAIN,
    SPEED_SIGMA,
    dense,
    flight,
    gravity_model,
    with_speeds,
    without,
)

METHODS = (Smoother, Online, ExtendedKalmanFilter)
BIAS, BIAS_SIGMA = 0.4, 1.0
"""m/s, of a radar."""


class SpeedFactors(FactorBatch):
    """r = (|v_i| - s_i) / sigma_i, as docs/custom_factors.md has them."""

    row_arrays = ("variables", "measured", "sigma")

    def __init__(self, states: Sequence[int] | Index, measured: Array, sigma: float) -> None:
        super().__init__(np.asarray(states)[:, None], dim=1)
        self.measured, self.sigma = measured, np.full(len(measured), sigma)

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        velocity = inputs[0][:, VELOCITY]
        speed = np.linalg.norm(velocity, axis=-1)
        sigma = self.sigma[rows]
        jacobian = np.zeros((len(speed), 1, STATE_DIM))
        jacobian[:, 0, VELOCITY] = velocity / (speed * sigma)[:, None]
        return ((speed - self.measured[rows]) / sigma)[:, None], (jacobian,)


class BiasedFactors(SpeedFactors):
    """r = (|v_i| + b - s_i) / sigma_i, the bias b one of the coefficients of the track."""

    def __init__(self, states: Index, measured: Array, sigma: float, column: int) -> None:
        super().__init__(states, measured, sigma)
        self.variables = np.column_stack((self.variables[:, 0], np.full(len(states), COEFFICIENTS)))
        self.column = column

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        residual, (jacobian,) = super().compute(rows, inputs[:1])
        sigma = self.sigma[rows]
        slope = np.zeros((len(sigma), 1, inputs[1].shape[1]))
        slope[:, 0, self.column] = 1 / sigma
        return residual + (inputs[1][:, self.column] / sigma)[:, None], (jacobian, slope)


class BiasedRadar(RadarSpeed):
    """A radar that reads too much by an unknown speed, the same for the whole track."""

    loss: ClassVar[Loss] = Loss()

    def batch(self, context: Context) -> BiasedFactors:
        column = context.columns["radar_bias"]
        return BiasedFactors(self.state, self.values[:, 0], SPEED_SIGMA, column)

    def unknowns(self, settings: Settings) -> Unknowns:
        return Unknowns(("radar_bias",), np.zeros(1), np.array([BIAS_SIGMA]), np.zeros(1))


def biased(seed: int, samples: int = 20) -> Track:
    track = with_speeds(seed, bias=BIAS, samples=samples)
    (speeds,) = track.observations
    return without(track).observed(BiasedRadar(speeds.state, speeds.values, SPEED_SIGMA))


# --- factors


@pytest.mark.parametrize("sort", METHODS)
def test_given_factors_are_the_observation(sort: type) -> None:
    track = with_speeds(1, every=2)
    (speeds,) = track.observations
    estimator = sort(gravity_model(), NOWHERE, PLAIN)
    expected = estimator.estimate(track)
    found = estimator.estimate(without(track), factors=[SpeedFactors(speeds.state, speeds.values[:, 0], SPEED_SIGMA)])
    assert np.abs((found.states - expected.states) / expected.sigmas).max() < 1e-6
    np.testing.assert_allclose(found.covariances, expected.covariances, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.innovations["SpeedFactors 0"], expected.innovations["speed"], atol=1e-5)


def test_given_factors_follow_a_part_of_the_track() -> None:
    """A track with factors keeps those of the samples that stay."""
    track = with_speeds(1)
    (speeds,) = track.observations
    estimator = Smoother(gravity_model(), NOWHERE, PLAIN)
    given = estimator.prepared(without(track), [SpeedFactors(speeds.state, speeds.values[:, 0], SPEED_SIGMA)])
    start = float(track.times[6])
    found, expected = (estimator.estimate(t.between(start, np.inf)) for t in (given, track))
    assert np.abs((found.states - expected.states) / expected.sigmas).max() < 1e-6


@pytest.mark.parametrize("sort", METHODS)
def test_a_factor_on_two_states_is_refused(sort: type) -> None:
    track, _, _ = flight(0)
    factors = SpeedFactors([0], np.array([5.0]), SPEED_SIGMA)
    factors.variables = np.array([[0, 1]])
    with pytest.raises(ValueError, match=r"factors must be on one state each.*SpeedFactors ties other variables"):
        sort(gravity_model(), NOWHERE, PLAIN).estimate(track, factors=[factors])


# --- unknowns


def test_jacobians_of_the_biased_radar() -> None:
    _, truth, _ = flight(0, 3)
    factors = BiasedFactors(np.array([0, 2]), np.array([5.0, 6.0]), 0.1, 1)
    check_factor(factors, Values(truth, np.array([0.1, 0.3, -0.2])))


@pytest.mark.parametrize("seed", range(3))
def test_an_unknown_bias_is_estimated(seed: int) -> None:
    """As dense least squares with a column for it; radar and positions together tell it to 0.1 m/s."""
    track = biased(seed, 30)
    estimate = Smoother(gravity_model(), NOWHERE, PLAIN).estimate(track)
    states, covariances, (bias, spread) = dense(track, BIAS_SIGMA)
    sigma = np.sqrt(np.diagonal(covariances, axis1=1, axis2=2))
    assert estimate.unknown_names == ("radar_bias",)
    assert estimate.coefficient_names == ()
    assert abs(estimate.unknowns[0] - bias) < 1e-4 * spread
    np.testing.assert_allclose(np.sqrt(estimate.unknown_covariance), [[spread]], rtol=1e-5)
    assert np.abs((estimate.states - states) / sigma).max() < 1e-4
    assert spread < 0.1
    assert abs(bias - BIAS) < 3 * spread
    assert np.isfinite(estimate.innovations["speed"]).all()


def test_unknowns_stand_beside_coefficients_of_the_ball() -> None:
    settings = replace(PLAIN, coefficients={"flight.gravity.g": 0.5})
    model = gravity_model()
    plain = Smoother(model, NOWHERE, settings).estimate(biased(0, 30))
    assert plain.coefficient_names == ("flight.gravity.g",)
    assert plain.unknown_names == ("radar_bias",)
    assert abs(plain.unknowns[0] - BIAS) < 3 * float(np.sqrt(plain.unknown_covariance[0, 0]))
    assert abs(plain.coefficients[0] - 9.81) < 3 * float(np.sqrt(plain.coefficient_covariance[0, 0]))


@pytest.mark.parametrize("sort", [Online, ExtendedKalmanFilter])
def test_estimators_without_unknowns_say_so(sort: type) -> None:
    message = f"observations of the estimator '{sort.name}' must have no unknowns; 'speed' has radar_bias. Use the smoo"
    with pytest.raises(ValueError, match=message):
        sort(nominal_model(), NOWHERE, PLAIN).estimate(biased(0))
