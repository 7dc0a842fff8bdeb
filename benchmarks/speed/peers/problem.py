"""Defines the common problem: positions, velocities and one spin from noisy positions of a flight.

Unknowns of a track of n samples: positions and velocities (n, 3) each and one spin (3,). Residuals over a step:
[p1 - p - dt v - dt^2/2 a, v1 - v - dt a] with a taken at the step's begin; positions; the labelled spin. The
acceleration is a formula, or a network with two hidden layers of tanh. Runs in any environment that has numpy.
"""

from dataclasses import dataclass, fields
from pathlib import Path

import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


@dataclass(frozen=True)
class Problem:
    """Tracks of one ball, whose laws are known.

    Attributes:
        measured: (t, n, 3) m.  label: (t, 3) rad/s, the labelled spins.  dt: () s between samples.
        position_sigma: () m.  label_sigma: () rad/s.  step_sigma: (6,) m and m/s.
        gravity: (3,) m/s^2.  drag, magnus: () of a = g - drag |v| v + magnus (spin x v); 1/m, dimensionless.
        w1, b1, w2, b2, w3, b3: weights (out, in) and biases (out,) of a = w3 tanh(w2 tanh(w1 x + b1) + b2) + b3 with x
            = [v, spin, spin x v]; empty where the formula holds.
        flight: (9,) state m, m/s, rad/s that rollouts begin with.
    """

    measured: Array
    label: Array
    dt: Array
    position_sigma: Array
    label_sigma: Array
    step_sigma: Array
    gravity: Array
    drag: Array
    magnus: Array
    w1: Array
    b1: Array
    w2: Array
    b2: Array
    w3: Array
    b3: Array
    flight: Array

    @property
    def layers(self) -> list[tuple[Array, Array]]:
        """Weights and biases of the network; empty where the formula holds."""
        return [(self.w1, self.b1), (self.w2, self.b2), (self.w3, self.b3)] if self.w1.size else []

    def start(self) -> tuple[Array, Array, Array]:
        """Positions and velocities (t, n, 3) m, m/s, from differences over five samples; spins (t, 3) rad/s."""
        n = self.measured.shape[1]
        first = np.clip(np.arange(n) - 2, 0, n - 5)
        velocity = (self.measured[:, first + 4] - self.measured[:, first]) / (4.0 * self.dt)
        return self.measured.copy(), velocity, self.label.copy()

    def save(self, path: Path) -> None:
        """Write to an .npz file."""
        np.savez(path, **{field.name: getattr(self, field.name) for field in fields(self)})

    @classmethod
    def load(cls, path: Path | str) -> "Problem":
        """Read what `save` wrote."""
        with np.load(path) as file:
            return cls(**{name: file[name] for name in file.files})


ROLLOUT_STEPS = 300  # Runge-Kutta steps of a rollout, of `Problem.dt` each
LOSS_STEPS = 60
"""Explicit steps from the last state on, after which the square of the position is the loss of the gradient problem."""
