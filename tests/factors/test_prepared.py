"""Dynamics factors that are prepared for a minimisation."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import nominal_model
from ballfg.factors.dynamics import ContactFactors, DynamicsFactors, FlightFactors
from ballfg.factors.noise import ProcessNoise


@pytest.mark.parametrize("kind", [FlightFactors, ContactFactors])
def test_prepared_factors_are_the_same_factors_of_the_coefficients_at_that_time(kind: type[DynamicsFactors]) -> None:
    model, rng = nominal_model(0.02), np.random.default_rng(4)
    states = np.array([0.0, 0.0, 0.06, 4.0, 0.5, -3.0, 10.0, 60.0, -20.0]) + 0.01 * rng.standard_normal((5, 9))
    more = (np.zeros((4, 1)),) if kind is ContactFactors else ()
    dt = np.full(4, 0.03)
    factors = kind(model, np.arange(4), dt, ProcessNoise().flight(dt), *more)
    inputs, prepared = (states[:-1], states[1:]), factors.prepared()

    def same(left: DynamicsFactors, right: DynamicsFactors) -> bool:
        (r, js), (other, others) = (each.compute(slice(None), inputs) for each in (left, right))
        pairs = zip((r, *js), (other, *others), strict=True)
        return all(np.allclose(a, b, rtol=1e-12, atol=1e-12) for a, b in pairs)

    assert same(prepared, factors)
    with torch.no_grad():
        model.get_parameter("flight.drag.k").mul_(1.5)
    assert not same(prepared, factors)  # the others see the present coefficients
    assert same(factors.prepared(), factors)
