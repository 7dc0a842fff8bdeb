"""Damped steps to more probable common unknowns, within their bounds, of a density that is about quadratic."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.evidence.likelihood import Posterior
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.system import bounded_step

FIRST_DAMPING, DAMPED, LESS = 0.1, 10.0, 4.0
"""Damping of a step after a whole one that failed, its factor after a further failure, its divisor after a success."""
HARDLY, MOSTLY = 0.25, 0.75
"""Shares of a step's expected gain: with less it fails, with more the next one is damped less."""


@dataclass(frozen=True)
class Ahead:
    """The density of the tracks about the common unknowns of a fit, as far as it is quadratic.

    Patterns are no unknowns of the fit: at its new values they are as free as before.

    Attributes:
        information, slope: (c, c) and (c,) of its logarithm.
        limits: smallest and largest step (c,).
        damping: of the next step, as in `bounded_step`.
    """

    information: Array
    slope: Array
    limits: tuple[Array, Array]
    damping: float = 0.0

    @classmethod
    def of(cls, fit: Fit, found: Posterior) -> "Ahead":
        """From the posterior about a fit."""
        own = len(fit.problem.common_precision)
        information: Array = np.asarray(np.linalg.inv(found.covariance[:own, :own]), dtype=np.float64)
        return cls(information, information @ found.mean[:own], fit.limits)

    def step(self, damping: float) -> tuple[Array, float]:
        """(c,) a step within the limits, and the logarithm of the density that it should gain."""
        step = bounded_step(self.information, self.slope, *self.limits, damping)
        return step, float(step @ (self.slope - 0.5 * self.information @ step))

    @property
    def gain(self) -> float:
        """What the whole step should gain."""
        return self.step(0.0)[1]


def next_damping(damping: float, share: float) -> float:
    """The damping of the step after one that gained a share of what it promised."""
    if share < MOSTLY:
        return damping
    return damping / LESS if damping > FIRST_DAMPING / LESS else 0.0
