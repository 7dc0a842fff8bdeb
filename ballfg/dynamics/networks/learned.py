"""The learned model computes flight and bounce by networks, alone or as a correction of another model."""

from collections.abc import Callable
from functools import partial
from typing import Final

import torch
from torch import Tensor, nn

from ballfg.dynamics.coefficient import DOUBT, THIN_SHELL
from ballfg.dynamics.effect import Coefficient, per_row
from ballfg.dynamics.effects.bounce import TableHeight
from ballfg.dynamics.model import BASE, BallModel, Rates
from ballfg.dynamics.networks import gram_schmidt
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.fading import DOUBTS, Fading
from ballfg.dynamics.networks.gram_schmidt import SPEED_SCALE, SPIN_SCALE
from ballfg.dynamics.networks.layers import MLP, MNN, NETWORKS, NetworkKind, Skip
from ballfg.state import POSITION, SPIN, STANDARD_GRAVITY, VELOCITY, VZ

HIGHEST_RESTITUTION: Final = 1.2
"""Largest restitution of a network: above one, so that a fit can pass through unphysical values."""
START_RESTITUTION: Final = 0.85  # Restitution of an untrained model

Maker = Callable[[int, int], MLP | Skip | MNN]  # From the numbers of inputs and outputs to a network

_UP = torch.tensor((0.0, 0.0, 1.0), dtype=torch.float64)
_RAW_SCALES = torch.tensor([1 / SPEED_SCALE] * 3 + [1 / SPIN_SCALE] * 3, dtype=torch.float64)
_RATE_SCALES = torch.tensor([SPEED_SCALE] * 3 + [SPIN_SCALE] * 3, dtype=torch.float64)
_CHANGE_SCALES = torch.tensor([SPEED_SCALE] * 2 + [SPIN_SCALE] * 3, dtype=torch.float64)


class GramSchmidtFlight(nn.Module):
    """Rates in free flight: a network's coefficients on Gram-Schmidt vectors, plus a vertical bias.

    Args:
        make: the network.  spin_rate: give the angular acceleration too.
        falls: start from free fall; else from no acceleration at all, for a correction.

    Attributes: bias: () m/s^2, upwards.
    """

    def __init__(self, make: Maker, *, spin_rate: bool, falls: bool) -> None:
        super().__init__()
        self.spin_rate = spin_rate
        outputs = gram_schmidt.FLIGHT_TERMS * (2 if spin_rate else 1)
        self.network = make(gram_schmidt.FLIGHT_FEATURES, outputs)
        self.bias = nn.Parameter(torch.tensor(-STANDARD_GRAVITY if falls else 0.0, dtype=torch.float64))

    def forward(self, state: Tensor) -> Rates:
        """Acceleration and angular acceleration (or None) of states (..., 9)."""
        frame = gram_schmidt.flight_frame(state)
        coefficients = self.network(frame.features)
        bias = self.bias * _UP.to(state.device)
        if not self.spin_rate:
            return gram_schmidt.acceleration(frame, coefficients, bias), None
        linear, angular = coefficients.split(gram_schmidt.FLIGHT_TERMS, dim=-1)
        return gram_schmidt.acceleration(frame, linear, bias), gram_schmidt.angular_acceleration(frame, angular)


class RawFlight(nn.Module):
    """Rates in free flight: a network of velocity and spin as they are, in the world frame.

    Args: as for `GramSchmidtFlight`. The bias of the last layer is the gravity.
    """

    def __init__(self, make: Maker, *, spin_rate: bool, falls: bool) -> None:
        super().__init__()
        self.spin_rate = spin_rate
        self.network = make(6, 6 if spin_rate else 3)
        if falls:
            self.network.last.bias.data[2] = -STANDARD_GRAVITY / SPEED_SCALE

    def forward(self, state: Tensor) -> Rates:
        """Acceleration and angular acceleration (or None) of states (..., 9)."""
        outputs = self.network(state[..., VELOCITY.start : SPIN.stop] * _RAW_SCALES.to(state.device))
        rates = outputs * _RATE_SCALES.to(state.device)[: outputs.shape[-1]]
        return rates[..., :3], rates[..., 3:] if self.spin_rate else None


