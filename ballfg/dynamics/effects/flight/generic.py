"""Generic flight: an acceleration that is a sum of terms in place, velocity and spin, for what nobody can name."""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, vector

WORLD_AXES: Final = ("x", "y", "z")
FLIGHT_AXES: Final = ("along", "across", "lift")
PLACE_TERMS: Final = {
    "one": (0.5, "m/s^2"),
    "x": (0.5, "1/s^2"),
    "y": (0.5, "1/s^2"),
    "z": (0.5, "1/s^2"),
    "xx": (0.5, "1/(m s^2)"),
    "yy": (0.5, "1/(m s^2)"),
    "zz": (0.5, "1/(m s^2)"),
    "xy": (0.5, "1/(m s^2)"),
    "xz": (0.5, "1/(m s^2)"),
    "yz": (0.5, "1/(m s^2)"),
}
"""Terms along the world's axes, in x, y, z from the centre: standard deviation of the prior and unit. Priors of all
terms are such that each is worth about 0.5 m/s^2 at 1 m, 5 m/s and 100 rad/s."""
MOTION_TERMS: Final = {
    "one": (0.5, "m/s^2"),
    "v": (0.1, "1/s"),
    "vz": (0.2, "1/s"),
    "vv": (0.02, "1/m"),
    "vvx": (0.02, "1/m^2"),
    "vvy": (0.02, "1/m^2"),
    "vvz": (0.02, "1/m^2"),
    "vsa": (0.001, "1"),
    "vsc": (0.001, "1"),
    "vsl": (0.001, "1"),
    "vs": (0.001, "1"),
}
"""Terms along the flight, across it to the left, and along the lift: speed less its reference (v), its square (vv),
that times x, y, z from the centre, vertical velocity, speed times the spin about each of these axes, and times all."""
SOFT_SPEED: Final = 0.1
"""m/s. Below it the directions of flight fade, so that a ball at rest has none."""
SOFT_SPIN: Final = 1.0
"""rad/s. Below it the total spin is smooth at zero."""
BOUND: Final = 1e3
"""Of each coefficient, in units of its prior's standard deviation."""


def _coefficient(axis: str, term: str, sigma: float, unit: str) -> Coefficient:
    return Coefficient(f"{axis}_{term}", 0.0, sigma, unit, -BOUND * sigma, BOUND * sigma)


class GenericFlight(FlightEffect):
    """sum of c_{axis,term} term(state) axis, over the world's axes and those of the flight.

    The flight's axes are a = v / |v|, c = z x v / |z x v|, l = a x c. Every coefficient is a number by itself: x_xz is
    the acceleration along x for a unit of x z; along_vvx is a drag that grows with x.
    """

    name = "generic_flight"
    sentence = "An acceleration that depends on place, velocity and spin, written as a sum of terms; it names no cause."
    decide = "Look where it acts and on what it depends, and measure there with that alone varied."
    coefficients = (
        *(_coefficient(axis, t, *of) for axis in WORLD_AXES for t, of in PLACE_TERMS.items()),
        *(_coefficient(axis, t, *of) for axis in FLIGHT_AXES for t, of in MOTION_TERMS.items()),
        Coefficient("center_x", 1.4, 0.0, "m", -100.0, 100.0, absent=None),
        Coefficient("center_y", 0.0, 0.0, "m", -100.0, 100.0, absent=None),
        Coefficient("center_z", 1.0, 0.0, "m", -100.0, 100.0, absent=None),
        Coefficient("speed", 5.0, 0.0, "m/s", 0.0, 100.0, absent=None),
    )
    center_x: Tensor
    center_y: Tensor
    center_z: Tensor
    speed: Tensor

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2."""
        place = flight.position - vector(self.center_x, self.center_y, self.center_z)
        strengths = vector(*(getattr(self, c.name) for c in self.coefficients if c.absent is not None))
        world, own = strengths.split((3 * len(PLACE_TERMS), 3 * len(MOTION_TERMS)), dim=-1)
        axes = flight_axes(flight.velocity)
        by_place = (world.unflatten(-1, (3, -1)) * place_terms(place).unsqueeze(-2)).sum(-1)
        by_motion = (own.unflatten(-1, (3, -1)) * motion_terms(flight, axes, place, self.speed).unsqueeze(-2)).sum(-1)
        return by_place + (axes * by_motion.unsqueeze(-1)).sum(-2)


def flight_axes(velocity: Tensor) -> Tensor:
    """(..., 3, 3) rows along the flight, across it (z x v), and along the lift; each fades at rest."""
    x, y, z = velocity.split(1, dim=-1)
    along = velocity / (velocity.square().sum(-1, keepdim=True) + SOFT_SPEED**2).sqrt()
    across = torch.cat((-y, x, torch.zeros_like(z)), dim=-1) / (x.square() + y.square() + SOFT_SPEED**2).sqrt()
    return torch.stack((along, across, torch.linalg.cross(along, across, dim=-1)), dim=-2)


def place_terms(place: Tensor) -> Tensor:
    """(..., 10) `PLACE_TERMS` at a place (..., 3) m from the centre."""
    x, y, z = place.split(1, dim=-1)
    return torch.cat((torch.ones_like(x), x, y, z, x * x, y * y, z * z, x * y, x * z, y * z), dim=-1)


def motion_terms(flight: Flight, axes: Tensor, place: Tensor, reference: Tensor) -> Tensor:
    """(..., 11) `MOTION_TERMS` of a flight with its axes (..., 3, 3), at a place (..., 3) m from the centre."""
    squared = flight.velocity.square().sum(-1, keepdim=True) + SOFT_SPEED**2
    speed, one = squared.sqrt(), torch.ones_like(squared)
    about = speed * (axes * flight.spin.unsqueeze(-2)).sum(-1)
    spin = speed * (flight.spin.square().sum(-1, keepdim=True) + SOFT_SPIN**2).sqrt()
    slow = (speed - reference, flight.velocity[..., 2:], squared - reference.square())
    return torch.cat((one, *slow, squared * place, about, spin), dim=-1)
