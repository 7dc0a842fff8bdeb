"""Computes the invariant features of velocity and spin for a network, and vectors from its coefficients.

Features do not change under rotations and mirrors; vectors are made of vectors that turn and flip along, with
coefficients that a network gives. Spin is a pseudovector, so a term of the wrong parity carries a pseudoscalar factor.
Everything is smooth, also at rest, without spin and where both are parallel: the first vector enters Gram-Schmidt with
one more constant component (docs/derivations/gram_schmidt.md).
"""

from dataclasses import dataclass
from typing import Final

import torch
from torch import Tensor

from ballfg.state import SPIN, VELOCITY

SPEED_SCALE: Final = 6.0  # m/s, a usual speed of a table-tennis ball: the middle of a feature's range
SPIN_SCALE: Final = 150.0  # rad/s, a usual spin of a table-tennis ball: the middle of a feature's range
CONTACT_SCALE: Final = 5.0
"""m/s, the same for a contact's velocities: of the ball, and of its surface (radius times spin)."""
LIFT: Final = 0.3
"""m/s, the constant further component of the first vector: at lower speeds its direction fades out. Small against what
balls do, large enough for derivatives up to the third to be moderate."""

FLIGHT_FEATURES: Final = 3
FLIGHT_TERMS: Final = 3  # Coefficients of the acceleration; there are as many of the angular acceleration
CONTACT_FEATURES: Final = 6
CONTACT_TERMS: Final = 8
"""Coefficients of a contact: three each for the change of v_xy and of radius z x w, two for that of w_z."""

_ONE = torch.tensor(1.0, dtype=torch.float64)
_FLIGHT_SQUARES = torch.tensor((SPEED_SCALE**-2, 1.0, 1.0), dtype=torch.float64)
_SOFT = LIFT / CONTACT_SCALE
_QUARTER_TURN = torch.tensor((-1.0, 1.0), dtype=torch.float64)  # times the flipped (x, y): z x (x, y)


@dataclass(frozen=True)
class FlightFrame:
    """Velocity and spin of a flying ball, taken apart.

    Attributes:
        features: (..., 3) invariants in (0, 1]: 1 / (1 + x^2) of the speed, the spin along the flight and the spin
            across it, each over its scale.
        velocity: (..., 3) m/s.  spin: (..., 3) over `SPIN_SCALE`.  cross: (..., 3) m/s, spin x velocity.
        helicity: (..., 1) m/s, spin . velocity: a pseudoscalar.
    """

    features: Tensor
    velocity: Tensor
    spin: Tensor
    cross: Tensor
    helicity: Tensor


def flight_frame(state: Tensor) -> FlightFrame:
    """The representation of states (..., 9): Gram-Schmidt in space, of velocity and spin."""
    velocity, spin = state[..., VELOCITY], state[..., SPIN] * (1.0 / SPIN_SCALE)
    helicity = (spin * velocity).sum(-1, keepdim=True)
    speed = velocity.square().sum(-1, keepdim=True) + LIFT**2
    along = helicity.square() / speed
    across = spin.square().sum(-1, keepdim=True) - along
    one, squares = _ONE.to(state.device), _FLIGHT_SQUARES.to(state.device)
    features = torch.addcmul(one, torch.cat((speed, along, across), dim=-1), squares).reciprocal()
    return FlightFrame(features, velocity, spin, torch.linalg.cross(spin, velocity), helicity)


def acceleration(frame: FlightFrame, coefficients: Tensor, bias: Tensor) -> Tensor:
    """(..., 3) m/s^2 = bias + A v + B (w . v) w + C w x v, from A, B, C (..., 3) in 1/s and a bias (3,) in m/s^2."""
    a, b, c = coefficients.split(1, dim=-1)
    total = torch.addcmul(bias, a, frame.velocity)
    total = torch.addcmul(total, b * frame.helicity, frame.spin)
    return torch.addcmul(total, c, frame.cross)


def angular_acceleration(frame: FlightFrame, coefficients: Tensor) -> Tensor:
    """(..., 3) rad/s^2 = A w + (w . v) (B v + C w x v), from A, B, C (..., 3) in 1/s; v and w over their scales."""
    a, b, c = coefficients.split(1, dim=-1)
    odd = torch.addcmul(b * frame.velocity, c, frame.cross)
    return SPIN_SCALE * torch.addcmul(a * frame.spin, frame.helicity * SPEED_SCALE**-2, odd)


@dataclass(frozen=True)
class ContactFrame:
    """Velocity and spin of a ball at a horizontal surface, taken apart, in units of `CONTACT_SCALE`."""

    features: Tensor
    """(..., 6) invariants in (-1, 1): lengths of slip, of v_xy across the slip, and of radius w_z, then v_xy along the
    slip, v_z, and `twist` times `turn`, each squashed by x / sqrt(1 + x^2)."""
    direction: Tensor  # (..., 2) of the slip, shorter than one where there is little
    velocity: Tensor  # (..., 2) v_xy
    side: Tensor  # (..., 2) `twist` z x direction
    turn: Tensor  # (..., 1) z . (direction x v_xy): a pseudoscalar
    twist: Tensor  # (..., 1) radius times w_z: a pseudoscalar


def contact_frame(state: Tensor, radius: float) -> ContactFrame:
    """The representation of states before a contact: Gram-Schmidt in the plane, of slip and v_xy.

    The slip, v_xy + radius z x w, is the velocity of the ball's lowest point: what friction acts against.

    Args: state: (..., 9).  radius: m.
    """
    velocity, fall = (state[..., VELOCITY] / CONTACT_SCALE).split((2, 1), dim=-1)
    spin, twist = (state[..., SPIN] * (radius / CONTACT_SCALE)).split((2, 1), dim=-1)
    quarter_turn = _QUARTER_TURN.to(state.device)
    slip = velocity + quarter_turn * spin.flip(-1)
    direction = slip * (slip.square().sum(-1, keepdim=True) + _SOFT**2).rsqrt()
    normal = quarter_turn * direction.flip(-1)
    along, turn = (direction * velocity).sum(-1, keepdim=True), (normal * velocity).sum(-1, keepdim=True)
    across = velocity.square().sum(-1, keepdim=True) - along.square()
    squares = torch.cat((slip.square().sum(-1, keepdim=True), across, twist.square()), dim=-1) + _SOFT**2
    values = torch.cat((squares.sqrt(), along, fall, twist * turn), dim=-1)
    features = values * (1.0 + values.square()).rsqrt()
    return ContactFrame(features, direction, velocity, twist * normal, turn, twist)


def contact_change(frame: ContactFrame, coefficients: Tensor, radius: float) -> tuple[Tensor, Tensor]:
    """Change of a state in a contact, apart from the normal velocity.

    v_xy changes by A direction + B v_xy + C side, radius z x w likewise, and radius w_z by A twist + B turn.

    Args: frame: of the states.  coefficients: (..., 8), three, three and two.  radius: m.
    Returns: change of v_xy (..., 2) m/s and of the spin (..., 3) rad/s.
    """
    a, b, c, d, e, f, g, h = coefficients.split(1, dim=-1)
    velocity = a * frame.direction + b * frame.velocity + c * frame.side
    rim = d * frame.direction + e * frame.velocity + f * frame.side
    spin = torch.cat((rim.flip(-1) * -_QUARTER_TURN.to(rim.device), g * frame.twist + h * frame.turn), dim=-1)
    return CONTACT_SCALE * velocity, (CONTACT_SCALE / radius) * spin
