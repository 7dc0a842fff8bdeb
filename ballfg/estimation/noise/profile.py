"""Computes the confidence limits of each number from its profile, with all other numbers refitted.

The curvature at a minimum gives them only if the objective is a parabola. For a noise that is small beside another one
it is not: the data bound it from above, hardly from below. So the profile, the objective with all other numbers at
their best, is followed until it has risen by one standard deviation's worth (D. R. Cox, D. V. Hinkley, "Theoretical
Statistics", 1974, section 9.3).
"""

from collections.abc import Callable
from typing import Final

import numpy as np

from ballfg.arrays import Array

DIFFERENCE: Final = 0.02
"""Step of a logarithm for second derivatives."""
HONEST: Final = 1.25
"""The search along the profile ends within this factor of its target, in standard deviations."""
MOST_LOOKS: Final = 4
"""Number of distances to try on each side."""
LONGEST_LOOK: Final = 3.0
"""Largest ratio between two successive distances."""
SETTLED: Final = 0.25
"""Largest derivative of the refitted numbers, in their standard deviations: the objective is then right to some
hundredths. On a parabola, one evaluation shows it."""
MOVED: Final = 0.3
"""Standard deviations by which the minimum may move without new second derivatives."""
MOST_EVALUATIONS: Final = 15
"""Largest number of evaluations in a refit."""

Objective = Callable[[Array], tuple[float, Array]]
"""A negative log posterior of logarithms (k,), and its derivatives (k,)."""


class Profile:
    """The minimum of an objective that is a sum over independent tracks and a prior, with confidence limits.

    With H the second derivatives of the objective, G the sum over tracks of the squares of their derivatives and P the
    precision of the prior, the covariance of the minimum is H^-1 (G + P) H^-1: forecasts of one track need not be
    independent (P. J. Huber 1967; clusters: K.-Y. Liang, S. L. Zeger 1986).

    Args:
        value: the objective.
        scatter: G (k, k) at logarithms (k,).
        begin: (k,) near the minimum.
        spread: (k,) standard deviations of the prior.
        low, high: (k,) bounds.

    Attributes:
        best: (k,) the minimum.
        covariance: (k, k) of the minimum.
    """

    def __init__(
        self, value: Objective, scatter: Callable[[Array], Array], begin: Array, spread: Array, low: Array, high: Array
    ) -> None:
        self.value, self.spread, self.low, self.high = value, spread, low, high
        self.inverse = self._inverse(begin)
        self.least, self.best = self._settled(begin, self.inverse)
        if (np.abs(self.best - begin) > MOVED * np.sqrt(np.diagonal(self.inverse))).any():
            self.inverse = self._inverse(self.best)
            self.least, self.best = self._settled(self.best, self.inverse)
        self.covariance = self.inverse @ (scatter(self.best) + np.diag(spread**-2)) @ self.inverse

    def sides(self) -> Array:
        """(k, 2) distances below and above the best, one standard deviation each.

        If tracks scatter more than the curvature says, a standard deviation is worth more accordingly. If they scatter
        less it is not worth less: a common pull away from the truth, such as the prior's, is no scatter.
        """
        return np.array([[self._side(k, sign) for sign in (-1.0, 1.0)] for k in range(len(self.best))])

    def _inverse(self, logs: Array) -> Array:
        """(k, k) inverse of the second derivatives; that of the prior alone where these bend downwards."""
        hessian = np.empty((len(logs), len(logs)))
        for k, step in enumerate(DIFFERENCE * np.eye(len(logs))):
            hessian[k] = (self.value(logs + step)[1] - self.value(logs - step)[1]) / (2.0 * DIFFERENCE)
        values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        return np.asarray((vectors / np.maximum(values, self.spread.max() ** -2)) @ vectors.T)

    def _side(self, k: int, sign: float) -> float:
        """Distance of number k at which the profile has risen by half the square of a deviation's worth."""
        deviation = float(np.sqrt(max(self.covariance[k, k], self.inverse[k, k])))
        worth, distance = deviation / float(np.sqrt(self.inverse[k, k])), deviation
        toward = self.inverse[:, k] / self.inverse[k, k]
        others = self.inverse - np.outer(toward, self.inverse[k])  # inverse of the second derivatives by all but k
        for _ in range(MOST_LOOKS):
            profile, _ = self._settled(self.best + sign * distance * toward, others)
            risen = float(np.sqrt(max(2.0 * (profile - self.least), 0.0)))
            factor = float(np.clip(worth / max(risen, 1e-9), 1.0 / LONGEST_LOOK, LONGEST_LOOK))
            distance *= factor
            if 1.0 / HONEST < factor < HONEST:
                break
        return distance

    def _settled(self, begin: Array, inverse: Array) -> tuple[float, Array]:
        """The least objective near some logarithms, and its place; numbers without a share in `inverse` stay."""
        values, vectors = np.linalg.eigh(inverse)
        turn = vectors * np.sqrt(values.clip(min=0.0))  # in these units the second derivatives are one

        def at(way: Array) -> Array:
            return np.asarray(np.clip(begin + turn @ way, self.low, self.high))

        def objective(way: Array) -> tuple[float, Array]:
            value, gradient = self.value(at(way))
            return value, turn.T @ gradient

        options = {"gtol": SETTLED, "ftol": 0.0, "maxfun": MOST_EVALUATIONS}
        from scipy.optimize import minimize  # it takes half a second to import

        found = minimize(objective, np.zeros(len(begin)), jac=True, method="L-BFGS-B", options=options)
        return float(found.fun), at(found.x)
