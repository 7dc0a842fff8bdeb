"""Derives the eight numbers of the segmentation's ball from the answers of any ball model."""

from __future__ import annotations

import math
import weakref
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.kept_model import KeptModel
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.dynamics.motion.arrays import acceleration, bounced, surface_offsets
from ballfg.state import STANDARD_GRAVITY, STATE_DIM, VELOCITY, Z

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

PROBE_SPEEDS = (2.0, 4.0, 8.0)
"""m/s, for the drag."""
PROBE_FALLS = (1.0, 2.0, 4.0)
"""m/s, for restitution and friction."""
PROBE_SLIDE = 12.0
"""m/s, tangential: fast enough to slide through a bounce, so that the change of velocity shows the friction, and within
the slip of a ball with strong spin: a learned contact is valid only within its training data."""
BOUNDS = {
    "gravity": (0.1, 100.0),
    "drag": (0.0, 5.0),
    "restitution": (0.05, 1.0),
    "friction": (0.0, 3.0),
    "radius": (1e-3, 1.0),
    "surface_offset": (-0.2, 0.2),
    "slope_x": (-0.5, 0.5),
    "slope_y": (-0.5, 0.5),
}
"""Lowest and highest value of each number, in its own unit."""


@dataclass(frozen=True)
class SegmentationPhysics:
    """A ball without spin and the plane of its surfaces, in eight numbers; slack covers the rest.

    Attributes:
        gravity: m/s^2, downwards.  drag: 1/m, k in a = -k |v| v.  restitution: of the normal velocity.
        friction: Coulomb coefficient of a bounce.  radius: m.
        surface_offset: m by which surfaces lie above their declared heights at the origin.
        slope_x, slope_y: by which they rise along x and y.

    Raises: ValueError: if a number is not finite or out of range.
    """

    gravity: float = STANDARD_GRAVITY
    drag: float = 0.12
    restitution: float = 0.92
    friction: float = 0.25
    radius: float = 0.02
    surface_offset: float = 0.0
    slope_x: float = 0.0
    slope_y: float = 0.0

    def __post_init__(self) -> None:
        for name, (low, high) in BOUNDS.items():
            value = getattr(self, name)
            if not math.isfinite(value):
                raise ValueError(f"{name} must be finite; got {value}. Check the model it comes from.")
            if not low <= value <= high:
                raise ValueError(f"{name} must lie in [{low:g}, {high:g}]; got {value:g}. Check units and model.")

    def rise(self, x: float, y: float) -> float:
        """M by which surfaces lie above their declared heights at a place (m)."""
        return self.surface_offset + self.slope_x * x + self.slope_y * y

    def level(self, positions: Array) -> Array:
        """(n, 3) m, the same positions as over surfaces without a slope: z is reduced by what they rise.

        Flight and bounce look there as they do over a level table, but for the turn of a bounce's tangential velocity.
        """
        rise = self.slope_x * positions[:, :1] + self.slope_y * positions[:, 1:2]
        return np.concatenate((positions[:, :2], positions[:, 2:] - rise), axis=1)


def physics_of(model: BallModel) -> SegmentationPhysics:
    """The physics of a model, analytic or learned, from its values at a few states without spin.

    Gravity, offset and slope of the surfaces come from a ball that hangs still, here and 1 m away; drag is the
    least-squares k over horizontal flight in four directions; restitution and friction are means over bounces. A value
    outside `BOUNDS`, which a learned model may give outside of its training data, is that of a table-tennis ball.

    Args: model: any `BallModel`; it is neither changed nor differentiated.
    """
    known = _known.get(model)
    if known is None and _is_substituted(model):
        return _asked(model)
    numbers = numbers_of(model)
    stamp = numbers.stamp()
    if known is None or known[0] != stamp:
        known = _known[model] = stamp, numbers.tables(), _asked(model)
    return known[2]


_known: weakref.WeakKeyDictionary[BallModel, tuple[Hashable, Sequence[Any], SegmentationPhysics]]
_known = weakref.WeakKeyDictionary()
"""For each model: the stamp of its numbers, its tables, and the result."""


def _is_substituted(model: BallModel) -> bool:
    if type(model) is KeptModel:
        return False
    from ballfg.dynamics.model import is_substituted

    return is_substituted(model)


def _asked(model: BallModel) -> SegmentationPhysics:
    still = np.zeros((1, STATE_DIM))
    still[:, Z] = 1.0
    offset, *slope = _surface(model, still)
    restitution, friction = _bounce_coefficients(model, still, slope)
    gravity, drag = -float(acceleration(model, still)[0, 2]), _drag_coefficient(model, still)
    values = dict(zip(BOUNDS, (gravity, drag, restitution, friction, model.radius, offset, *slope), strict=True))
    return SegmentationPhysics(**{n: v for n, v in values.items() if BOUNDS[n][0] <= v <= BOUNDS[n][1]})


def _drag_coefficient(model: BallModel, still: Array) -> float:
    """1/m, least-squares k in a . v = -k |v|^3 over four directions and `PROBE_SPEEDS`."""
    speeds = np.repeat(PROBE_SPEEDS, 4)
    headings = np.arange(len(speeds)) * (math.pi / 2)
    flying = np.tile(still, (len(speeds), 1))
    flying[:, VELOCITY] = np.stack((np.cos(headings) * speeds, np.sin(headings) * speeds, 0 * speeds), axis=-1)
    pull = (acceleration(model, flying) * flying[:, VELOCITY]).sum(axis=-1)
    return -float((pull * speeds**3).sum() / (speeds**6).sum())


def _surface(model: BallModel, still: Array) -> list[float]:
    """m, the offset of surfaces at the origin, and by how much it grows over 1 m along x and along y."""
    places = np.tile(still, (3, 1))
    places[1, 0] = places[2, 1] = 1.0
    here, *there = surface_offsets(model, places).tolist()
    return [here, *(offset - here for offset in there)]


def _bounce_coefficients(model: BallModel, still: Array, slope: Sequence[float]) -> tuple[float, float]:
    """Restitution and friction: normal and tangential impulse of fast sliding bounces at `PROBE_FALLS`."""
    falls = np.array(PROBE_FALLS)
    normal, along = np.array([-slope[0], -slope[1], 1.0]), np.array([1.0, 0.0, slope[0]])
    normal, along = normal / np.linalg.norm(normal), along / np.linalg.norm(along)
    falling = np.tile(still, (len(falls), 1))
    falling[:, VELOCITY] = PROBE_SLIDE * along - falls[:, None] * normal
    after = bounced(model, falling)[:, VELOCITY]
    up, slid = (after * normal).sum(axis=-1), PROBE_SLIDE - (after * along).sum(axis=-1)
    return float((up / falls).mean()), float((slid / (up + falls)).mean())
