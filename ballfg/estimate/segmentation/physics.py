"""What the segmentation needs to know of a ball, read off any ball model by asking it."""

from __future__ import annotations

import math
from dataclasses import dataclass, fields

import torch

from ballfg.dynamics.model import BallModel
from ballfg.state import STANDARD_GRAVITY, STATE_DIM, VELOCITY, VZ, Z

PROBE_SPEEDS = (2.0, 4.0, 8.0)
"""m/s, at which drag is read off."""
PROBE_FALLS = (1.0, 2.0, 4.0)
"""m/s, at which restitution is read off."""


@dataclass(frozen=True)
class SegmentationPhysics:
    """A ball without spin, in five numbers; the slack of the segmentation covers what they leave out.

    Attributes:
        gravity: m/s^2, downwards.
        drag: 1/m, k in a = -k |v| v.
        restitution: of the normal velocity.
        radius: m.
        surface_offset: m by which surfaces lie above their declared heights.

    Raises: ValueError: if a number is not finite or out of range.
    """

    gravity: float = STANDARD_GRAVITY
    drag: float = 0.12
    restitution: float = 0.92
    radius: float = 0.02
    surface_offset: float = 0.0

    def __post_init__(self) -> None:
        for field in fields(self):
            value = getattr(self, field.name)
            if not math.isfinite(value):
                raise ValueError(f"{field.name} must be finite; got {value}. Check the model it comes from.")
        for name, low, high in (("gravity", 0.1, 100.0), ("drag", 0.0, 5.0), ("restitution", 0.05, 1.0)):
            value = getattr(self, name)
            if not low <= value <= high:
                raise ValueError(f"{name} must lie in [{low:g}, {high:g}]; got {value:g}. Check units and model.")
        if self.radius <= 0.0:
            raise ValueError(f"radius must be positive; got {self.radius:g} m")


def physics_of(model: BallModel) -> SegmentationPhysics:
    """The physics of a model, analytic or learned, from its answers at a few states without spin.

    Gravity, and the offset of the surfaces, come from a ball that hangs still; drag is the least-squares k over
    horizontal flight in four directions; restitution the mean over falls. Values outside the bounds of
    `SegmentationPhysics`, which an untrained model may give, are clipped into them.

    Args: model: any `BallModel`; it is neither changed nor differentiated.
    """
    speeds = torch.tensor(PROBE_SPEEDS, dtype=torch.float64).repeat_interleave(4)
    headings = torch.arange(len(speeds), dtype=torch.float64) * (math.pi / 2)
    flying = torch.zeros(len(speeds), STATE_DIM, dtype=torch.float64)
    flying[:, Z] = 1.0
    still = flying[:1].clone()
    flying[:, VELOCITY] = torch.stack((headings.cos() * speeds, headings.sin() * speeds, 0 * speeds), dim=-1)
    falling = still.repeat(len(PROBE_FALLS), 1)
    falling[:, VZ] = -torch.tensor(PROBE_FALLS, dtype=torch.float64)
    with torch.no_grad():
        gravity = -float(model.rates(still)[0][0, 2])
        pull = (model.rates(flying)[0] * flying[:, VELOCITY]).sum(-1)  # -k |v|^3
        drag = -float((pull * speeds**3).sum() / speeds.pow(6).sum())
        restitution = float((model.bounce(falling)[:, VZ] / -falling[:, VZ]).mean())
        offset = float(torch.as_tensor(model.surface_offset(still)).reshape(-1)[0])
    return SegmentationPhysics(
        gravity=min(max(gravity, 0.1), 100.0),
        drag=min(max(drag, 0.0), 5.0),
        restitution=min(max(restitution, 0.05), 1.0),
        radius=model.radius,
        surface_offset=offset,
    )
