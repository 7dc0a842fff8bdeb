"""Velocity lag: positions are reported where the ball was some time ago."""

from __future__ import annotations

from torch import Tensor

from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION, VELOCITY


class VelocityLag(MeasurementEffect):
    """p - lag v in place of p, with the velocity at the stamp: what an extrapolating or smoothing tracker reports.

    Within a flight that is the track of a ball that started `lag` later, up to lag^2 / 2 times its acceleration (0.1 mm
    at 5 ms); what shows is the step of lag times the jump of the velocity at a contact.
    """

    name = "velocity_lag"
    sentence = (
        "Positions are reported late, by a lag times the velocity: within one flight the same as a shift of the clock."
    )
    decide = (
        "Let the ball bounce often and steeply: each bounce must show a step of the lag times the change of velocity."
    )
    coefficients = (Coefficient("lag", 0.0, 0.003, "s", -0.2, 0.2),)
    rank = 1
    lag: Tensor

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, behind the ball."""
        return states[..., POSITION] - self.lag * states[..., VELOCITY]
