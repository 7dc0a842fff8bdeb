"""The control is a banded Gauss-Newton of one flight in numpy and scipy, bound by Python's own speed.

The same 80 observations as everywhere in the speed benchmark, discretised more simply: each step is one explicit step
of the acceleration, x_{k+1} = x_k + dt v_k + dt^2/2 a_k, v_{k+1} = v_k + dt a_k, up to 1 mm and 1 cm/s, and the spin is
one unknown. 483 numbers; the normal equations are a band with three columns more.
"""

from dataclasses import dataclass

import numpy as np
from scipy.linalg import solveh_banded

from ballfg.arrays import Array
from ballfg.state import STANDARD_GRAVITY

STEP_SIGMA = np.repeat((1e-3, 1e-2), 3)  # m and m/s, by which a step may be off
TOLERANCE = 1e-9  # Share of the largest number of its kind by which the last step changes any
MOST_STEPS = 20
BANDS = 12  # Diagonals of the normal matrix, its own and those above: a state of six and the next one


@dataclass(frozen=True)
class BandedProblem:
    """Positions of one flight, its laws known.

    Attributes:
        positions: (n, 3) m.  dt: s between them.  noise: m.  spin: (3,) rad/s, as labelled.  spin_noise: rad/s.
        drag, magnus: 1/m and dimensionless, of a = g - drag |v| v + magnus (spin x v).
    """

    positions: Array
    dt: float
    noise: float
    spin: Array
    spin_noise: float
    drag: float
    magnus: float

    def start(self) -> tuple[Array, Array]:
        """States (n, 6) from positions and their differences over five samples, m and m/s; the labelled spin (3,)."""
        n = len(self.positions)
        first = np.clip(np.arange(n) - 2, 0, n - 5)
        velocity = (self.positions[first + 4] - self.positions[first]) / (4.0 * self.dt)
        return np.concatenate((self.positions, velocity), axis=1), self.spin.copy()

    def solve(self) -> tuple[Array, Array, int]:
        """States (n, 6) m and m/s, spin (3,) rad/s at the minimum, and the Gauss-Newton steps that it took."""
        states, spin = self.start()
        for count in range(1, MOST_STEPS + 1):
            step, turn = self._step(states, spin)
            states, spin = states + step, spin + turn
            moved = np.abs(step).max(axis=0) / np.abs(states).max(axis=0)
            if max(moved.max(), np.abs(turn).max() / np.abs(spin).max()) < TOLERANCE:
                return states, spin, count
        raise RuntimeError(f"the banded Gauss-Newton did not converge in {MOST_STEPS} steps")

    def residuals(self, states: Array, spin: Array) -> tuple[Array, Array, Array]:
        """Whitened residuals: (n - 1, 6) of the steps, (n, 3) of the positions, (3,) of the spin."""
        v = states[:-1, 3:]
        speed = np.sqrt(np.einsum("ni,ni->n", v, v))[:, None]
        gravity = np.array((0.0, 0.0, -STANDARD_GRAVITY))
        acceleration = gravity - self.drag * speed * v + self.magnus * np.cross(spin, v)
        position = states[:-1, :3] + self.dt * v + 0.5 * self.dt**2 * acceleration
        after = np.concatenate((position, v + self.dt * acceleration), axis=1)
        steps = (states[1:] - after) / STEP_SIGMA
        return steps, (states[:, :3] - self.positions) / self.noise, (spin - self.spin) / self.spin_noise

    def _step(self, states: Array, spin: Array) -> tuple[Array, Array]:
        steps, seen, labelled = self.residuals(states, spin)
        by_first, by_spin = self._jacobians(states[:-1, 3:], spin)
        by_next = 1.0 / STEP_SIGMA
        n = len(states)
        own, next_one = np.zeros((n, 6, 6)), by_first.mT * by_next
        own[:-1] = by_first.mT @ by_first
        own[1:, range(6), range(6)] += by_next**2
        own[:, range(3), range(3)] += self.noise**-2
        gradient = np.zeros((n, 6))
        gradient[:-1] = (by_first.mT @ steps[..., None])[..., 0]
        gradient[1:] += by_next * steps
        gradient[:, :3] += seen / self.noise
        coupling = np.zeros((n, 6, 3))
        coupling[:-1] = by_first.mT @ by_spin
        coupling[1:] += by_next[:, None] * by_spin
        right = np.concatenate((gradient[..., None], coupling), axis=2).reshape(6 * n, 4)
        solved = solveh_banded(_band(own, next_one), right, lower=True, check_finite=False)
        shared = np.tensordot(by_spin, by_spin, axes=((0, 1), (0, 1))) + np.eye(3) * self.spin_noise**-2
        slope = np.einsum("nij,ni->j", by_spin, steps) + labelled / self.spin_noise
        flat = coupling.reshape(6 * n, 3)
        turn = -np.linalg.solve(shared - flat.T @ solved[:, 1:], slope - flat.T @ solved[:, 0])
        return -(solved[:, 0] + solved[:, 1:] @ turn).reshape(n, 6), turn

    def _jacobians(self, v: Array, spin: Array) -> tuple[Array, Array]:
        """Derivatives (m, 6, 6) of the whitened steps by the states that they begin at, and (m, 6, 3) by the spin."""
        speed = np.sqrt(np.einsum("ni,ni->n", v, v))[:, None, None]
        by_v = -self.drag * (speed * np.eye(3) + v[:, :, None] * v[:, None, :] / speed) + self.magnus * _cross(spin)
        by_w = -self.magnus * _cross(v)
        J, K = np.zeros((len(v), 6, 6)), np.empty((len(v), 6, 3))
        J[:, range(6), range(6)] = -1.0
        J[:, :3, 3:] = -self.dt * np.eye(3) - 0.5 * self.dt**2 * by_v
        J[:, 3:, 3:] -= self.dt * by_v
        K[:, :3], K[:, 3:] = -0.5 * self.dt**2 * by_w, -self.dt * by_w
        return J / STEP_SIGMA[:, None], K / STEP_SIGMA[:, None]


def _cross(vector: Array) -> Array:
    """(..., 3, 3) matrices M with M x = vector x x."""
    result = np.zeros((*vector.shape, 3))
    result[..., 0, 1], result[..., 0, 2], result[..., 1, 2] = -vector[..., 2], vector[..., 1], -vector[..., 0]
    return result - result.mT


def _band(own: Array, next_one: Array) -> Array:
    """(12, 6 n) lower band of a block tridiagonal matrix: its diagonal (n, 6, 6), and (n - 1, 6, 6) above that."""
    n = len(own)
    columns = np.zeros((n, 6, BANDS))  # of each column the entries from the diagonal down
    for j in range(6):
        columns[:, j, : 6 - j] = own[:, j:, j]
        columns[:-1, j, 6 - j : 12 - j] = next_one[:, j]
    return columns.reshape(6 * n, BANDS).T
