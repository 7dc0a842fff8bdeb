"""What an undeclared effect may be, beyond the effects that a model file can name."""

from __future__ import annotations

from abc import abstractmethod
from collections.abc import Callable, Iterable
from typing import Any, ClassVar, cast

import torch
from torch import Tensor

from ballfg.dynamics.effect import Effect, Flight, FlightEffect
from ballfg.state import POSITION, SPIN, VELOCITY

Advance = Callable[[Tensor, Tensor], Tensor]
"""The true motion: states (n, 9) and times (n,) s, not negative, to the states that much later."""


class AirEffect(FlightEffect):
    """A change of the air forces that the declared model already has: it must know that model.

    `attach` is called once, before the first use. The model's effects stay its own; here they are only read.
    """

    _basis: tuple[FlightEffect, ...] = ()
    _radius: float = 0.0

    def attach(self, basis: Iterable[FlightEffect], radius: float) -> None:
        """Remembers the flight effects that are being changed, and the ball's radius in m.

        Raises: ValueError: if the effect that this one changes is not among them.
        """
        # a tuple, not an nn.ModuleList: the parameters must not be registered a second time
        self._basis = tuple(basis)
        self._radius = radius
        self._check()

    def _check(self) -> None:
        """A place for `_coefficient` to complain early."""

    def _coefficient(self, effect: str, name: str) -> Tensor:
        """A coefficient of a declared effect, for instance `drag`, `k`."""
        for changed in self._basis:
            if changed.name == effect:
                return cast(Tensor, getattr(changed, name))
        raise ValueError(
            f"effect '{self.name}' changes '{effect}', which the model does not declare. Add {effect} to the model's "
            f"flight section or leave {self.name} out."
        )

    def _moving_air(self, flight: Flight, air: Tensor) -> Tensor:
        """(..., 3) m/s^2 by which the declared forces change in air that moves at `air` (..., 3) m/s.

        Every air force depends on the velocity against the air, drag and Magnus alike; gravity drops out.
        """
        state = torch.cat((flight.position, flight.velocity, flight.spin), dim=-1)
        relative = Flight(torch.cat((state[..., POSITION], state[..., VELOCITY] - air, state[..., SPIN]), dim=-1))
        change = torch.zeros_like(flight.velocity)
        for effect in self._basis:
            moved, still = effect.acceleration(relative), effect.acceleration(flight)
            if moved is not None and still is not None:
                change = change + (moved - still)
        return change


class MeasurementEffect(Effect):
    """An effect on what is written down; the ball's motion stays as it is. It works on whole batches of samples."""

    # the base class knows the two kinds that a model file declares; this one never enters a model
    kind: ClassVar[Any] = "measurement"

    @abstractmethod
    def positions(self, states: Tensor, advance: Advance) -> Tensor:
        """(n, 3) m, the positions as they are measured, before noise.

        Args: states: (n, 9) true states.  advance: the true motion, for effects that look later in time.
        """
