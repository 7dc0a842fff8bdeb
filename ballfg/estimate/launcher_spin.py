"""Spin from launcher settings: what a launcher's levels mean in rad/s, for tracks whose spin nobody measured."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ballfg.estimate.sliding_window import window_velocities
from ballfg.tracks import SPIN_LABELS, Track

Array = NDArray[np.float64]

FIRST_SAMPLES = 10
"""The launch direction is the mean direction of flight over so many samples."""
LEAST_SPEED = 0.1
"""m/s of horizontal motion below which a launch has no direction."""


@dataclass(frozen=True)
class LauncherSpin:
    """Spin per level of the labels `topspin` and `sidespin`.

    Topspin turns about the horizontal axis across the flight (the top of the ball moves forward), sidespin about the
    vertical. How well the levels tell the spin is `Settings.spin_label_noise`.

    Attributes:
        topspin: rad/s per level.
        sidespin: rad/s per level.
    """

    topspin: float
    sidespin: float

    def spin(self, topspin: float, sidespin: float, velocity: Array) -> Array:
        """(3,) rad/s for two levels and a launch velocity (3,) m/s.

        Raises: ValueError: if the launch has no horizontal direction that topspin could be about.
        """
        speed = float(np.hypot(velocity[0], velocity[1]))
        if speed < LEAST_SPEED:
            raise ValueError(
                f"velocity must have a horizontal part of at least {LEAST_SPEED:g} m/s to give topspin an axis; "
                f"got {speed:g} m/s. Give spin_x, spin_y, spin_z labels instead."
            )
        across = np.array([-velocity[1], velocity[0], 0.0]) / speed
        return topspin * self.topspin * across + np.array([0.0, 0.0, sidespin * self.sidespin])

    def label(self, track: Track) -> Track:
        """The track with spin labels made from its launcher settings; as it is where it has spin labels or no settings.

        Raises: ValueError: if the track is too short or too slow to have a direction.
        """
        levels = [track.labels.get(name) for name in ("topspin", "sidespin")]
        if track.spin_label is not None or not all(isinstance(level, float) for level in levels):
            return track
        first = slice(0, FIRST_SAMPLES)
        velocity = window_velocities(track.times[first], track.positions[first]).mean(axis=0)
        spin = self.spin(float(levels[0] or 0.0), float(levels[1] or 0.0), velocity)
        return replace(track, labels={**track.labels, **dict(zip(SPIN_LABELS, spin.tolist(), strict=True))})
