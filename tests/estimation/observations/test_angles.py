"""Angles that wrap, against the same angles read in a frame in which they do not."""

from typing import ClassVar

import numpy as np
import pytest
import torch
from torch import Tensor

from ballfg.estimation import ExtendedKalmanFilter, Online, Reading, Smoother
from ballfg.factors.loss import Loss
from tests.estimation.observations.flights import NOWHERE, PLAIN, flight, gravity_model

SIGMA = 0.02  # rad
EYE = np.array([8.0, -0.4])  # m, x and y of a theodolite behind the flight, which crosses its line y = -0.4 m


class Azimuth(Reading):
    """About the z axis, from +x, -pi to pi."""

    name = "azimuth"
    columns = ("azimuth",)
    periods: ClassVar = {"azimuth": 2 * np.pi}
    loss: ClassVar[Loss] = Loss()

    def predicted(self, state: Tensor) -> Tensor:
        away = state[..., :2] - torch.from_numpy(EYE)
        return torch.atan2(away[..., 1:], away[..., :1])


class TurnedAzimuth(Azimuth):
    """The same from -x, where the ball is: it never wraps."""

    periods: ClassVar = {}

    def predicted(self, state: Tensor) -> Tensor:
        away = torch.from_numpy(EYE) - state[..., :2]
        return torch.atan2(away[..., 1:], away[..., :1])


@pytest.mark.parametrize("sort", [Smoother, Online, ExtendedKalmanFilter])
def test_an_angle_that_wraps_is_the_angle_in_a_turned_frame(sort: type) -> None:
    track, truth, rng = flight(3, samples=80)
    away = EYE - truth[:, :2]
    turned = np.arctan2(away[:, 1], away[:, 0]) + SIGMA * rng.standard_normal(len(track))
    wrapped = (turned + 2 * np.pi) % (2 * np.pi) - np.pi
    exact = np.arctan2(*-away.T[::-1])
    assert (np.abs(wrapped - exact) > 6.0).sum() > 1  # noise takes readings across the cut
    estimator, rows = sort(gravity_model(), NOWHERE, PLAIN), np.arange(len(track))
    found = estimator.estimate(track.observed(Azimuth(rows, wrapped, SIGMA)))
    expected = estimator.estimate(track.observed(TurnedAzimuth(rows, turned, SIGMA)))
    assert np.abs((found.states - expected.states) / expected.sigmas).max() < 1e-6
    np.testing.assert_allclose(found.covariances, expected.covariances, rtol=1e-6, atol=1e-12)
    np.testing.assert_allclose(found.innovations["azimuth"], expected.innovations["azimuth"], atol=1e-5)


@pytest.mark.parametrize("periods", [{"bearing": 6.28}, {"azimuth": 0.0}, {"azimuth": np.inf}])
def test_strange_periods_are_refused(periods: dict[str, float]) -> None:
    with pytest.raises(ValueError, match=r"Strange.periods must give columns that wrap a positive, finite period"):
        type("Strange", (Azimuth,), {"periods": periods})
