"""Everything that stays the same during a segmentation: the ball, the surfaces, the settings."""

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.settings import SegmentationSettings


@dataclass(frozen=True)
class Scene:
    """Ball, surfaces and settings.

    Attributes:
        centres: (s,) m, height of the ball's centre when it touches each surface, table first.
        restitution_sigmas: (s,).
        log_shares: (3,) log prior of good, wide and outlying samples.
        drift: (3, 3, 3) process noise of (p, v, b) per dt, dt^2, dt^3.
        numbers: (11,) what machine code takes of the ball and the settings, see `kernels`.
    """

    physics: SegmentationPhysics
    surfaces: Surfaces
    settings: SegmentationSettings
    centres: Array = field(init=False)
    restitution_sigmas: Array = field(init=False)
    log_shares: Array = field(init=False)
    drift: Array = field(init=False)
    numbers: Array = field(init=False)

    def __post_init__(self) -> None:
        heights = np.array(self.surfaces.heights())
        object.__setattr__(self, "centres", heights + self.physics.surface_offset + self.physics.radius)
        sigmas = np.full(len(heights), self.settings.floor_restitution_sigma)
        sigmas[0] = self.settings.restitution_sigma
        object.__setattr__(self, "restitution_sigmas", sigmas)
        wide, out = self.settings.wide_share, self.settings.outlier_share
        object.__setattr__(self, "log_shares", np.log([1.0 - wide - out, wide, out]))
        drift = np.zeros((3, 3, 3))
        walk = self.settings.velocity_drift**2
        drift[0, 1, 1], drift[0, 2, 2] = walk, self.settings.slack_drift**2
        drift[1, 0, 1] = drift[1, 1, 0] = walk / 2.0
        drift[2, 0, 0] = walk / 3.0
        object.__setattr__(self, "drift", drift)
        physics, s = self.physics, self.settings
        noise = (s.stamp_jitter, s.wide_factor, s.outlier_spread, s.outlier_doubt)
        search = (s.surprise, s.contact_window, s.margin, s.mature, s.most)
        object.__setattr__(
            self, "numbers", np.array([physics.drag, physics.gravity, *noise, *search], dtype=np.float64)
        )

    def height(self, surface: int) -> float:
        """m, declared height of a surface."""
        return self.surfaces.heights()[surface]

    def reaches(self, surface: int, places: Array) -> NDArray[np.bool_]:
        """(h,) whether x, y (h, 2) m lie within a surface, as far as is known."""
        extent = self.surfaces.extent
        if surface != 0 or extent is None:
            return np.ones(len(places), dtype=bool)
        margin = self.settings.extent_margin
        x, y = places[:, 0], places[:, 1]
        inside = (x >= extent[0] - margin) & (x <= extent[1] + margin)
        return inside & (y >= extent[2] - margin) & (y <= extent[3] + margin)
