"""Fits the probability that an effect is named against its size, and its detection limit."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from scipy import optimize, special

from ballfg.arrays import Array

NAMED = 0.9  # Share of seeds from which on an effect of some size counts as named
SLOPE_PRIOR = 10.0
"""Standard deviation of the curve's slope about zero, in logits per unit of the size's logarithm. It makes the fit
exist where outcomes part cleanly; a curve of that slope goes from 10 to 90 % within a factor of 1.6."""
MIDDLE_PRIOR = 2.0
"""Standard deviation of the logarithm of the size at which the curve is at one half, about that of the sizes tried."""


@dataclass(frozen=True)
class Curve:
    """Probability to be named against size: a logistic function of the size's logarithm.

    Attributes:
        middle: logarithm of the size at one half.  slope: logits per unit of the logarithm.
        lowest, highest: sizes that were tried.
    """

    middle: float
    slope: float
    lowest: float
    highest: float

    def at(self, sizes: ArrayLike) -> Array:
        """(...) probabilities at some sizes (...)."""
        return np.asarray(special.expit(self.slope * (np.log(sizes) - self.middle)))

    @property
    def limit(self) -> float:
        """The size at `NAMED`; the lowest one tried where it lies below, infinite where it lies beyond the highest."""
        size = float(np.exp(self.middle + special.logit(NAMED) / self.slope)) if self.slope > 0.0 else np.inf
        return max(size, self.lowest) if size <= self.highest else np.inf


def power_curve(sizes: Sequence[float], outcomes: Sequence[bool]) -> Curve:
    """The most probable curve through outcomes at sizes.

    Args: sizes: (n,) positive.  outcomes: (n,) whether the effect was named.
    Raises: ValueError: if there is none.
    """
    if not outcomes:
        raise ValueError("outcomes must not be empty; got none. Run some sizes first.")
    logs, signs = np.log(sizes), np.where(outcomes, 1.0, -1.0)
    centre = float(logs.mean())

    def loss(parameters: Array) -> float:
        middle, slope = parameters[0], np.exp(parameters[1])
        fit = np.logaddexp(0.0, -signs * slope * (logs - middle)).sum()
        return float(fit + 0.5 * ((middle - centre) / MIDDLE_PRIOR) ** 2 + 0.5 * (slope / SLOPE_PRIOR) ** 2)

    starts = [(m, s) for m in (float(logs.min()), centre, float(logs.max())) for s in (0.0, 1.5)]
    tried = [optimize.minimize(loss, start, method="Nelder-Mead") for start in starts]
    middle, slope = min(tried, key=lambda t: float(t.fun)).x
    return Curve(float(middle), float(np.exp(slope)), float(min(sizes)), float(max(sizes)))
