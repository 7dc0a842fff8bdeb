"""The impulse of one impact on a horizontal plane: normal restitution, and Coulomb friction that slides or grips.

Derivation in docs/derivations/impact.md. Source: A. Nakashima et al., "Modeling of rebound phenomenon of a rigid
ball with friction and elastic effects", American Control Conference 2010, sections II and III.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.effect import Impact

TINY_SLIP = 1e-12
"""m/s. Below it the direction of slip is not defined and the friction impulse is zero to rounding anyway."""


def slip_velocity(velocity: Tensor, spin: Tensor, radius: float) -> Tensor:
    """(..., 2) m/s, velocity over the plane of the ball's lowest point: v_t + R (n x w)_t with n = z."""
    return torch.stack((velocity[..., 0] - radius * spin[..., 1], velocity[..., 1] + radius * spin[..., 0]), dim=-1)


def apply_impulse(impact: Impact, radius: float, inertia_factor: float) -> tuple[Tensor, Tensor]:
    """Velocity and spin after an impact.

    Args:
        impact: incoming motion and coefficients; shapes in `Impact`.
        radius: m.
        inertia_factor: moment of inertia divided by m R^2; 2/3 for a thin shell.
    Returns: velocity (..., 3) m/s and spin (..., 3) rad/s after the impact. The spin about the normal stays.
    """
    slip = slip_velocity(impact.velocity, impact.spin, radius)
    speed = slip.square().sum(-1, keepdim=True).clamp_min(TINY_SLIP**2).sqrt()
    normal_speed = impact.normal_speed
    pressing = normal_speed.clamp_min(0.0)  # no friction on a ball that moves away
    # a tangential impulse J (per mass) changes the slip by J (1 + 1/c): c/(1+c) of the slip stops it
    grip = inertia_factor / (1.0 + inertia_factor) * (1.0 + impact.tangential_restitution)
    slide = impact.friction * (1.0 + impact.restitution) * pressing / speed
    impulse = -torch.minimum(slide, grip.expand_as(slide)) * slip
    velocity = torch.cat((impact.velocity[..., :2] + impulse, impact.restitution * normal_speed), dim=-1)
    kick = impulse / (inertia_factor * radius)
    spin = impact.spin + torch.stack((kick[..., 1], -kick[..., 0], torch.zeros_like(kick[..., 0])), dim=-1)
    return velocity, spin
