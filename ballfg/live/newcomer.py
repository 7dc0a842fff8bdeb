"""A newcomer holds positions that may become a ball, without an estimator."""

from bisect import insort

import numpy as np

from ballfg.arrays import Array
from ballfg.live.ball import Kept
from ballfg.live.gate import Gate, Known

PATIENCE = 0.2  # s. A newcomer unseen for longer is forgotten.
SPEED = 12.0  # m/s per axis, spread of the velocity of a ball with one position
BEND = 12.0  # m/s^2, deviation of a path from a line through two positions


class Newcomer:
    """The first positions of a possible ball."""

    patience = PATIENCE

    def __init__(self, first: Kept, gate: Gate) -> None:
        self.samples = [first]
        self.gate = gate

    @property
    def last(self) -> float:
        """s, the newest stamp."""
        return self.samples[-1].time

    def has(self, time: float) -> bool:
        """True if it has a sample of that stamp."""
        return any(kept.time == time for kept in self.samples)

    def repeats(self, time: float, position: Array) -> bool:
        """True if it has exactly that sample."""
        return any(kept.time == time and np.array_equal(kept.position, position) for kept in self.samples)

    def take(self, kept: Kept) -> None:
        """Takes in a sample."""
        insort(self.samples, kept)

    def distances(self, time: float, positions: Array) -> Array:
        """(n,) squared Mahalanobis distances of positions (n, 3) m from its region at a time."""
        if abs(time - self.last) > PATIENCE:
            return np.full(len(positions), np.inf)
        return self.gate.on_path(self._known(), time, positions)

    def _known(self) -> Known:
        """A line through the first and the last sample, at the last."""
        first, last = self.samples[0], self.samples[-1]
        noise, dt = self.gate.noise, last.time - first.time
        mean, covariance = np.zeros(6), np.zeros((6, 6))
        mean[:3], covariance[:3, :3] = last.position, np.diag(noise)
        if dt > 0.0:
            mean[3:] = (last.position - first.position) / dt
            covariance[3:, 3:] = np.diag(2 * noise / dt**2 + (BEND * dt) ** 2)
            covariance[:3, 3:] = covariance[3:, :3] = np.diag(noise / dt)
        else:
            covariance[3:, 3:] = SPEED**2 * np.eye(3)
        return Known(last.time, mean, covariance)
