"""Defines the effects on the free ball: gravity, drag, Magnus force, spin decay, moving air."""

import itertools
from collections.abc import Mapping, Sequence
from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.effect import Coefficient, Flight, FlightEffect, Range, Scene, Usual, coordinate, length, vector
from ballfg.state import STANDARD_GRAVITY, Z

TINY_SPEED: Final = 1e-9
"""m/s. Keeps 0/0 away for a ball that neither moves nor spins; its saturated lift is zero anyway."""
PLACES: Final = (4, 2, 2)  # Centres of gust regions that are tried along x, y and z
REGION_SHARE: Final = 0.25  # Size of a region that is tried, as a share of the longest extent of the data
SMALLEST_REGION: Final = 0.01  # m. A ball that stays where it is has no extent
LARGEST_REGION: Final = 50.0  # m. Of a region that is tried, at most
_DOWN = torch.tensor((0.0, 0.0, -1.0), dtype=torch.float64)
_UP = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)


class Gravity(FlightEffect):
    """a = (0, 0, -g). Buoyancy of the air is the same as a smaller g."""

    name = "gravity"
    plain = "the ball's weight"
    says = "The ball is pulled down with {g:.3g} m/s²."
    belongs_to = "room"
    imitated = True
    sentence = (
        "The weight of the ball: a constant downward acceleration; the same as buoyancy and, once drag and Magnus "
        "force are free, as another time scale."
    )
    decide = "Look up the local g, known to four digits: a ball that falls otherwise shows a wrong clock or length."
    coefficients = (Coefficient("g", STANDARD_GRAVITY, 0.0, "m/s^2", 0.0, 30.0),)
    plausible = Range(9.4, 9.9, "9.76 to 9.83 m/s^2 on the ground, less the buoyancy of 0.15 m/s^2")
    usual = Usual({"g": 0.1}, "1 %, as of a length that is wrong by as much")

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, straight down."""
        return self.g * _DOWN.to(self.g.device)


class Drag(FlightEffect):
    """a = -k |v| v, with k = rho Cd A / (2 m): 0.14 1/m for Cd = 0.49; fits of real tracks give 0.08 to 0.16."""

    name = "drag"
    plain = "air drag"
    says = "The air brakes the ball (drag coefficient {k:.3g} 1/m)."
    sentence = "Quadratic air drag with a constant coefficient."
    decide = "Vary the speed of still-air shots: drag grows with its square and points backwards, whatever the spin."
    coefficients = (Coefficient("k", 0.12, 0.035, "1/m", 0.0, 2.0, varies=True),)
    plausible = Range(0.03, 0.25, "fits of measured tracks give 0.08 to 0.16 1/m; Cd of a sphere is 0.1 to 0.8")
    usual = Usual({"k": 0.12}, "literature and fits of measured tracks, docs/physics.md")

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, opposite to the velocity; zero, with zero derivative, at rest."""
        k = self.k if flight.drag_gain is None else self.k * flight.drag_gain
        return -(k * flight.speed) * flight.velocity


