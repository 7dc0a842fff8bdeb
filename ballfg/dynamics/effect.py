"""An effect is a small torch module that describes one physical influence by bounded coefficients with priors.

An effect of kind `flight` adds to the acceleration or the angular acceleration of the free ball, or changes what other
flight effects act on; one of kind `bounce` changes the coefficients of an impact or the place of the surfaces. The
third kind, `measurement`, is in `ballfg.dynamics.measurement`. A model is a set of effects; no other code has to know
them.
"""

from abc import ABC
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, ClassVar, Literal

import torch
from torch import Tensor, nn

from ballfg.checks import as_float
from ballfg.dynamics.coefficient import Coefficient as Coefficient
from ballfg.state import POSITION, SPIN, VELOCITY
from ballfg.tracks.checks import MAX_COORDINATE


@dataclass(frozen=True)
class Range:
    """Smallest and largest plausible strength of an effect, in its unit, and the source of both."""

    low: float
    high: float
    source: str


SEEN = "larger ones are seen by eye in a picture of the table"  # Source of the ranges of errors of cameras and frames


@dataclass(frozen=True)
class Usual:
    """The strength that an effect usually has, and where the number comes from."""

    change: Mapping[str, float]
    """Change of each coefficient, in its unit: from absence, or from the default if its prior has no spread."""
    source: str
    graded: bool = True
    """True if the effect has a size; False if it is present or absent."""


TINY_LENGTH = 1e-12  # In the vector's own unit. Autograd takes shorter lengths as constant


def length(vector: Tensor) -> Tensor:
    """(..., 1) lengths of vectors (..., k), each in the vector's unit; twice differentiable, at zero too."""
    if torch.is_grad_enabled():  # the norm's own second derivative is NaN at zero
        return vector.square().sum(-1, keepdim=True).clamp_min(TINY_LENGTH**2).sqrt()
    return torch.linalg.vector_norm(vector, dim=-1, keepdim=True)


def vector(*coefficients: Tensor) -> Tensor:
    """(k,) or (..., k) vectors from k coefficients, each of shape () or (..., 1), all in one unit."""
    return torch.cat(torch.broadcast_tensors(*(c if c.dim() else c.unsqueeze(-1) for c in coefficients)), dim=-1)


def coordinate(name: str, default: float, sigma: float) -> Coefficient:
    """One coordinate of an effect's place, m: it may lie wherever a track may. Args: default, sigma: m."""
    return Coefficient(name, default, sigma, "m", -MAX_COORDINATE, MAX_COORDINATE, absent=None)


def per_row(value: Tensor) -> Tensor:
    """() or (...) from a coefficient of shape () or (..., 1), to multiply quantities without a last axis."""
    return value.squeeze(-1) if value.dim() else value


Kind = Literal["flight", "bounce", "measurement"]
Owner = Literal["ball", "room", "rig"]
Vector = tuple[float, float, float]


@dataclass(frozen=True)
class Scene:
    """Extent of the data in a set of tracks; effects choose their shapes by it.

    Attributes:
        low, high, middle: m, of the positions; the middle is the median.
        speed: m/s, median over samples.
        impact_speed: m/s, median normal speed of impacts; NaN without contacts.
        contacts, labels: how many contacts and spin labels there are.
    """

    low: Vector
    high: Vector
    middle: Vector
    speed: float
    impact_speed: float
    contacts: int
    labels: int


