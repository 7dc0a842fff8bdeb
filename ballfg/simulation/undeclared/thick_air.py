"""Thick air: drag that grows along the flight. No catalogue of ball physics holds it; it tests for the unknown."""

from __future__ import annotations

from typing import Final

from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect

SOFT_START: Final = 0.1
"""m. Over this distance the growth sets in, so that the force has no kink."""


class ThickAir(FlightEffect):
    """k (1 + growth d) in place of the declared drag's k, with d = (x + sqrt(x^2 + soft^2)) / 2 beyond a start in x.

    A state has no clock: the way along the launcher's x axis stands for the time since the launch.
    """

    name = "thick_air"
    sentence = "The drag grows during the flight."
    decide = "Nothing to decide: no catalogue holds it."
    coefficients = (
        Coefficient("growth", 0.0, 0.2, "1/m", -10.0, 10.0),
        Coefficient("start_x", 0.0, 0.5, "m", -100.0, 100.0, absent=None),
    )
    needs = ("drag",)
    growth: Tensor
    start_x: Tensor

    def adjust(self, flight: Flight) -> Flight:
        """The flight with more drag the farther it has come."""
        beyond = flight.position[..., :1] - self.start_x
        return flight.more_drag(self.growth * 0.5 * (beyond + (beyond.square() + SOFT_START**2).sqrt()))
