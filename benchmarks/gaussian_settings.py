"""Defines settings for Gaussian noise of known size, and process noise that is equal at every step."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation import Settings
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise


def gaussian_settings(
    position: float, process: ProcessNoise, spin_label: float, coefficients: Mapping[str, float] | None = None
) -> Settings:
    """Settings with squared losses that look for no events but contacts.

    Args:
        position: m.  process: noise of the motion.  spin_label: rad/s.
        coefficients: prior standard deviations of coefficients to estimate with each track; None: none.
    """
    squared = Loss("squared")
    return Settings(
        position_noise=(position,) * 3,
        process=process,
        spin_label_noise=spin_label,
        loss=squared,
        spin_loss=squared,
        label_loss=squared,
        find_events=False,
        coefficients=coefficients or {},
    )


@dataclass(frozen=True)
class StepNoise(ProcessNoise):
    """A diagonal covariance per step, whatever the step's length; only spin keeps its density.

    For comparisons on one frame rate only: on dropped frames it would be another model.
    """

    step_position: float = 0.001  # m, standard deviation of each coordinate gathered in one step
    step_velocity: float = 0.01  # m/s, of each velocity component

    def flight_along_one(self, dt: Array) -> Array:
        """(n, 3, 3) covariance along one axis gathered in one step of flight; dt (n,) s matters to the spin only."""
        variance = np.empty((len(dt), 3))
        variance[:, 0], variance[:, 1], variance[:, 2] = self.step_position**2, self.step_velocity**2, self.spin**2 * dt
        return variance[:, :, None] * np.eye(3)
