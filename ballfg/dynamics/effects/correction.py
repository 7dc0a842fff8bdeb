"""Defines the learned correction of drag and lift: a Gaussian process over speed and spin ratio.

The kernel is s^2 exp(-|x - x'|^2 / 2) in x = ((speed - centre) / scale, (ratio - centre) / scale). Its Taylor series
writes the process as a sum of weights N(0, s^2) times the functions exp(-|x|^2 / 2) x_1^i x_2^j / sqrt(i! j!); those of
degree two and less are kept, and one further function carries the variance of all others. So the prior's standard
deviation is s at every speed and spin, and far from the data, where only that last function is left, the correction is
zero with its width (C. Rasmussen, C. Williams, "Gaussian Processes for Machine Learning", 2006, sections 2.1 and 4.3).
"""

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector

TERMS: Final = ("one", "v", "s", "vv", "vs", "ss", "far")
"""Functions of one correction: v and s are speed and spin ratio from their centres."""
FORCES: Final = ("drag", "lift")
DOUBTS: Final = 4
"""Number of directions of the weights whose uncertainty an estimate carries."""
SOFT_SPIN: Final = 1.0
"""rad/s. Below it the total spin is smooth at zero."""
SLOWEST: Final = 1e-9
"""m/s. Keeps the spin ratio finite at rest, where the correction is that of `far` and the forces are zero."""
LEAST_REST: Final = 1e-12
"""Least share of the variance in the last function: its square root stays differentiable."""
LIMIT: Final = 10.0
"""Largest weight: drag or lift eleven times as large."""

WEIGHTS: Final = tuple(f"{force}_{term}" for force in FORCES for term in TERMS)
"""Names of all weights, those of drag first."""


def correction_terms(speed: Tensor, ratio: Tensor) -> Tensor:
    """(..., 7) the functions `TERMS` of one correction; their squares add up to one.

    Args: speed, ratio: (..., 1) from their centres, in their scales, dimensionless.
    """
    away = speed.square() + ratio.square()
    near = torch.exp(-0.5 * away)
    kept = near.square() * (1.0 + away + 0.5 * away.square())
    half = 0.5**0.5
    inner = (near, near * speed, near * ratio, near * speed * speed * half, near * speed * ratio)
    return torch.cat((*inner, near * ratio * ratio * half, (1.0 - kept).clamp_min(LEAST_REST).sqrt()), dim=-1)


def _shape() -> tuple[Coefficient, ...]:
    return (
        Coefficient("speed", 5.0, 0.0, "m/s", 0.0, 1e3, absent=None),
        Coefficient("speed_scale", 4.0, 0.0, "m/s", 1e-3, 1e3, absent=None),
        Coefficient("ratio", 0.25, 0.0, "1", 0.0, 1e3, absent=None),
        Coefficient("ratio_scale", 0.3, 0.0, "1", 1e-3, 1e3, absent=None),
    )


def _numbers() -> tuple[Coefficient, ...]:
    weights = tuple(Coefficient(name, 0.0, 0.0, "1", -LIMIT, LIMIT) for name in WEIGHTS)
    doubts = tuple(
        Coefficient(f"doubt_{k}", 0.0, 1.0, "1", -1e3, 1e3, varies=True, absent=None) for k in range(1, DOUBTS + 1)
    )
    directions = tuple(
        Coefficient(f"{name}_{k}", 0.0, 0.0, "1", -LIMIT, LIMIT, absent=None)
        for k in range(1, DOUBTS + 1)
        for name in WEIGHTS
    )
    return (*weights, *doubts, *directions)


class AirCorrection(FlightEffect):
    """Drag and lift times 1 + a correction each, a function of speed and spin ratio S = R |w| / |v|.

    Each weight is its mean plus the doubts, of standard deviation 1, times their directions: the leading part of the
    posterior that `ballfg-train` found. Estimates carry the doubts as coefficients of each track.
    """

    name = "air_correction"
    plain = "a learned correction of drag and lift"
    says = "Drag and lift follow a law that was learned from other tracks."
    sentence = "Drag and lift differ from the declared law as functions of speed and spin ratio, learned from tracks."
    decide = "Shoot at several speeds and spins: the corrected law must predict them better than the declared one."
    needs = ("drag", "magnus")
    coefficients = (*_shape(), *_numbers())

    def adjust(self, flight: Flight) -> Flight:
        """The flight with the gains that other effects gave it times one plus the correction."""
        spin = (flight.spin.square().sum(-1, keepdim=True) + SOFT_SPIN**2).sqrt()
        ratio = flight.radius * spin / flight.speed.clamp_min(SLOWEST)
        terms = correction_terms(
            (flight.speed - self.speed) / self.speed_scale, (ratio - self.ratio) / self.ratio_scale
        )
        drag, lift = ((self._weights(force) * terms).sum(-1, keepdim=True) for force in FORCES)
        flight = flight.more_drag(drag if flight.drag_gain is None else drag * flight.drag_gain)
        return flight.more_lift(lift if flight.lift_gain is None else lift * flight.lift_gain)

    def _weights(self, force: str) -> Tensor:
        """(7,) or (..., 7) the weights of one force."""
        names = [f"{force}_{term}" for term in TERMS]
        total = vector(*(getattr(self, name) for name in names))
        for k in range(1, DOUBTS + 1):
            direction = vector(*(getattr(self, f"{name}_{k}") for name in names))
            total = total + getattr(self, f"doubt_{k}") * direction
        return total
