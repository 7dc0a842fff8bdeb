"""Computes flight and contact of a learned ball, from Gram-Schmidt features or from raw velocity and spin."""

from collections.abc import Callable
from typing import Final

import torch
from torch import Tensor, nn

from ballfg.dynamics.model import Rates
from ballfg.dynamics.networks import gram_schmidt
from ballfg.dynamics.networks.gram_schmidt import SPEED_SCALE, SPIN_SCALE
from ballfg.dynamics.networks.layers import MLP, MNN, Skip
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
