"""Holds the constants of a segmentation for machine code: the ball, the surfaces, the settings."""

from dataclasses import dataclass, field, fields
from typing import Any, Final

import numpy as np
from numba import from_dtype

from ballfg.dynamics.compiled.flight import white_acceleration
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation.bank import SURFACE, Record, Records
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.settings import SegmentationSettings

NUMBERS: Final = np.dtype(
    [
        *((one.name, np.float64) for one in (*fields(SegmentationPhysics), *fields(SegmentationSettings))),
        ("log_shares", np.float64, (3,)),
        ("drift", np.float64, (3, 3, 3)),
        ("extent", np.float64, (4,)),
    ]
)
"""The fields of `SegmentationPhysics` and of `SegmentationSettings` in their units, and derived numbers.

- log_shares: log prior of good, wide and outlying samples.  drift: process noise of (p, v, b) per dt, dt^2, dt^3.
- extent: m, (x low, x high, y low, y high) within which a contact with the table is tried.
"""
SCENE: Final[Any] = from_dtype(NUMBERS)


@dataclass(frozen=True)
class Scene:
    """Ball, surfaces and settings.

    Attributes: numbers: one row of `NUMBERS`.  rows: (s,) of `SURFACE`, one a surface, table first.
    """

    physics: SegmentationPhysics
    surfaces: Surfaces
    settings: SegmentationSettings
    numbers: Record = field(init=False)
    rows: Records = field(init=False)

    def __post_init__(self) -> None:
        s, drift = self.settings, np.zeros((3, 3, 3))
        drift[2, 0, 0], drift[1, 0, 1], drift[0, 1, 1] = white_acceleration(1.0, s.velocity_drift**2)
        drift[1, 1, 0], drift[0, 2, 2] = drift[1, 0, 1], s.slack_drift**2
        shares = np.log([1.0 - s.wide_share - s.outlier_share, s.wide_share, s.outlier_share])
        extent = np.array((-np.inf, np.inf, -np.inf, np.inf) if (known := self.surfaces.extent) is None else known)
        extent += s.extent_margin * np.array((-1.0, 1.0, -1.0, 1.0))
        own = (getattr(part, one.name) for part in (self.physics, s) for one in fields(part))
        numbers = np.array([(*own, shares, drift, extent)], dtype=NUMBERS)
        object.__setattr__(self, "numbers", numbers[0])

        heights = np.array(self.surfaces.heights())
        rows = np.zeros(len(heights), dtype=SURFACE)
        rows["centre"] = heights + self.physics.surface_offset + self.physics.radius
        rows["restitution_sigma"] = s.floor_restitution_sigma
        rows["restitution_sigma"][0] = s.restitution_sigma
        object.__setattr__(self, "rows", rows)

    def height(self, surface: int) -> float | None:
        """m, declared height of a surface; None for -1."""
        return None if surface < 0 else self.surfaces.heights()[surface]
