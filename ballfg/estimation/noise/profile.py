"""How well each number is known: how far it can go until the best that the others can do about it is too little.

The curvature at a minimum tells it where the objective is a parabola. Of a noise that is small beside another one it is
not: upwards it is soon contradicted, downwards hardly ever, and the curvature knows of neither. So the profile is
followed, the objective with all other numbers at their best, to where it has risen by what one standard deviation is
worth (D. R. Cox, D. V. Hinkley, "Theoretical Statistics", 1974, section 9.3).
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import numpy as np

from ballfg.arrays import Array

DIFFERENCE: Final = 0.02
"""Step of a logarithm for second derivatives."""
HONEST: Final = 1.25
"""The profile is not followed further where it is at what is looked for within this factor, in standard deviations."""
MOST_LOOKS: Final = 4
"""Distances that are tried to each side."""
LONGEST_LOOK: Final = 3.0
"""By how much a look may be farther or nearer than the one before."""
SETTLED: Final = 0.25
"""Largest derivative where others are at their best, in their standard deviations: the objective is then right to some
hundredths. Where it is a parabola, one evaluation shows it."""
MOVED: Final = 0.3
"""Standard deviations by which the minimum may move without new second derivatives."""
MOST_EVALUATIONS: Final = 15
"""After these the others follow no further."""

Objective = Callable[[Array], tuple[float, Array]]
"""A negative log posterior of logarithms (k,), and its derivatives (k,)."""


class Profile:
    """What is known about the minimum of an objective that is a sum over independent tracks and a prior.

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
        best: (k,) where the objective is least.
        covariance: (k, k) of that.
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

        Where tracks scatter more than the curvature says, a standard deviation is worth more by that. Where they
        scatter less it is not worth less: what pulls all of them away from the truth, as the prior does, is no scatter.
        """
        return np.array([[self._side(k, sign) for sign in (-1.0, 1.0)] for k in range(len(self.best))])

    def _inverse(self, logs: Array) -> Array:
        """(k, k) inverse of the second derivatives; where these bend downwards the prior alone is what is known."""
        hessian = np.empty((len(logs), len(logs)))
        for k, step in enumerate(DIFFERENCE * np.eye(len(logs))):
            hessian[k] = (self.value(logs + step)[1] - self.value(logs - step)[1]) / (2.0 * DIFFERENCE)
        values, vectors = np.linalg.eigh(0.5 * (hessian + hessian.T))
        return np.asarray((vectors / np.maximum(values, self.spread.max() ** -2)) @ vectors.T)

    def _side(self, k: int, sign: float) -> float:
        """Distance of number k at which the profile has risen by half the square of what a deviation is worth."""
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
        """The least objective near some logarithms, and where; what has no share in `inverse` stays as it is."""
        values, vectors = np.linalg.eigh(inverse)
        turn = vectors * np.sqrt(values.clip(min=0.0))  # in these units the second derivatives are one

        def at(way: Array) -> Array:
            return np.asarray(np.clip(begin + turn @ way, self.low, self.high))

        def told(way: Array) -> tuple[float, Array]:
            value, gradient = self.value(at(way))
            return value, turn.T @ gradient

        options = {"gtol": SETTLED, "ftol": 0.0, "maxfun": MOST_EVALUATIONS}
        from scipy.optimize import minimize  # it takes half a second to import

        found = minimize(told, np.zeros(len(begin)), jac=True, method="L-BFGS-B", options=options)
        return float(found.fun), at(found.x)