class Flight:
    """A batch of free-flight states, with the quantities that several effects share computed once.

    Args: state: (..., 9) of the ball.  radius: m, of the ball.

    Attributes:
        position: (..., 3) m.  spin: (..., 3) rad/s.
        velocity: (..., 3) m/s against the air; over ground while effects are asked how the air moves.
        speed: (..., 1) m/s, the length of `velocity`, twice differentiable at rest (its gradient there is zero).
        radius: m, of the ball.
        drag_gain: (..., 1) by which drag is multiplied; None for 1.
        lift_gain: (..., 1) by which the Magnus force is multiplied; None for 1.
    """

    __slots__ = ("_speed", "drag_gain", "lift_gain", "position", "radius", "spin", "velocity")

    def __init__(self, state: Tensor, radius: float) -> None:
        self.position = state[..., POSITION]
        self.velocity = state[..., VELOCITY]
        self.spin = state[..., SPIN]
        self.radius = radius
        self.drag_gain: Tensor | None = None
        self.lift_gain: Tensor | None = None
        self._speed: Tensor | None = None

    @property
    def speed(self) -> Tensor:
        """(..., 1) m/s."""
        if self._speed is None:
            self._speed = length(self.velocity)
        return self._speed

    @property
    def spin_ratio(self) -> Tensor:
        """(..., 1) ratio R |w| / |v|, finite at rest: times the speed it is R |w| to autograd."""
        return self.radius * length(self.spin) / self.speed.clamp_min(TINY_LENGTH)

    def against(self, air: Tensor) -> "Flight":
        """This flight in air that moves at `air`, (3,) or (..., 3) m/s."""
        moved = self._copy()
        moved.velocity, moved._speed = self.velocity - air, None
        return moved

    def more_drag(self, share: Tensor) -> "Flight":
        """This flight with more drag, by a share (..., 1) of the effect `Drag` alone; shares add up."""
        changed = self._copy()
        changed.drag_gain = 1.0 + share if self.drag_gain is None else self.drag_gain + share
        return changed

    def more_lift(self, share: Tensor) -> "Flight":
        """This flight with more Magnus force, by a share (..., 1) of the effect `Magnus` alone; shares add up."""
        changed = self._copy()
        changed.lift_gain = 1.0 + share if self.lift_gain is None else self.lift_gain + share
        return changed

    def _copy(self) -> "Flight":
        other = object.__new__(Flight)  # a third of the time that copy.copy takes
        for name in Flight.__slots__:
            setattr(other, name, getattr(self, name))
        return other


@dataclass(frozen=True)
class Impact:
    """A batch of impacts on a plane: the incoming motion and the coefficients that decide the outcome.

    Motion is seen in the plane's own axes: the third is its normal. On a horizontal plane those are the world's.

    Attributes:
        velocity: (..., 3) m/s before the impact.  spin: (..., 3) rad/s before it.
        restitution: (..., 1) or scalar, ratio of the normal speeds after and before.
        friction: (..., 1) or scalar, Coulomb coefficient, dimensionless.
        tangential_restitution: (..., 1) or scalar, dimensionless: share of the slip that is reversed when the ball
            grips; 0: slip ends at zero.
    """

    velocity: Tensor
    spin: Tensor
    restitution: Tensor
    friction: Tensor
    tangential_restitution: Tensor

    @property
    def normal_speed(self) -> Tensor:
        """(..., 1) m/s, speed towards the plane, positive for an approaching ball."""
        return -self.velocity[..., 2:]

    def with_(self, **changes: Tensor) -> "Impact":
        """This impact with changes: other values (..., 1), dimensionless, or of the motion; units as in `Impact`."""
        return replace(self, **changes)


