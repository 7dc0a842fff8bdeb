"""Learns the map from a launcher's settings to the first states of its shots.

Place, speed, azimuth, elevation and spin of a first state are linear in the settings. The spin is that about forward,
across and up, so that it turns along with the launcher.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.problem import launch_axes
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

SPARE = 2  # Number of shots beyond one for each parameter of the line; fewer do not show the scatter about it
LEAST_SHARE = 1e-8
"""Smallest over largest eigenvalue of the settings' correlations: below, settings changed together only."""


@dataclass(frozen=True)
class LauncherMap:
    """First states as a linear function of the settings.

    Attributes:
        names: of s settings, as in labels.
        weights: (s + 1, 9) of a constant and the settings, for place (m), speed (m/s), azimuth and elevation (rad), and
            spin about forward, across and up (rad/s).
        scatter: (9,) standard deviations of the shots about the line, in the same units.
        low, high: (s,) limits of the measured settings.
    """

    names: tuple[str, ...]
    weights: Array
    scatter: Array
    low: Array
    high: Array

    def states(self, settings: Array) -> Array:
        """(m, 9) first states of shots with settings (m, s)."""
        launches = np.column_stack((np.ones(len(settings)), settings)) @ self.weights
        speed, azimuth, elevation = launches[:, 3:6].T
        states = launches.copy()
        level = speed * np.cos(elevation)
        states[:, 3:6] = np.stack((level * np.cos(azimuth), level * np.sin(azimuth), speed * np.sin(elevation)), axis=1)
        states[:, SPIN] = (launch_axes(states) @ launches[:, 6:, None])[..., 0]
        return np.asarray(states)

    def outside(self, settings: Array) -> list[str]:
        """A sentence for each setting whose candidates (m, s) exceed the measured ones."""
        least, most = settings.min(axis=0), settings.max(axis=0)
        return [
            f"{name} was shot from {self.low[i]:g} to {self.high[i]:g}; candidates from {least[i]:g} to {most[i]:g} "
            "continue the launcher's line beyond that"
            for i, name in enumerate(self.names)
            if least[i] < self.low[i] or most[i] > self.high[i]
        ]


def learn_launcher(names: Sequence[str], settings: Array, states: Array) -> LauncherMap:
    """Fits the line through the first states (n, 9) of shots with settings (n, s) of these names.

    Raises: ValueError: too few shots, or settings that did not change independently of each other.
    """
    count, needed = len(settings), settings.shape[1] + 1 + SPARE
    if count < needed:
        raise ValueError(
            f"the dataset must hold at least {needed} shots with the labels {', '.join(names)}, to learn what they do; "
            f"got {count}. Shoot more."
        )
    still = [name for name, column in zip(names, settings.T, strict=True) if np.ptp(column) == 0.0]
    if still:
        raise ValueError(
            f"label {still[0]} must change from shot to shot, or nobody knows what it does; all shots have "
            f"{settings[0, list(names).index(still[0])]:g}. Leave it out of the candidates."
        )
    scaled = (settings - settings.mean(axis=0)) / settings.std(axis=0)
    values = np.linalg.eigvalsh(scaled.T @ scaled)
    if values[0] < LEAST_SHARE * values[-1]:
        raise ValueError(
            f"labels {', '.join(names)} must change independently of each other; in these shots some change together "
            "only. Name fewer of them."
        )
    velocity, launches = states[:, VELOCITY], np.zeros((count, STATE_DIM))
    mean = np.arctan2(velocity[:, 1].sum(), velocity[:, 0].sum())  # near which azimuths stay
    turned = np.arctan2(velocity[:, 1], velocity[:, 0]) - mean
    azimuth = mean + np.arctan2(np.sin(turned), np.cos(turned))
    elevation = np.arctan2(velocity[:, 2], np.hypot(velocity[:, 0], velocity[:, 1]))
    launches[:, POSITION] = states[:, POSITION]
    launches[:, 3:6] = np.stack((np.linalg.norm(velocity, axis=1), azimuth, elevation), axis=1)
    launches[:, 6:] = (launch_axes(states).swapaxes(-1, -2) @ states[:, SPIN, None])[..., 0]
    design = np.column_stack((np.ones(count), settings))
    weights, *_ = np.linalg.lstsq(design, launches, rcond=None)
    scatter = np.sqrt(((launches - design @ weights) ** 2).sum(axis=0) / (count - design.shape[1]))
    return LauncherMap(
        tuple(names), np.asarray(weights, dtype=np.float64), scatter, settings.min(axis=0), settings.max(axis=0)
    )
