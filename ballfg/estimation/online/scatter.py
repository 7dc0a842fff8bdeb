"""The white noise that a stream shows, where nobody states one."""

import copy
from collections import deque
from typing import Final, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.measurement.position_noise import LEAST_HALF_WINDOW, MAD_VARIANCE, estimate_position_noise
from ballfg.tracks import Track

LOOKED: Final = (7, 10, 14, 20, 28, 40, 56, 80, 112)
"""Numbers of samples after which the scatter is looked at: each time it is known a fifth better."""
CHANGED: Final = 1.5
"""Ratio of noises from which the stream is explained anew with the later one."""
STILL: Final = 0.5  # m/s. A slower ball may be held or lie, where its noise may be another one than in flight
SURE: Final = 3.0  # Standard deviations of what few samples show, by which it differs from the noise that counts


class StreamScatter:
    """The standard deviation of a stream's positions as its first samples show it.

    A ball that lies before it flies shows another noise, or none if its tracker repeats positions: samples count anew
    from its first motion on, and later ones only while it moves.

    Args:
        sigma: (3,) m, that counts until then.
        trusted: True: earlier balls of the same tracker showed it; only what surely differs takes its place.

    Attributes:
        sigma: (3,) m, along x, y, z.
        found: (3,) m, the last that showed, also where it is close enough to `sigma` to leave that as it is.
    """

    def __init__(self, sigma: Array, trusted: bool = False) -> None:
        self.sigma = self.found = sigma
        self._trusted = trusted
        self._moved = False
        self._samples: list[tuple[float, Array]] = []
        self._newest = deque[tuple[float, Array]](maxlen=LOOKED[0])

    def copy(self) -> Self:
        """An independent one; `sigma` stays the same array, by which samples that have it are known."""
        other = copy.copy(self)
        other._samples, other._newest = self._samples.copy(), self._newest.copy()
        return other

    @property
    def known(self) -> bool:
        """True if later samples change it no more."""
        return self._moved and len(self._samples) >= LOOKED[-1]

    def take(self, time: float, position: Array) -> bool:
        """Takes in a sample at a time (s) and position (3,) (m); True if the noise is clearly another one since."""
        if self.known:
            return False
        self._newest.append((time, position))
        moves = self._moves()
        if moves and not self._moved:
            self._moved, self._samples = True, list(self._newest)
        elif moves or (not self._moved and len(self._samples) < LOOKED[-1]):
            self._samples.append((time, position))
        else:
            return False
        if len(self._samples) not in LOOKED:
            return False
        times, positions = map(np.array, zip(*self._samples, strict=True))
        found = estimate_position_noise([Track(times, positions, part=True)])
        windows = len(times) - 2 * LEAST_HALF_WINDOW
        clear = max(np.log(CHANGED), SURE * np.sqrt(MAD_VARIANCE / windows))
        differs = bool(np.abs(np.log(found / self.sigma)).max() >= clear)
        if differs or not self._trusted:
            self.found = found
        if differs:
            self.sigma, self._trusted = found, False
        return differs

    def _moves(self) -> bool:
        """Whether the newest samples are those of a moving ball."""
        (earlier, start), (later, end) = self._newest[0], self._newest[-1]
        full = len(self._newest) == LOOKED[0]
        return full and float(np.linalg.norm(end - start)) > STILL * (later - earlier)
