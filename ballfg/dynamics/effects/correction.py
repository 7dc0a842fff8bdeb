"""A learned correction of drag and lift over speed and spin ratio, with what is not known of it."""

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector

TERMS: Final = ("one", "v", "s", "vv", "vs", "ss", "far")
FORCES: Final = ("drag", "lift")
DOUBTS: Final = 4
SOFT_SPIN: Final = 1.0
TINY: Final = 1e-9
SIGMA: Final = 0.1


def _numbers() -> tuple[Coefficient, ...]:
    return tuple(Coefficient(f"{force}_{term}", 0.0, SIGMA, "1", -10.0, 10.0) for force in FORCES for term in TERMS)


def _doubts() -> tuple[Coefficient, ...]:
    own = tuple(Coefficient(f"doubt_{k}", 0.0, 1.0, "1", -1e6, 1e6) for k in range(DOUBTS))
    return own + tuple(
        Coefficient(f"{force}_{term}_{k}", 0.0, 0.0, "1", -10.0, 10.0, absent=None)
        for force in FORCES for k in range(DOUBTS) for term in TERMS
    )


class AirCorrection(FlightEffect):
    """Drag and lift times 1 + a sum."""

    name = "air_correction"
    sentence = "x y z."
    decide = "x y z."
    needs = ("drag", "magnus")
    coefficients = (
        Coefficient("speed", 6.0, 0.0, "m/s", 0.0, 1e3, absent=None),
        Coefficient("speed_scale", 4.0, 0.0, "m/s", 1e-3, 1e3, absent=None),
        Coefficient("ratio", 0.25, 0.0, "1", 0.0, 1e3, absent=None),
        Coefficient("ratio_scale", 0.3, 0.0, "1", 1e-3, 1e3, absent=None),
        *_numbers(),
        *_doubts(),
    )

    def adjust(self, flight: Flight) -> Flight:
        terms = self._terms(flight)
        drag, lift = (self._share(force, terms) for force in FORCES)
        flight = flight.more_drag(drag if flight.drag_gain is None else drag * flight.drag_gain)
        return flight.more_lift(lift if flight.lift_gain is None else lift * flight.lift_gain)

    def _terms(self, flight: Flight) -> list[Tensor]:
        spin = (flight.spin.square().sum(-1, keepdim=True) + SOFT_SPIN**2).sqrt()
        ratio = flight.radius * spin / flight.speed.clamp_min(TINY)
        a = (flight.speed - self.speed) / self.speed_scale
        b = (ratio - self.ratio) / self.ratio_scale
        away = 0.5 * (a.square() + b.square())
        near = torch.exp(-away)
        r2 = 2.0 * away
        missing = 1.0 - near.square() * (1.0 + r2 + 0.5 * r2.square())
        half = 0.5**0.5
        return [near, near * a, near * b, near * a * a * half, near * a * b, near * b * b * half,
                missing.clamp_min(TINY).sqrt()]

    def _share(self, force: str, terms: list[Tensor]) -> Tensor:
        total = None
        for name, term in zip(TERMS, terms, strict=True):
            weight = getattr(self, f"{force}_{name}")
            for k in range(DOUBTS):
                weight = weight + getattr(self, f"{force}_{name}_{k}") * getattr(self, f"doubt_{k}")
            total = weight * term if total is None else total + weight * term
        return total
