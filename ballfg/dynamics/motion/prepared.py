"""A model's motion, with what its machine code needs looked up once; by torch where it has none."""

import numpy as np
import torch

from ballfg.arrays import Array, plain
from ballfg.dynamics.compiled import motion
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.contact import fly_through_jacobian, gap_jacobian
from ballfg.dynamics.motion.integrate import fly_jacobian


class PreparedMotion:
    """The motion of balls in states (n, w), w = 9 + p with the coefficients that travel.

    Args: model: the ball, with the coefficients that it has now.  width: w.
    """

    def __init__(self, model: BallModel, width: int) -> None:
        functions = motion.functions_of(model)
        self.model = model
        self._moving = None if functions is None else motion.Moving(model, functions, np.empty((0, width)), width)

    def fly(self, start: Array, dt: float) -> tuple[Array, Array]:
        """States (n, w) after dt s of free flight, and their Jacobians (n, w, w)."""
        start, durations = plain(start), np.full(len(start), dt)
        if self._moving is None:
            after, jacobian = fly_jacobian(self.model, torch.from_numpy(start), torch.from_numpy(durations))
            return after.numpy(), jacobian.numpy()
        after, moved, _ = self._moving.travel(durations, np.empty((len(start), 0)), start)
        return after, moved

    def bounce(self, start: Array, dt: float, height: float) -> tuple[Array, Array, Array]:
        """States (n, w) after dt s with a contact with a surface (m) on the way, its times (n,) s, and the Jacobians.

        NaN for a ball that never comes down to it.
        """
        start, durations = plain(start), np.full(len(start), dt)
        if self._moving is None:
            given = (torch.from_numpy(start), torch.from_numpy(durations), (height,))
            after, times, jacobian = (found.numpy() for found in fly_through_jacobian(self.model, *given))
            return after, times[:, 0], jacobian
        after, moved, times = self._moving.travel(durations, np.full((len(start), 1), height), start)
        return after, times[:, 0], moved

    def gaps(self, states: Array, height: float) -> tuple[Array, Array]:
        """(n,) m from a surface (m) up to balls' lowest points, and the derivatives (n, w)."""
        if self._moving is None:
            gaps, slopes = gap_jacobian(self.model, torch.from_numpy(plain(states)), height)
            return gaps.numpy(), slopes.numpy()
        return self._moving.at(plain(states)).gaps(height)