class Magnus(FlightEffect):
    """a = k (spin x v), k dimensionless: sources differ by 3.6 times (0.0010 to 0.0036)."""

    name = "magnus"
    plain = "a force by spin (Magnus force)"
    says = "Spin bends the flight (Magnus coefficient {k:.3g})."
    multiplies_spin = True
    sentence = "Lift of a spinning ball, proportional to spin x velocity."
    decide = (
        "Shoot with spins of opposite sign at one speed: the lift changes its sign with the spin, nothing else does."
    )
    coefficients = (Coefficient("k", 0.0028, 0.0008, "1", -0.1, 0.1),)
    plausible = Range(0.0005, 0.005, "code of robots and fits of measured tracks give 0.0010 to 0.0046")
    usual = Usual({"k": 0.0028}, "the measured set spindoe, docs/physics.md")

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, perpendicular to velocity and spin."""
        k = self.k if flight.lift_gain is None else self.k * flight.lift_gain
        return k * torch.linalg.cross(flight.spin, flight.velocity)


class SpinDecay(FlightEffect):
    """dw/dt = -rate w. No measured value was found for table tennis; 0 switches it off, 0.2 1/s is a slow decay."""

    name = "spin_decay"
    plain = "a spin that fades in flight"
    says = "The spin fades in flight, by {rate:lost} in one second."
    sentence = "Viscous torque of the air: the spin falls exponentially."
    decide = "Film a mark on the ball at launch and at the end of a long flight, or label the spin at both ends."
    coefficients = (Coefficient("rate", 0.2, 0.2, "1/s", 0.0, 20.0),)
    plausible = Range(0.0, 2.0, "at 2 1/s two thirds of the spin are gone in half a second")
    usual = Usual({"rate": 0.2}, "an estimate, 5 s until a third is left: no measured value was found")

    def spin_rate(self, flight: Flight) -> Tensor:
        """(..., 3) rad/s^2, opposite to the spin."""
        return -self.rate * flight.spin


class Wind(FlightEffect):
    """All air forces act on v - u, with a constant air velocity u; drag alone becomes -k |v - u| (v - u)."""

    name = "wind"
    plain = "a wind"
    says = "The air moves at {size:.2g} m/s {direction}."
    belongs_to = "room"
    sentence = "The air moves at a constant velocity: drag and Magnus force act on the velocity relative to the air."
    decide = "Shoot in the opposite direction, or across: the wind keeps its direction, drag turns with the shot."
    coefficients = tuple(Coefficient(axis, 0.0, 0.3, "m/s", -20.0, 20.0) for axis in "xyz")
    plausible = Range(
        -0.5, 0.5, "ISO 7730 allows up to 0.25 m/s in rooms where people stay; an open window brings 0.5 m/s"
    )
    usual = Usual({"x": 0.2}, "ISO 7730 allows up to 0.25 m/s in rooms where people stay")

    def air_velocity(self, flight: Flight) -> Tensor:
        """(3,) or (..., 3) m/s, the same everywhere."""
        return vector(self.x, self.y, self.z)


class WindShear(FlightEffect):
    """Air velocity (x, y, 0) (p_z - reference): a horizontal wind that grows linearly with height."""

    name = "wind_shear"
    plain = "a wind that grows with height"
    says = "The air moves faster higher up: {size:.2g} m/s more for each metre, {direction}."
    belongs_to = "room"
    sentence = (
        "The air moves horizontally, in proportion to the height above a reference; another reference is the same as a "
        "wind on top."
    )
    decide = "Shoot at different heights in one direction, or hold a thread at two heights."
    coefficients = (
        *(Coefficient(axis, 0.0, 0.3, "1/s", -20.0, 20.0) for axis in "xy"),
        coordinate("reference", 1.0, 0.5),
    )
    plausible = Range(-1.0, 1.0, "a draught of 0.5 m/s in the lower half metre of a room and still air above it")
    usual = Usual({"x": 0.5}, "an estimate: half of the strongest that is plausible")

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """The reference in the middle of the data."""
        return ({"reference": scene.middle[2]},)

    def air_velocity(self, flight: Flight) -> Tensor:
        """(..., 3) m/s at the height of the ball."""
        above = flight.position[..., Z : Z + 1] - self.reference
        return above * vector(self.x, self.y, torch.zeros_like(self.x))


class GustRegion(FlightEffect):
    """Air velocity u exp(-|p - c|^2 / (2 size^2)) round a centre c, smooth so that integration stays accurate."""

    name = "gust_region"
    plain = "a wind in one part of the room"
    says = "In one part of the room the air moves at {size:.2g} m/s {direction}."
    belongs_to = "room"
    sentence = (
        "The air moves in one part of the room and is still elsewhere; a region much larger than the flights is a wind."
    )
    decide = "Shoot past the suspected place on both sides: the wind is everywhere, the gust in one place."
    coefficients = (
        *(Coefficient(axis, 0.0, 0.5, "m/s", -20.0, 20.0) for axis in "xyz"),
        coordinate("center_x", 1.4, 1.0),
        coordinate("center_y", 0.0, 0.5),
        coordinate("center_z", 1.1, 0.5),
        Coefficient("size", 0.4, 0.2, "m", 0.01, 100.0, absent=None),
    )
    plausible = Range(
        -2.0, 2.0, "a fan at a few metres: ASHRAE 55 has up to 1.2 m/s at a person, twice that is the fan's own jet"
    )
    usual = Usual({"x": 1.0}, "a fan at a few metres: ASHRAE 55 has up to 1.2 m/s at a person")

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """Regions of one size at places over the extent of the data."""
        extent = [high - low for low, high in zip(scene.low, scene.high, strict=True)]
        axes = [
            [low + span * (i + 0.5) / count for i in range(count)]
            for low, span, count in zip(scene.low, extent, PLACES, strict=True)
        ]
        size = min(max(REGION_SHARE * max(extent), SMALLEST_REGION), LARGEST_REGION)
        return [{"center_x": x, "center_y": y, "center_z": z, "size": size} for x, y, z in itertools.product(*axes)]

    def air_velocity(self, flight: Flight) -> Tensor:
        """(..., 3) m/s at the ball's place."""
        center = vector(self.center_x, self.center_y, self.center_z)
        distance = (flight.position - center).square().sum(-1, keepdim=True)
        share = torch.exp(-distance / (2 * self.size.square()))
        return share * vector(self.x, self.y, self.z)


