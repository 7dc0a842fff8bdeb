"""Generic effects describe patterns without a known cause as sums of terms in place, velocity and spin."""

from collections.abc import Iterable, Mapping
from math import factorial
from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import BounceEffect, Coefficient, Effect, Flight, FlightEffect, Impact, coordinate, vector
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.state import POSITION, VELOCITY

WORLD_AXES: Final = ("x", "y", "z")
FLIGHT_AXES: Final = ("along", "across", "lift")
SQUARES: Final = ("xx", "yy", "zz", "xy", "xz", "yz")
PLACE_TERMS: Final = {
    "one": (0.5, "m/s^2"),
    **dict.fromkeys(WORLD_AXES, (0.5, "1/s^2")),
    **dict.fromkeys(SQUARES, (0.5, "1/(m s^2)")),
}
"""Terms along the world's axes, in x, y, z from the centre: standard deviation of the prior and unit. Priors of all
terms are such that each is worth about 0.5 m/s^2 at 1 m, 5 m/s and 100 rad/s."""
MOTION_TERMS: Final = {
    "one": (0.5, "m/s^2"),
    "v": (0.1, "1/s"),
    "vz": (0.2, "1/s"),
    "vv": (0.02, "1/m"),
    **dict.fromkeys(("vvx", "vvy", "vvz"), (0.02, "1/m^2")),
    **dict.fromkeys(("vsa", "vsc", "vsl", "vs"), (0.001, "1")),
}
"""Terms along the flight, across it to the left, and along the lift: speed less its reference (v), its square (vv),
that times x, y, z from the centre, vertical velocity, speed times the spin about each of these axes, and times all."""
CONTACT_TERMS: Final = {
    "one": (0.1, "m/s"),
    **dict.fromkeys(("vx", "vy", "vz"), (0.03, "1")),
    **dict.fromkeys(("wx", "wy", "wz"), (0.001, "m")),
}
"""Terms in the incoming velocity and spin: standard deviation of the prior and unit; each worth about 0.1 m/s."""
MEASUREMENT_TERMS: Final = {
    **dict.fromkeys(WORLD_AXES, (0.005, "1")),
    **dict.fromkeys(SQUARES, (0.005, "1/m")),
    **dict.fromkeys(("vx", "vy", "vz"), (0.001, "s")),
}
"""Terms in the place from the centre and the velocity: standard deviation of the prior and unit; each is worth 5 mm."""
SOFT_SPEED: Final = 0.1  # m/s. Below it the directions of flight fade, so that a ball at rest has none
SOFT_SPIN: Final = 1.0  # rad/s. Below it the total spin is smooth at zero
BOUND: Final = 1e3  # Of each coefficient, in units of its prior's standard deviation
MEASUREMENT_BOUND: Final = 100.0  # The same for an error of a measurement: it is small

FUNCTIONS: Final = ("one", "v", "s", "vv", "vs", "ss", "vvv", "vvs", "vss", "sss", "far")
"""Functions of one correction: v is the speed and s the spin ratio S as S / (1 + S), from their centres."""
POWERS: Final = tuple((name.count("v"), name.count("s")) for name in FUNCTIONS[:-1])
"""Of v and s in all functions but the last."""
FORCES: Final = ("drag", "lift")
DOUBTS: Final = 4  # Number of directions of the weights of a force whose uncertainty an estimate carries
DOUBT: Final = {"drag": "doubt", "lift": "lift_doubt"}  # Prefix of the names of a force's doubts
LEAST_REST: Final = 1e-12  # Least share of the variance in the last function: its square root stays differentiable
LIMIT: Final = 10.0  # Largest weight: drag or lift eleven times as large

WEIGHTS: Final = tuple(f"{force}_{term}" for force in FORCES for term in FUNCTIONS)
"""Names of all weights, those of drag first."""
DIRECTIONS: Final = tuple(f"{name}_{k}" for k in range(1, len(FUNCTIONS) + 1) for name in WEIGHTS)
"""Names of the numbers of all directions."""
BAND: Final = frozenset(DIRECTIONS[DOUBTS * len(WEIGHTS) :])  # Those of directions without a doubt

Terms = Mapping[str, tuple[float, str]]


def _coefficients(axes: Iterable[str], terms: Terms, bound: float = BOUND) -> tuple[Coefficient, ...]:
    """One coefficient for each axis and term, named after both."""
    return tuple(
        Coefficient(f"{axis}_{term}", 0.0, sigma, unit, -bound * sigma, bound * sigma)
        for axis in axes
        for term, (sigma, unit) in terms.items()
    )


