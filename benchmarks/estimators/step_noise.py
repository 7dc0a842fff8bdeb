"""Process noise with the same covariance at every step, as papers and other solvers have it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

Array = NDArray[np.float64]


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