class GramSchmidtContact(nn.Module):
    """A bounce: a network's coefficients of Gram-Schmidt vectors in the plane change a first guess of it.

    Args: make: the network.  radius: m.  first: restitution of the guess; 1 if that is another model's bounce.
    """

    def __init__(self, make: Maker, *, radius: float, first: float) -> None:
        super().__init__()
        self.radius, self.first = radius, first
        outputs = gram_schmidt.CONTACT_TERMS + 1
        self.network = make(gram_schmidt.CONTACT_FEATURES, outputs)

    def forward(self, state: Tensor, guess: Tensor) -> Tensor:
        """(..., 9) after the contact, from the states before it and a guess of those after it."""
        frame = gram_schmidt.contact_frame(state, self.radius)
        coefficients = self.network(frame.features)
        tangential, normal = coefficients.split((gram_schmidt.CONTACT_TERMS, 1), dim=-1)
        velocity, spin = gram_schmidt.contact_change(frame, tangential, self.radius)
        return _changed(guess, velocity, normal, spin, self.first)


class RawContact(nn.Module):
    """A bounce: a network of raw velocity and spin changes a first guess of it.

    Args: as for `GramSchmidtContact`. The radius is unused: the network sees raw velocity and spin only.
    """

    def __init__(self, make: Maker, *, radius: float, first: float) -> None:
        super().__init__()
        self.first = first
        self.network = make(6, 6)

    def forward(self, state: Tensor, guess: Tensor) -> Tensor:
        """(..., 9) after the contact, from the states before it and a guess of those after it."""
        outputs = self.network(state[..., VELOCITY.start : SPIN.stop] * _RAW_SCALES.to(state.device))
        change = outputs[..., 1:] * _CHANGE_SCALES.to(state.device)
        return _changed(guess, change[..., :2], outputs[..., :1], change[..., 2:], self.first)


def _changed(guess: Tensor, velocity: Tensor, normal: Tensor, spin: Tensor, first: float) -> Tensor:
    """A guess (..., 9) of the state after a contact, changed; the normal velocity by a factor that keeps its sign.

    `normal` takes the restitution from 0 (very negative) over `first`, that of the guess (0), to `HIGHEST_RESTITUTION`.
    """
    t = torch.tanh(normal)
    room = HIGHEST_RESTITUTION - first
    factor = 1.0 + 2.0 * room * t / (HIGHEST_RESTITUTION + (2.0 * first - HIGHEST_RESTITUTION) * t)
    moved = torch.cat((guess[..., VELOCITY.start : VZ] + velocity, guess[..., VZ : VZ + 1] * factor), dim=-1)
    return torch.cat((guess[..., POSITION], moved, guess[..., SPIN] + spin), dim=-1)


START_OFFSET: Final = -0.003
"""m by which an untrained model puts surfaces above their declared heights, as in the nominal model."""