class DragSpeed(FlightEffect):
    """k (1 + slope (|v| - reference)) in place of the declared drag's k."""

    name = "drag_speed"
    plain = "a drag that changes with speed"
    says = "The drag coefficient {slope:grows|falls} with the ball's speed, by {slope:%} for each m/s."
    sentence = (
        "The drag coefficient changes with speed (with the Reynolds number); another reference is the same as another "
        "drag and slope."
    )
    decide = "Shoot without spin at very different speeds, in both directions so that a wind cancels."
    coefficients = (
        Coefficient("slope", 0.0, 0.02, "s/m", -0.2, 0.2),
        Coefficient("reference", 5.0, 0.0, "m/s", 0.0, 20.0, absent=None),
    )
    plausible = Range(-0.1, 0.1, "Cd of a sphere below the drag crisis changes by half over 5 m/s at most")
    usual = Usual({"slope": 0.03}, "an estimate: a third of the steepest that is plausible")
    needs = ("drag",)

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """The reference in the middle of the data."""
        return ({"reference": scene.speed},)

    def adjust(self, flight: Flight) -> Flight:
        """The flight with more drag where it is fast."""
        return flight.more_drag(self.slope * (flight.speed - self.reference))


class DragSpin(FlightEffect):
    """k (1 + gain S) in place of the declared drag's k, with the spin ratio S = R |w| / |v|."""

    name = "drag_spin"
    plain = "a drag that changes with spin"
    says = (
        "A ball that spins has {gain:more|less} drag: {gain:%} at a spin whose surface speed equals the flight speed."
    )
    sentence = "The drag coefficient grows with the ratio of surface speed to flight speed."
    decide = "Shoot at one speed with and without spin; sidespin and topspin must slow the ball alike."
    coefficients = (Coefficient("gain", 0.0, 0.3, "1", -10.0, 10.0),)
    plausible = Range(-1.0, 3.0, "Cd of a fast spinning ball is up to twice that of one without spin")
    usual = Usual({"gain": 0.3}, "an estimate: a third of what doubles the drag")
    needs = ("drag",)

    def adjust(self, flight: Flight) -> Flight:
        """The flight with more drag where it spins; the force, with S |v| = R |w|, has no pole at rest."""
        return flight.more_drag(self.gain * flight.spin_ratio)


class MagnusSaturation(FlightEffect):
    """k / (1 + strength S) in place of the declared Magnus k, with the spin ratio S = R |w| / |v|.

    Measured lift coefficients have this shape: Cl = 1 / (2 + |v| / (R |w|)) is S / (1 + 2 S), strength 2
    (A. Stepanek, "The aerodynamics of tennis balls - the topspin lob", American Journal of Physics 56, 1988).
    """

    name = "magnus_saturation"
    plain = "a force by spin that saturates"
    says = "The sideways force of a spinning ball grows more slowly than its spin."
    sentence = "Lift grows more slowly than the spin: it saturates with the spin ratio."
    decide = "Shoot at one speed with little, medium and much spin: the lift per spin must fall."
    coefficients = (Coefficient("strength", 0.0, 0.5, "1", 0.0, 20.0),)
    plausible = Range(0.0, 3.0, "Stepanek 1988: Cl = S / (1 + 2 S)")
    usual = Usual({"strength": 0.5}, "an estimate: a quarter of Stepanek's law")
    needs = ("magnus",)

    def adjust(self, flight: Flight) -> Flight:
        """The flight with the lift multiplied by 1 / (1 + strength S)."""
        lost = self.strength * (flight.radius * length(flight.spin))
        return flight.more_lift(-lost / (flight.speed + lost).clamp_min(TINY_SPEED))


class Buoyancy(FlightEffect):
    """An acceleration (0, 0, a): rho V g / m, 0.146 m/s^2 for a ball of 40 mm and 2.7 g in air of 1.2 kg/m^3."""

    name = "buoyancy"
    plain = "a lift by the displaced air"
    says = "Something carries a part of the ball's weight: {a:abs .2g} m/s² of acceleration."
    belongs_to = "room"
    imitated = True
    sentence = "The displaced air carries a part of the weight: exactly the same as a smaller g."
    decide = "Weigh the ball and measure its diameter: rho V g / m is known; tracks show only the sum with gravity."
    coefficients = (Coefficient("a", 0.0, 0.15, "m/s^2", -5.0, 5.0),)
    plausible = Range(0.0, 0.3, "rho V g / m is 0.146 m/s^2")
    usual = Usual({"a": 0.146}, "rho V g / m of a ball of 40 mm and 2.7 g")

    def acceleration(self, flight: Flight) -> Tensor:
        """(..., 3) m/s^2, straight up."""
        return self.a * _UP.to(self.a.device)
