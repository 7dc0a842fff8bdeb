"""Somebody's own model with an operation that cannot be compiled: torch computes it, to the same events."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import BallModel
from ballfg.dynamics.compiled.functions import compiled
from ballfg.prediction import apex, next_contact, plane_crossing

pytestmark = pytest.mark.filterwarnings("ignore:InTorch runs in torch:UserWarning")  # which it says
RISING = [0.0, 0.0, 0.25, 4.0, 0.3, 2.0, 10.0, 30.0, 5.0]


class InTorch(BallModel):
    """The same ball, but for a factor of erf(9), which is one."""

    def __init__(self, ball: BallModel) -> None:
        super().__init__(ball.radius)
        self.ball = ball

    def rates(self, state):
        acceleration, spin_rate = self.ball.rates(state)
        return acceleration * torch.erf(torch.zeros_like(acceleration) + 9.0), spin_rate

    def after_bounce(self, state):
        return self.ball.after_bounce(state)

    def surface_offset(self, state):
        return self.ball.surface_offset(state)


@pytest.mark.parametrize("later", [False, True], ids=["first", "after the next contact"])
@pytest.mark.parametrize(
    "event",
    [next_contact, apex, lambda *given, **options: plane_crossing(*given, [1.0, 0.0, 0.0], 3.5, **options)],
    ids=["contact", "apex", "plane"],
)
def test_events_are_those_of_machine_code(model, beliefs, table, event, later) -> None:
    own = InTorch(model)
    assert compiled(own) is None
    found, expected = (
        event(table, belief, **({"after": next_contact(table, belief).time} if later else {}))
        for belief in (beliefs(one, RISING) for one in (own, model))
    )
    assert found.time == pytest.approx(expected.time, abs=1e-9)
    assert found.time_sigma == pytest.approx(expected.time_sigma, rel=1e-6)
    np.testing.assert_allclose(found.state, expected.state, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.covariance, expected.covariance, rtol=1e-6, atol=1e-9)
