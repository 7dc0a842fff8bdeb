"""Prediction with a model that cannot be compiled: the same code, answered by torch."""

from __future__ import annotations

import warnings

import numpy as np
import pytest
import torch

from ballfg.dynamics import AnalyticModel, Surfaces
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.compiled.functions import compiled
from ballfg.dynamics.effect import Coefficient, FlightEffect
from ballfg.prediction import Propagator, apex, next_contact, plane_crossing
from tests.prediction.conftest import NEARLY_EXACT

START = [0.0, 0.0, 0.25, 4.0, 0.3, -1.0, 10.0, 30.0, 5.0]
TIMES = torch.arange(1, 16, dtype=torch.float64) / 50


class Bessel(FlightEffect):
    """A force that asks torch for what no rule covers, and refuses places far below the floor."""

    name = "bessel"
    sentence = decide = "Only a test."
    coefficients = (Coefficient("k", 0.0, 0.01, "m/s^2", -1.0, 1.0),)

    def acceleration(self, flight):
        if not torch.is_grad_enabled() and bool((flight.position > 50.0).any()):
            raise ValueError("nothing is known of places beyond 50 m")
        return self.k * torch.special.i0(flight.position)


@pytest.fixture
def slow(model):
    """The same ball, with an effect of no strength that only torch computes."""
    ball = AnalyticModel([*model.flight.values(), *model.bounce.values(), Bessel()]).requires_grad_(False)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # it says so once
        assert compiled(ball) is None
    return ball


def test_predictions_are_those_of_machine_code(model, slow, table, beliefs):
    names = ("flight.drag.k", "bounce.restitution.e")
    quick = beliefs(AugmentedModel(model, names), START)
    path = table.rollout(beliefs(AugmentedModel(slow, names), START), TIMES)
    known = table.rollout(quick, TIMES)
    np.testing.assert_allclose(path.states, known.states, rtol=0, atol=1e-8)
    np.testing.assert_allclose(path.covariances, known.covariances, rtol=1e-6, atol=1e-9)


def test_crossings_are_those_of_machine_code(model, slow, table, beliefs):
    found = [event(beliefs(slow, START)) for event in events(table)]
    for one, other in zip(found, (event(beliefs(model, START)) for event in events(table)), strict=True):
        assert abs(one.time - other.time) < 1e-9
        np.testing.assert_allclose(one.state, other.state, rtol=0, atol=1e-7)
        np.testing.assert_allclose(one.covariance, other.covariance, rtol=1e-6, atol=1e-9)


@pytest.mark.parametrize("end", [0.535, 0.545])
def test_crossings_of_what_may_fall_past_an_edge_are_those_of_machine_code(model, slow, beliefs, end):
    """The mean comes down at 0.54 m, just beside the table or just on it; in both cases some balls do the other."""
    edge = Propagator(Surfaces(0.0, -5.0, (-np.inf, end, -np.inf, np.inf), (0.0, 0.01, 0.0, 0.0)), NEARLY_EXACT)
    endless = Propagator(Surfaces(0.0 if end > 0.54 else -4.0, -5.0), NEARLY_EXACT)
    found, known, sure = (
        plane_crossing(place, beliefs(ball, START), [1.0, 0.0, 0.0], 0.8, 1.0)
        for place, ball in ((edge, slow), (edge, model), (endless, model))
    )
    assert abs(found.time - known.time) < 1e-8
    np.testing.assert_allclose(known.state, found.state, rtol=0, atol=1e-6)
    np.testing.assert_allclose(known.covariance, found.covariance, rtol=1e-4, atol=1e-8)
    assert known.covariance[5, 5] > 4.0 * sure.covariance[5, 5]  # it bounces, or it does not


def events(table):
    """Contact, apex and crossing of a plane, of a belief."""
    yield lambda belief: next_contact(table, belief, 1.0)
    yield lambda belief: apex(table, belief, 1.0)
    yield lambda belief: plane_crossing(table, belief, [1.0, 0.0, 0.0], 1.5, 1.0)


def test_what_an_effect_raises_arrives(slow, table, beliefs):
    with pytest.raises(ValueError, match="beyond 50 m"):
        table.rollout(beliefs(slow, [100.0, *START[1:]]), TIMES)
