"""Gives the parameters of a ball's low hops: which ones are low, how they rebound, and the grid that follows them."""

from __future__ import annotations

from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.kept_model import augmented
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.dynamics.motion.arrays import acceleration, bounced, gaps
from ballfg.dynamics.motion.limits import REST_SPEED
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.second_look.hop_grid import HopGrid, HopLaw
from ballfg.state import POSITION, STATE_DIM, VZ, Z

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

LOW: Final = 10.0
"""Standard deviations of the noise. The segmentation distinguishes the bounces of higher hops."""
LOWEST: Final = 0.02
"""m. Lower hops it does not distinguish whatever the noise: it assumes an error of 4 mm in surface heights."""
LEAST_PHASES, MOST_PHASES = 48, 192
"""Number of cells in a hop: if possible so many that the ball moves by no more than its noise within one."""


def most_height(sigma: float) -> float:
    """m, height of the highest low hop, for the noise of the heights in m."""
    return max(LOWEST, LOW * sigma)


def hop_time(height: float, gravity: float) -> float:
    """s, duration of a hop to a height in m; infinite for a ball that does not come down."""
    return 2.0 * float(np.sqrt(2.0 * height / gravity)) if gravity > 0.0 else np.inf


class HoppingBall:
    """A hopping ball whose model gives the parameters of hops, with their uncertainty."""

    def __init__(self, model: BallModel, settings: Settings) -> None:
        names = tuple(settings.coefficients)
        self.model = augmented(model, names)
        self.means = np.array([numbers_of(model).value(name) for name in names])
        self.sigmas, self.process = np.array(list(settings.coefficients.values())), settings.process

    def gap(self, positions: Array, height: float) -> Array:
        """(n,) m, from the surface up to the ball, at positions (n, 3) m."""
        return gaps(self.model, self._still(positions, self.means), height)

    def level_sigma(self, position: Array, height: float) -> float:
        """m, standard deviation of the surface's height. Args: position: (3,) m.  height: m, as declared."""
        varied = gaps(self.model, self._varied(position), height)
        return float(np.linalg.norm(varied[1:] - varied[0]))

    def gravity(self, position: Array) -> float:
        """m/s^2, downwards, of a ball that hangs still at a position (3,) m."""
        return -float(acceleration(self.model, self._still(position[None], self.means))[0, Z])

    def level_spread(self, position: Array, height: float) -> float:
        """m, the same, but no less than the error of any surface."""
        return max(self.level_sigma(position, height), SegmentationSettings().surface_sigma)

    def grid(self, position: Array, most: float, sigma: Array) -> HopGrid:
        """The grid of hops up to `most` m at a position (3,) m, for samples with the noise sigma (n,) m."""
        law = self.law(position, most, self.gravity(position))
        phases = int(np.clip(4.0 * most / np.median(sigma), LEAST_PHASES, MOST_PHASES))
        finest = 4.0 * most / phases
        tick = 0.25 * max(float(sigma.min()), finest) / law.fastest
        return HopGrid(law, phases, tick, finest)

    def law(self, position: Array, most: float, gravity: float) -> HopLaw:
        """Parameters of hops up to a height `most` m above a surface, at a position (3,) m."""
        varied = self._varied(position)
        fall = float(np.sqrt(2.0 * gravity * most))
        known = self._rebound(varied[:1], np.array([max(fall, 2.0 * REST_SPEED)]))[0, 0]
        speeds = HopLaw.speeds(max(fall * fall / max(float(known), 0.5 * fall), 2.0 * REST_SPEED))
        rebound = self._rebound(varied, speeds)
        scatter = np.sqrt(self.process.contact_velocity**2 + ((rebound[1:] - rebound[0]) ** 2).sum(axis=0))
        slower = np.clip(rebound[0], 0.0, speeds)
        return HopLaw(gravity, float(speeds[-1]), slower, scatter, self.process.acceleration)

    def _rebound(self, states: Array, speeds: Array) -> Array:
        """(m, k) m/s, vertical speeds after impacts with each of k speeds, for balls in m states."""
        falling = np.repeat(states[:, None], len(speeds), axis=1)
        falling[..., VZ] = -speeds
        return bounced(self.model, falling.reshape(-1, falling.shape[-1]))[:, VZ].reshape(len(states), -1)

    def _varied(self, position: Array) -> Array:
        """(1 + p, 9 + p) a ball that hangs still: as is, then with each coefficient raised by its sigma."""
        rows = np.concatenate((np.zeros((1, len(self.means))), np.diag(self.sigmas)))
        return self._still(np.tile(position, (len(rows), 1)), self.means + rows)

    @staticmethod
    def _still(positions: Array, coefficients: Array) -> Array:
        states = np.zeros((len(positions), STATE_DIM + coefficients.shape[-1]))
        states[:, POSITION], states[:, STATE_DIM:] = positions, coefficients
        return states
