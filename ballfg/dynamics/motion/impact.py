"""Computes the impulse of an impact on a plane: normal restitution, and Coulomb friction that slides or grips.

The plane is horizontal; vectors at a tilted one are turned into its axes first, by the shortest turn that takes the
vertical into its normal.

Derivation in docs/derivations/impact.md. Source: A. Nakashima et al., "Modeling of rebound phenomenon of a rigid
ball with friction and elastic effects", American Control Conference 2010, sections II and III.
"""

import torch
from torch import Tensor

from ballfg.dynamics.effect import Impact

TINY_SLIP = 1e-12
"""m/s. Below it the direction of slip is not defined and the friction impulse is zero to rounding anyway."""

BLEND = 0.1
"""Half width of the transition between sliding and gripping, as a share of the gripping impulse. A hard minimum has a
kink in which an estimate gets caught: friction and slip then settle exactly on it, where no gradient is zero. Real
contacts pass from slip to grip gradually (R. Cross 2002). Where both are equal the impulse is BLEND / 4 smaller."""

_QUARTER_TURN = torch.tensor((-1.0, 1.0), dtype=torch.float64)  # times the flipped (x, y): z x (x, y)


def slip_velocity(velocity: Tensor, spin: Tensor, radius: float) -> Tensor:
    """(..., 2) m/s, velocity over the plane of the ball's lowest point: v_t + R (n x w)_t with n = z."""
    return velocity[..., :2] + radius * (_QUARTER_TURN.to(spin.device) * spin[..., :2].flip(-1))


def apply_impulse(impact: Impact, radius: float, inertia_factor: float) -> tuple[Tensor, Tensor]:
    """Velocity and spin after an impact.

    Args:
        impact: incoming motion and coefficients; shapes in `Impact`.  radius: m.
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
    impulse = -_smooth_minimum(slide, grip) * slip
    velocity = torch.cat((impact.velocity[..., :2] + impulse, impact.restitution * normal_speed), dim=-1)
    kick = (_QUARTER_TURN.to(impulse.device) / (-inertia_factor * radius)) * impulse.flip(-1)
    spin = torch.cat((impact.spin[..., :2] + kick, impact.spin[..., 2:]), dim=-1)
    return velocity, spin


def _smooth_minimum(slide: Tensor, grip: Tensor) -> Tensor:
    """min(slide, grip), rounded off by a parabola where they differ by less than `BLEND` of grip."""
    width = (BLEND * grip).clamp_min(TINY_SLIP)  # e_t = -1 leaves no grip at all
    rounding = (width - (slide - grip).abs()).clamp_min(0.0).square() / (4.0 * width)
    return torch.minimum(slide, grip.expand_as(slide)) - rounding


def to_plane(vector: Tensor, slope: Tensor) -> Tensor:
    """A world vector (..., 3) in the axes of a plane that rises by `slope` (..., 2) along x and y.

    With the normal n and q = n_x v_x + n_y v_y the turn of n into the vertical is (v_t - n_t (q / (1 + n_z) + v_z),
    q + n_z v_z), t for the two horizontal components; turning back has the opposite sign of n_t.
    """
    upright = (1.0 + slope.square().sum(-1, keepdim=True)).rsqrt()
    return _turn(vector, -slope * upright, upright)


def from_plane(vector: Tensor, slope: Tensor) -> Tensor:
    """The world vector (..., 3) with given components in the plane's axes; undoes `to_plane`."""
    upright = (1.0 + slope.square().sum(-1, keepdim=True)).rsqrt()
    return _turn(vector, slope * upright, upright)


def _turn(vector: Tensor, across: Tensor, upright: Tensor) -> Tensor:
    along, vertical = vector[..., :2], vector[..., 2:]
    part = (across * along).sum(-1, keepdim=True)
    return torch.cat((along - across * (part / (1.0 + upright) + vertical), part + upright * vertical), dim=-1)