class Effect(nn.Module, ABC):
    """Base of all effects. A subclass declares its name, its coefficients and everything known about it.

    Each coefficient becomes a float64 `nn.Parameter` attribute of its name. Code must let it have shape () or any
    shape that broadcasts against (..., 1), so that one call can carry another value for each track.

    Attributes:
        name: as in a model file.  kind: the section of a model file that takes it.
        sentence: describes the effect, and which others look exactly the same.
        decide: the measurement that tells the effect from those it is mistaken for.
        plain: a noun for readers who are no specialists, such as `a wind`; its name with spaces where it is empty.
        says: a sentence for them, with fields such as `{k:.2g}` for what was fitted (`ballfg.dynamics.wording`); where
            it is empty, the first of `sentence` with all coefficients.
        coefficients: its numbers; an instance may have priors of its own (`set_sigmas`).
        plausible: range of strengths for a table-tennis ball, its table and its room. A diagnosis never names an effect
            outside of its range. None: the limit is ten sigmas from the default.
        usual: the usual strength; None if unknown.
        belongs_to: the ball (the effect follows it to every room), the room, or the rig that measures there.
        imitated: True if other effects or coefficients do exactly the same, so that tracks alone cannot name it.
        needs: names of effects that this one modifies and that must be in the same model.
        learned: True if only a training writes it, so that no search for causes tries it.
        multiplies_spin: True if its strength multiplies the spin: without spin labels its slope at absence is zero.

    Raises: ValueError: if a value is given for an unknown coefficient, or lies out of its bounds.
    """

    name: ClassVar[str]
    kind: ClassVar[Kind]
    sentence: ClassVar[str]
    decide: ClassVar[str]
    plain: ClassVar[str] = ""
    says: ClassVar[str] = ""
    coefficients: ClassVar[tuple[Coefficient, ...]]
    plausible: ClassVar[Range | None] = None
    usual: ClassVar[Usual | None] = None
    belongs_to: ClassVar[Owner] = "ball"
    imitated: ClassVar[bool] = False
    needs: ClassVar[tuple[str, ...]] = ()
    learned: ClassVar[bool] = False
    multiplies_spin: ClassVar[bool] = False

    def __init__(self, /, **values: float) -> None:
        super().__init__()
        known = {c.name: c for c in self.coefficients}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ValueError(
                f"effect '{self.name}' has no coefficient '{unknown[0]}'; it has {', '.join(known) or 'none'}"
            )
        for c in self.coefficients:
            value = as_float(f"{self.name}.{c.name}", values.get(c.name, c.default), c.unit)
            if not c.low <= value <= c.high:  # also refuses NaN
                raise ValueError(
                    f"{self.name}.{c.name} must lie in [{c.low:g}, {c.high:g}] {c.unit}; got {value:g}. Check its unit."
                )
            self.register_parameter(c.name, nn.Parameter(torch.tensor(value, dtype=torch.float64)))

    if TYPE_CHECKING:

        def __getattr__(self, name: str) -> Tensor:
            """The value of a coefficient: () or (..., 1)."""

    @property
    def tabled(self) -> frozenset[str]:
        """Names of coefficients that count as numbers of the model alone: machine code has no derivatives by them."""
        return frozenset()

    def values(self) -> dict[str, float]:
        """The values of the coefficients by name, each in its own unit."""
        return {c.name: float(getattr(self, c.name).detach()) for c in self.coefficients}

    def set_sigmas(self, **sigmas: float) -> None:
        """Give coefficients of this one effect other prior standard deviations, in their own units.

        Raises: KeyError: if it has no coefficient of that name.
        """
        listed = {c.name: c for c in self.coefficients}
        for name, sigma in sigmas.items():
            listed[name] = replace(listed[name], sigma=sigma)
        self.__dict__["coefficients"] = tuple(listed.values())

    def vary(self, **sigmas: float) -> None:
        """`set_sigmas` of coefficients that differ so much from ball to ball that each track has its own.

        Raises: KeyError: if it has no coefficient of that name.
        """
        self.set_sigmas(**sigmas)
        self.__dict__["coefficients"] = tuple(
            replace(c, varies=True) if c.name in sigmas else c for c in self.coefficients
        )

    @classmethod
    def shapes(cls, scene: Scene) -> Sequence[Mapping[str, float]]:
        """Values of the shape coefficients at which a search looks for the effect in data that span `scene`.

        By default the declared shapes. A reference is best put in the middle of the data, a region over all of their
        extent. None: the effect cannot act there.
        """
        return ({},)


class FlightEffect(Effect):
    """An effect on the free ball. A subclass overrides one or more of the methods; the others do nothing.

    A model asks in three passes: how the air moves, then how large the air forces are, then for the forces. From the
    second pass on every effect sees the velocity against the air.
    """

    kind: ClassVar[Kind] = "flight"

    def air_velocity(self, flight: Flight) -> Tensor | None:
        """(3,) or (..., 3) m/s by which the air moves at the ball's place, or None for still air."""
        return None

    def adjust(self, flight: Flight) -> Flight:
        """The flight with other drag and lift gains."""
        return flight

    def acceleration(self, flight: Flight) -> Tensor | None:
        """(..., 3) m/s^2 that this effect adds, or None."""
        return None

    def spin_rate(self, flight: Flight) -> Tensor | None:
        """(..., 3) rad/s^2 that this effect adds, or None."""
        return None


class BounceEffect(Effect):
    """An effect on the contact with a surface: on the coefficients of the impact, or on where the surface is."""

    kind: ClassVar[Kind] = "bounce"

    def adjust(self, impact: Impact) -> Impact:
        """The impact as this effect changes it."""
        return impact

    def surface_offset(self, position: Tensor) -> Tensor | None:
        """(..., 1) or scalar m by which this effect lifts the surfaces under a position (..., 3) m, or None."""
        return None

    def surface_slope(self, position: Tensor) -> Tensor | None:
        """(2,) or (..., 2) slope of the surfaces under a position (..., 3) m, or None for none; dimensionless.

        It is the derivative of `surface_offset` by x and y, and tilts the plane of the impact.
        """
        return None
