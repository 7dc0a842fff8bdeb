"""What one physical effect is: a small torch module with named, bounded coefficients and a prior for each.

An effect of kind `flight` adds to the acceleration or the angular acceleration of the free ball; one of kind
`bounce` changes the coefficients of an impact. A model is a set of effects; nothing else has to know them.
"""

from __future__ import annotations

from abc import ABC
from dataclasses import dataclass, replace
from typing import ClassVar, Literal

import torch
from torch import Tensor, nn

from ballfg.state import POSITION, SPIN, VELOCITY


@dataclass(frozen=True)
class Coefficient:
    """One number of an effect: its name, nominal value, prior spread, unit, bounds and where they come from."""

    name: str
    default: float
    """Nominal value for a table-tennis ball."""
    sigma: float
    """Standard deviation of the prior: how far real balls and tables were seen to stray. 0: as good as known."""
    unit: str
    """SI unit, `1` where the number has none."""
    low: float
    """Smallest value accepted."""
    high: float
    """Largest value accepted."""
    varies: bool = False
    """Differs from ball to ball or day to day by more than one track needs to tell: estimated with each track."""


TINY_LENGTH = 1e-12
"""In the vector's own unit. Below it a length is constant to autograd."""


def length(vector: Tensor) -> Tensor:
    """(..., 1) lengths of vectors (..., 3), twice differentiable at zero; the gradient there is zero."""
    if torch.is_grad_enabled():  # the norm's own second derivative is NaN at zero
        return vector.square().sum(-1, keepdim=True).clamp_min(TINY_LENGTH**2).sqrt()
    return torch.linalg.vector_norm(vector, dim=-1, keepdim=True)


def vector(x: Tensor, y: Tensor, z: Tensor) -> Tensor:
    """(3,) or (..., 3) vectors from three coefficients, each of shape () or (..., 1)."""
    return torch.cat(torch.broadcast_tensors(*(c if c.dim() else c.unsqueeze(-1) for c in (x, y, z))), dim=-1)


class Flight:
    """A batch of free-flight states, with the quantities that several effects share computed once.

    Attributes:
        position: (..., 3) m.  velocity: (..., 3) m/s.  spin: (..., 3) rad/s.
        speed: (..., 1) m/s, twice differentiable at rest (its gradient there is zero).
    """

    __slots__ = ("_speed", "position", "spin", "velocity")

    def __init__(self, state: Tensor) -> None:
        self.position = state[..., POSITION]
        self.velocity = state[..., VELOCITY]
        self.spin = state[..., SPIN]
        self._speed: Tensor | None = None

    @property
    def speed(self) -> Tensor:
        """(..., 1) m/s."""
        if self._speed is None:
            self._speed = length(self.velocity)
        return self._speed


@dataclass(frozen=True)
class Impact:
    """A batch of impacts on a horizontal plane: the incoming motion and the coefficients that decide the outcome.

    Attributes:
        velocity: (..., 3) m/s before the impact.  spin: (..., 3) rad/s before it.
        restitution: (..., 1) or scalar, ratio of the normal speeds after and before.
        friction: (..., 1) or scalar, Coulomb coefficient.
        tangential_restitution: (..., 1) or scalar, 0: slip ends at zero when the ball grips; 1: it is reversed.
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

    def with_(self, **changes: Tensor) -> Impact:
        """This impact with some coefficients replaced."""
        return replace(self, **changes)


class Effect(nn.Module, ABC):
    """Base of all effects. A subclass names itself, its coefficients and, in one sentence, what it is.

    Each coefficient becomes a float64 `nn.Parameter` attribute of its name. Code must let it have shape () or any
    shape that broadcasts against (..., 1), so that one call can carry another value for each track.
    """

    name: ClassVar[str]
    kind: ClassVar[Literal["flight", "bounce"]]
    sentence: ClassVar[str]
    coefficients: ClassVar[tuple[Coefficient, ...]]

    def __init__(self, /, **values: float) -> None:
        super().__init__()
        known = {c.name: c for c in self.coefficients}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise ValueError(
                f"effect '{self.name}' has no coefficient '{unknown[0]}'; it has {', '.join(known) or 'none'}"
            )
        for c in self.coefficients:
            value = float(values.get(c.name, c.default))
            if not c.low <= value <= c.high:  # also refuses NaN
                raise ValueError(
                    f"{self.name}.{c.name} must lie in [{c.low:g}, {c.high:g}] {c.unit}; got {value:g}. Check its unit."
                )
            self.register_parameter(c.name, nn.Parameter(torch.tensor(value, dtype=torch.float64)))


class FlightEffect(Effect):
    """An effect on the free ball. It overrides one or both of the methods; what it leaves alone stays None."""

    kind: ClassVar[Literal["flight", "bounce"]] = "flight"

    def acceleration(self, flight: Flight) -> Tensor | None:
        """(..., 3) m/s^2 that this effect adds, or None."""
        return None

    def spin_rate(self, flight: Flight) -> Tensor | None:
        """(..., 3) rad/s^2 that this effect adds, or None."""
        return None


class BounceEffect(Effect):
    """An effect on the contact with a surface: on the coefficients of the impact, or on where the surface is."""

    kind: ClassVar[Literal["flight", "bounce"]] = "bounce"

    def adjust(self, impact: Impact) -> Impact:
        """The impact with this effect in it."""
        return impact

    def surface_offset(self) -> Tensor | None:
        """(..., 1) or scalar m by which this effect lifts the surfaces, or None."""
        return None
