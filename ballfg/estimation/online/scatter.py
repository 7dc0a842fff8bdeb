"""The white noise that a stream shows, where nobody states one."""

import copy
from typing import Final, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.tracks import Track

LOOKED: Final = (7, 10, 14, 20, 28, 40, 56, 80, 112)
"""Numbers of samples after which the scatter is looked at: each time it is known a fifth better."""
CHANGED: Final = 1.5
"""Ratio of noises from which the stream is explained anew with the later one."""


class StreamScatter:
    """The standard deviation of a stream's positions as its first samples show it.

    Args: sigma: (3,) m, that counts until then.
    Attributes: sigma: (3,) m, along x, y, z.
    """

    def __init__(self, sigma: Array) -> None:
        self.sigma = sigma
        self._times: list[float] = []
        self._positions: list[Array] = []

    def copy(self) -> Self:
        """An independent one; `sigma` stays the same array, by which samples that have it are known."""
        other = copy.copy(self)
        other._times, other._positions = self._times.copy(), self._positions.copy()
        return other

    @property
    def known(self) -> bool:
        """True if later samples change it no more."""
        return len(self._times) >= LOOKED[-1]

    def take(self, time: float, position: Array) -> bool:
        """Takes in a sample at a time (s) and position (3,) (m); True if the noise is clearly another one since."""
        if self.known:
            return False
        self._times.append(time)
        self._positions.append(position)
        if len(self._times) not in LOOKED:
            return False
        found = estimate_position_noise([Track(np.array(self._times), np.array(self._positions), part=True)])
        if np.abs(np.log(found / self.sigma)).max() < np.log(CHANGED):
            return False
        self.sigma = found
        return True