def _center() -> tuple[Coefficient, ...]:
    """The point from which terms in the place are counted."""
    middle = {"center_x": 1.4, "center_y": 0.0, "center_z": 1.0}
    return tuple(coordinate(name, m, 0.0) for name, m in middle.items())


def _strengths(effect: Effect) -> Tensor:
    """(k,) or (..., k) values of the coefficients of all terms, in their order."""
    return vector(*(getattr(effect, c.name) for c in effect.coefficients if c.absent is not None))


class GenericFlight(FlightEffect):
    """sum of c_{axis,term} term(state) axis, over the world's axes and those of the flight.

    The flight's axes are a = v / |v|, c = z x v / |z x v|, l = a x c. Every coefficient is a number by itself: x_xz is
    the acceleration along x for a unit of x z; along_vvx is a drag that grows with x.
    """

    name = "generic_flight"
    sentence = "An acceleration that depends on place, velocity and spin, written as a sum of terms; it names no cause."
    decide = "Look where it acts and on what it depends, and measure there with that alone varied."
    coefficients = (
        *_coefficients(WORLD_AXES, PLACE_TERMS),
        *_coefficients(FLIGHT_AXES, MOTION_TERMS),
        *_center(),
        Coefficient("speed", 5.0, 0.0, "m/s", 0.0, 100.0, absent=None),
    )

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2."""
        place = flight.position - vector(self.center_x, self.center_y, self.center_z)
        world, own = _strengths(self).split((3 * len(PLACE_TERMS), 3 * len(MOTION_TERMS)), dim=-1)
        axes = flight_axes(flight.velocity)
        by_place = (world.unflatten(-1, (3, -1)) * place_terms(place).unsqueeze(-2)).sum(-1)
        by_motion = (own.unflatten(-1, (3, -1)) * motion_terms(flight, axes, place, self.speed).unsqueeze(-2)).sum(-1)
        return by_place + (axes * by_motion.unsqueeze(-1)).sum(-2)


class GenericContact(BounceEffect):
    """v + sum of c_{axis,term} term axis in place of the incoming velocity v, in the axes of the surface.

    The outcome changes by the impulse's derivative: by -e c vertically, by c less the part of friction horizontally.
    """

    name = "generic_contact"
    sentence = "A change of the bounce that is linear in the incoming velocity and spin; it names no cause."
    decide = "Let the ball bounce with one component of velocity or spin varied at a time."
    coefficients = _coefficients(WORLD_AXES, CONTACT_TERMS)

    def adjust(self, impact: Impact) -> Impact:
        """The impact with another incoming velocity."""
        strengths = _strengths(self).unflatten(-1, (3, -1))
        one = torch.ones_like(impact.velocity[..., :1])
        terms = torch.cat((one, impact.velocity, impact.spin), dim=-1)
        return impact.with_(velocity=impact.velocity + (strengths * terms.unsqueeze(-2)).sum(-1))


class GenericMeasurement(MeasurementEffect):
    """p + sum of c_{axis,term} term axis in place of the position p."""

    name = "generic_measurement"
    sentence = (
        "An error of the measured positions, linear and quadratic in place and linear in velocity; it names no cause."
    )
    decide = "Measure a ball that hangs still at known places, then one that moves slowly and fast on a known path."
    coefficients = (*_coefficients(WORLD_AXES, MEASUREMENT_TERMS, MEASUREMENT_BOUND), *_center())
    rank = 2

    def positions(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, with the error."""
        place = states[..., POSITION] - vector(self.center_x, self.center_y, self.center_z)
        x, y, z = place.split(1, dim=-1)
        terms = torch.cat((place, x * x, y * y, z * z, x * y, x * z, y * z, states[..., VELOCITY]), dim=-1)
        return states[..., POSITION] + (_strengths(self).unflatten(-1, (3, -1)) * terms.unsqueeze(-2)).sum(-1)


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


def correction_terms(speed: Tensor, ratio: Tensor) -> Tensor:
    """(..., 11) the functions `FUNCTIONS` of one correction; their squares add up to one.

    Args: speed, ratio: (..., 1) from their centres, in their scales, dimensionless.
    """
    away = speed.square() + ratio.square()
    near = torch.exp(-0.5 * away)
    kept = near.square() * (1.0 + away * (1.0 + away * (1.0 / 2.0 + away / 6.0)))
    inner = (near * speed**i * ratio**j / (factorial(i) * factorial(j)) ** 0.5 for i, j in POWERS)
    return torch.cat((*inner, (1.0 - kept).clamp_min(LEAST_REST).sqrt()), dim=-1)


