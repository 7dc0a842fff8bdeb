"""Settings for Gaussian noise of known size, and process noise that is the same at every step."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation import Settings
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY


def gaussian_settings(
    position: float, process: ProcessNoise, spin_label: float, coefficients: Mapping[str, float] | None = None
) -> Settings:
    """Settings with squared losses that look for no events but contacts.

    Args:
        position: m.  process: noise of the motion.  spin_label: rad/s.
        coefficients: prior standard deviations of those that are estimated with each track; none if left out.
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

    Attributes:
        step_position: m, standard deviation of each coordinate gathered in one step.
        step_velocity: m/s, of each velocity component.
    """

    step_position: float = 0.001
    step_velocity: float = 0.01

    def flight(self, dt: Array) -> Array:
        """(n, 9, 9) covariance gathered in one step of free flight; dt (n,) s matters to the spin only."""
        variance = np.empty((len(dt), STATE_DIM))
        variance[:, POSITION] = self.step_position**2
        variance[:, VELOCITY] = self.step_velocity**2
        variance[:, SPIN] = self.spin**2 * dt[:, None]
        return variance[:, :, None] * np.eye(STATE_DIM)