class LearnedModel(BallModel):
    """A ball whose flight and contact are networks.

    Without a base it starts as a ball that falls in vacuum, with a restitution of `START_RESTITUTION` and no
    tangential change in a bounce. With a base it starts as the base.

    Attributes:
        architecture: kind and sizes of the networks.  flight: network of the rates.  contact: network of the bounce.
        base: the model to correct, or None.
        offset: () m by which surfaces lie above their declared heights; the base's where there is one.
        fading: how the correction fades outside of the training data; None without a base, and before the training.

    Raises: ValueError: if a base is given without a residual architecture, or lacks, or has another radius.
    """

    def __init__(
        self,
        architecture: Architecture,
        *,
        radius: float,
        inertia_factor: float = THIN_SHELL,
        base: BallModel | None = None,
        seed: int = 0,
    ) -> None:
        super().__init__(radius, inertia_factor)
        if architecture.residual != (base is not None):
            raise ValueError(
                f"base must be given if, and only if, the architecture is residual; got residual="
                f"{architecture.residual} and base={type(base).__name__}. Change one of them."
            )
        if base is not None and base.radius != radius:
            raise ValueError(f"base must be a ball of the same radius; got {base.radius:g} m and {radius:g} m.")
        kind: NetworkKind = architecture.kind.removesuffix("+gs")  # type: ignore[assignment]
        raw, first = architecture.kind == "mlp", START_RESTITUTION if base is None else 1.0
        make = partial(NETWORKS[kind], depth=architecture.depth, generator=torch.Generator().manual_seed(seed))
        self.architecture = architecture
        flying, bouncing = (partial(make, width=w) for w in (architecture.width_flight, architecture.width_contact))
        flight = RawFlight if raw else GramSchmidtFlight
        self.flight = flight(flying, spin_rate=architecture.spin_rate, falls=base is None)
        self.contact = (RawContact if raw else GramSchmidtContact)(bouncing, radius=radius, first=first)
        self.base = base
        self.fading: Fading | None = None
        if base is None:
            self.offset = nn.Parameter(torch.tensor(START_OFFSET, dtype=torch.float64))

    def declared_coefficients(self) -> dict[str, Coefficient]:
        """The base's coefficients as `base....`, with the doubts of a correction that helps abroad; or the offset."""
        if self.base is None:
            return {"offset": TableHeight.coefficients[0]}
        unused = self.fading is None or not self.fading.get_buffer("abroad") > 0.0
        doubts = {} if unused else {DOUBT + c.name: c for c in DOUBTS}
        return {BASE + name: c for name, c in self.base.declared_coefficients().items()} | doubts

    def rates(self, state: Tensor) -> Rates:
        """Acceleration (..., 3) m/s^2 and angular acceleration (..., 3) rad/s^2, or None, in free flight."""
        acceleration, spin_rate = self.flight(state)
        if self.base is None:
            return acceleration, spin_rate
        base_acceleration, base_spin_rate = self.base.rates(state)
        if self.fading is not None:
            acceleration = self.fading.in_flight(state, acceleration)
            spin_rate = None if spin_rate is None else self.fading.strength * self.fading.inside(state) * spin_rate
        if spin_rate is not None and base_spin_rate is not None:
            spin_rate = base_spin_rate + spin_rate
        return base_acceleration + acceleration, base_spin_rate if spin_rate is None else spin_rate

    def after_bounce(self, state: Tensor) -> Tensor:
        """(..., 9) state right after an impact on a horizontal plane, from the state (..., 9) before it."""
        if self.base is None:
            up = -START_RESTITUTION * state[..., VZ : VZ + 1]
            guess = torch.cat((state[..., :VZ], up, state[..., SPIN]), dim=-1)
        else:
            guess = self.base.after_bounce(state)
        after: Tensor = self.contact(state, guess)
        return after if self.fading is None else guess + self.fading.at_contact(state, after - guess)

    def inside(self, state: Tensor) -> Tensor | None:
        """(...) weight of the correction in flight, of states (..., 9); None if it does not fade."""
        return None if self.fading is None else self.fading.inside(state).squeeze(-1)

    def surface_offset(self, state: Tensor) -> Tensor | float:
        """(...) m by which surfaces lie above the heights declared for them."""
        if self.base is not None:
            return self.base.surface_offset(state)
        return per_row(self.offset)

    def surface_slope(self, state: Tensor) -> Tensor | None:
        """(2,) or (..., 2) dimensionless slope of the surfaces: the base's."""
        return None if self.base is None else self.base.surface_slope(state)

    @property
    def measuring(self) -> BallModel | None:
        """The base."""
        return self.base

    def extra_repr(self) -> str:
        """Kind, radius and inertia factor for `print(model)`."""
        return f"{self.architecture.kind}, radius={self.radius:g} m, inertia_factor={self.inertia_factor:g}"


def build(
    architecture: Architecture,
    *,
    radius: float,
    inertia_factor: float = THIN_SHELL,
    base: BallModel | None = None,
    seed: int = 0,
) -> LearnedModel:
    """An untrained model; the same seed gives the same weights."""
    return LearnedModel(architecture, radius=radius, inertia_factor=inertia_factor, base=base, seed=seed)