def _shape() -> tuple[Coefficient, ...]:
    return (
        Coefficient("speed", 5.0, 0.0, "m/s", 0.0, 1e3, absent=None),
        Coefficient("speed_scale", 4.0, 0.0, "m/s", 1e-3, 1e3, absent=None),
        Coefficient("ratio", 0.2, 0.0, "1", 0.0, 1.0, absent=None),
        Coefficient("ratio_scale", 0.2, 0.0, "1", 1e-3, 1.0, absent=None),
    )


def _numbers() -> tuple[Coefficient, ...]:
    weights = tuple(Coefficient(name, 0.0, 0.0, "1", -LIMIT, LIMIT) for name in WEIGHTS)
    doubts = tuple(
        Coefficient(f"{prefix}_{k}", 0.0, 1.0, "1", -1e3, 1e3, varies=True, absent=None)
        for prefix in DOUBT.values()
        for k in range(1, DOUBTS + 1)
    )
    directions = tuple(Coefficient(name, 0.0, 0.0, "1", -LIMIT, LIMIT, absent=None) for name in DIRECTIONS)
    return (*weights, *doubts, *directions)


class AirCorrection(FlightEffect):
    """Drag and lift times 1 + a correction each, a Gaussian process over speed and spin ratio S = R |w| / |v|.

    The kernel is s^2 exp(-|x - x'|^2 / 2) in the speed and S / (1 + S), less their centres, over their scales. Its
    Taylor series writes the process as a sum of weights N(0, s^2) times exp(-|x|^2 / 2) x_1^i x_2^j / sqrt(i! j!).
    Those of degree three and less are kept, and one further function carries the variance of all others. So the
    prior's standard deviation is s at every speed and spin. Far from the data only that last function is left
    (C. Rasmussen, C. Williams, "Gaussian Processes for Machine Learning", 2006, 2.1 and 4.3).

    Each weight is its mean plus the doubts of its force, of standard deviation 1, times the first of its directions,
    the columns of a root of the posterior's covariance that `ballfg-train` found. Estimates carry the doubts as
    coefficients of each track. The directions without a doubt move the correction least; its band shows them.
    """

    name = "air_correction"
    plain = "a learned correction of drag and lift"
    says = "Drag and lift follow a law that was learned from other tracks."
    sentence = "Drag and lift differ from the declared law as functions of speed and spin ratio, learned from tracks."
    decide = "Shoot at several speeds and spins: the corrected law must predict them better than the declared one."
    needs = ("drag", "magnus")
    learned = True
    coefficients = (*_shape(), *_numbers())

    def __init__(self, /, **values: float) -> None:
        """A doubt without a direction moves nothing: estimates do not carry it."""
        super().__init__(**values)
        idle = (
            f"{DOUBT[force]}_{k}"
            for force in FORCES
            for k in range(1, DOUBTS + 1)
            if not any(values.get(f"{force}_{term}_{k}") for term in FUNCTIONS)
        )
        self.set_sigmas(**dict.fromkeys(idle, 0.0))

    @property
    def tabled(self) -> frozenset[str]:
        """What is known and moves a ball: not the doubts, and not the weights while they are learned."""
        return frozenset(c.name for c in self.coefficients if not c.sigma and c.name not in BAND)

    def adjust(self, flight: Flight) -> Flight:
        """The flight with the gains that other effects gave it times one plus the correction."""
        spin = (flight.spin.square().sum(-1, keepdim=True) + SOFT_SPIN**2).sqrt()
        rim = flight.radius * spin
        ratio = rim / (flight.speed + rim)
        terms = correction_terms(
            (flight.speed - self.speed) / self.speed_scale, (ratio - self.ratio) / self.ratio_scale
        )
        drag, lift = ((self._weights(force) * terms).sum(-1, keepdim=True) for force in FORCES)
        flight = flight.more_drag(drag if flight.drag_gain is None else drag * flight.drag_gain)
        return flight.more_lift(lift if flight.lift_gain is None else lift * flight.lift_gain)

    def _weights(self, force: str) -> Tensor:
        """(11,) or (..., 11) the weights of one force."""
        names = [f"{force}_{term}" for term in FUNCTIONS]
        total = vector(*(getattr(self, name) for name in names))
        for k in range(1, DOUBTS + 1):
            direction = vector(*(getattr(self, f"{name}_{k}") for name in names))
            total = total + getattr(self, f"{DOUBT[force]}_{k}") * direction
        return total
