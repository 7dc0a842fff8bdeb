"""The analytic model describes motion and measurement of a ball as a sum of named physical effects."""

from collections.abc import Iterable, Iterator
from typing import cast

import torch
from torch import Tensor, nn

from ballfg.checks import check_each
from ballfg.dynamics.coefficient import THIN_SHELL
from ballfg.dynamics.effect import BounceEffect, Coefficient, Effect, Flight, FlightEffect, Impact, per_row
from ballfg.dynamics.measurement import Later, MeasurementEffect
from ballfg.dynamics.model import BallModel, Rates
from ballfg.dynamics.motion.impact import apply_impulse, from_plane, to_plane
from ballfg.state import POSITION, SPIN, VELOCITY

_ONE, _ZERO = torch.tensor(1.0, dtype=torch.float64), torch.tensor(0.0, dtype=torch.float64)


class AnalyticModel(BallModel):
    """Free flight as the sum of flight effects; a bounce as an impulse whose coefficients bounce effects set.

    Without a restitution effect a bounce loses no normal speed; without friction the surface is slippery.
    Effects act on an impact in the order in which they are given, but none before those that it needs. Measurement
    effects act in the order of their ranks.

    Attributes:
        flight: `nn.ModuleDict` of flight effects by name.  bounce: `nn.ModuleDict` of bounce effects by name.
        measurement: `nn.ModuleDict` of measurement effects by name.
    """

    def __init__(self, effects: Iterable[Effect], *, radius: float = 0.02, inertia_factor: float = THIN_SHELL) -> None:
        super().__init__(radius, inertia_factor)
        self.flight = nn.ModuleDict()
        self.bounce = nn.ModuleDict()
        self.measurement = nn.ModuleDict()
        groups = {"flight": self.flight, "bounce": self.bounce, "measurement": self.measurement}
        for effect in sorted(after_needs(effects), key=_rank):
            groups[effect.kind][effect.name] = effect
        # names, not effects: `substitute` exchanges the effects
        self._moving_air = _overriding(self.flight, FlightEffect, "air_velocity")
        self._adjusting = _overriding(self.flight, FlightEffect, "adjust")
        self._turning = _overriding(self.flight, FlightEffect, "spin_rate")
        self._sloping = _overriding(self.bounce, BounceEffect, "surface_slope")

    @property
    def effects(self) -> list[Effect]:
        """All effects: of flight, of bounces, of measurements."""
        return [cast(Effect, e) for group in (self.flight, self.bounce, self.measurement) for e in group.values()]

    def declared_coefficients(self) -> dict[str, Coefficient]:
        """The coefficients of all effects, for instance under `flight.drag.k`."""
        return {f"{effect.kind}.{effect.name}.{c.name}": c for effect in self.effects for c in effect.coefficients}

    def rates(self, state: Tensor) -> Rates:
        """Acceleration (..., 3) m/s^2 and angular acceleration (..., 3) rad/s^2, or None, in free flight."""
        flight = Flight(state, self.radius)
        if self._moving_air:
            wind = _sum(cast(FlightEffect, self.flight[name]).air_velocity(flight) for name in self._moving_air)
            flight = flight if wind is None else flight.against(wind)
        for name in self._adjusting:
            flight = cast(FlightEffect, self.flight[name]).adjust(flight)
        effects = cast("Iterable[FlightEffect]", self.flight.values())
        acceleration = _sum([effect.acceleration(flight) for effect in effects])
        spin_rate = _sum([cast(FlightEffect, self.flight[name]).spin_rate(flight) for name in self._turning])
        if acceleration is None:
            return torch.zeros_like(flight.velocity), spin_rate
        if acceleration.shape != flight.velocity.shape:  # gravity alone is one vector for all
            acceleration = acceleration.expand_as(flight.velocity)
        return acceleration, spin_rate

    def after_bounce(self, state: Tensor) -> Tensor:
        """(..., 9) state right after an impact on a surface, from the state (..., 9) before it."""
        velocity, spin = state[..., VELOCITY], state[..., SPIN]
        slope = self.surface_slope(state)
        if slope is not None:
            velocity, spin = to_plane(velocity, slope), to_plane(spin, slope)
        impact = Impact(velocity, spin, _ONE, _ZERO, _ZERO)
        for module in self.bounce.values():
            impact = cast(BounceEffect, module).adjust(impact)
        velocity, spin = apply_impulse(impact, self.radius, self.inertia_factor)
        if slope is not None:
            velocity, spin = from_plane(velocity, slope), from_plane(spin, slope)
        return torch.cat((state[..., POSITION], velocity, spin), dim=-1)

    def surface_offset(self, state: Tensor) -> Tensor | float:
        """(...) m by which surfaces lie above their declared heights at the point where the ball would touch them.

        A ball that touches a slope does so beside its lowest point: its centre is R sqrt(1 + slope^2) above the slope.
        """
        position = state[..., POSITION]
        total = _sum(cast(BounceEffect, effect).surface_offset(position) for effect in self.bounce.values())
        if total is None:
            return 0.0
        slope = self.surface_slope(state)
        if slope is None:
            return per_row(total)
        return per_row(total) + self.radius * ((1.0 + slope.square().sum(-1)).sqrt() - 1.0)

    def surface_slope(self, state: Tensor) -> Tensor | None:
        """(2,) or (..., 2) dimensionless slope of the surfaces along x and y under the ball; None: horizontal."""
        position = state[..., POSITION]
        return _sum(cast(BounceEffect, self.bounce[name]).surface_slope(position) for name in self._sloping)

    @property
    def measures_plainly(self) -> bool:
        """True if the model has no measurement effect."""
        return len(self.measurement) == 0

    def measured(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, measured positions before noise; the measurement effects act one after the other."""
        for effect in self._measuring():
            states = torch.cat((effect.positions(states, later), states[..., POSITION.stop :]), dim=-1)
        return states[..., POSITION]

    def true_stamps(self, stamps: Tensor) -> Tensor:
        """(...) s of true time since the first stamp of a track, from the time written since then."""
        for effect in reversed(tuple(self._measuring())):
            stamps = effect.true_stamps(stamps)
        return stamps

    def stamps(self, times: Tensor) -> Tensor:
        """(...) s as written since the first stamp of a track, from true times (...) s; undoes `true_stamps`."""
        for effect in self._measuring():
            times = effect.stamps(times)
        return times

    def labelled(self, spin: Tensor) -> Tensor:
        """(..., 3) rad/s as a label says, before noise, from the true spin (..., 3) rad/s; affine in it."""
        for effect in self._measuring():
            spin = effect.label(spin)
        return spin

    def _measuring(self) -> Iterator[MeasurementEffect]:
        return (cast(MeasurementEffect, effect) for effect in self.measurement.values())

    def extra_repr(self) -> str:
        """Radius and inertia factor for `print(model)`."""
        return f"radius={self.radius:g} m, inertia_factor={self.inertia_factor:g}"


def after_needs(effects: Iterable[Effect]) -> list[Effect]:
    """Sorts effects such that each follows those that it needs; otherwise their order stays.

    Raises: ValueError: if one is given twice, or needs one that is not there.
    """
    waiting = list(check_each("effects", effects, Effect, "Give Gravity(), Drag() or another one."))
    names = [effect.name for effect in waiting]
    for name in names:
        if names.count(name) > 1:
            raise ValueError(f"effects must differ; '{name}' was given twice. Remove one.")
    placed: dict[str, Effect] = {}
    while waiting:
        ready = next((effect for effect in waiting if placed.keys() >= set(effect.needs)), None)
        if ready is None:
            lacking = [(e.name, need) for e in waiting for need in e.needs if need not in placed]
            name, need = min(lacking, key=lambda pair: pair[1] in names)
            raise ValueError(
                f"effects must come with those that they change; got '{name}' without '{need}'. "
                f"Add {need} to the model or leave {name} out."
            )
        waiting.remove(ready)
        placed[ready.name] = ready
    return list(placed.values())


def _rank(effect: Effect) -> tuple[int, str]:
    """The rank of a measurement effect; 0 for all others, so that their order stays."""
    return (effect.rank, effect.name) if isinstance(effect, MeasurementEffect) else (0, "")


def _sum(terms: Iterable[Tensor | None]) -> Tensor | None:
    """The sum of the terms that are not None, in their order; None if there is none."""
    total: Tensor | None = None
    for term in terms:  # the innermost loop of every estimate: `functools.reduce` over a list costs 5 % of a flight
        if term is not None:
            total = term if total is None else total + term
    return total


def _overriding(group: nn.ModuleDict, base: type[Effect], method: str) -> tuple[str, ...]:
    """Names of the effects of a group that override a method of their base class."""
    return tuple(name for name, effect in group.items() if getattr(type(effect), method) is not getattr(base, method))
