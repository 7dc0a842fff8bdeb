"""Points at which a model is weighed, and mixtures of two points that differ in the paths of some stretches."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array, Mask
from ballfg.diagnosis.evidence.prior import Priors
from ballfg.diagnosis.evidence.rows import Rows
from ballfg.diagnosis.evidence.sizes import Sized, Start, begun
from ballfg.diagnosis.fit.fit import mixed, with_guesses
from ballfg.diagnosis.fit.problem import Fit


@dataclass(frozen=True)
class Point:
    """Where a model is weighed: a fit with its rows, beside patterns without a name if there are some."""

    fit: Fit
    rows: Sequence[Rows]
    priors: Priors
    starts: Sequence[Sized] = ()  # Sizes with which the search for those of the noise begins, as of `settled`

    def begun_at(self, starts: Sequence[Start | None]) -> "Point":
        """The point with these starts."""
        return replace(self, starts=[begun(self.rows, start) for start in starts])

    def mixed(self, other: "Point", chosen: Mask) -> "Point":
        """The point with chosen stretches (n,) as they are in another one at the same common unknowns."""
        fit = with_guesses(mixed(self.fit, other.fit, chosen))
        fit.__dict__["linearised"] = self.fit.linearised.mixed(other.fit.linearised, chosen)
        rows = [one.mixed(two, chosen[one.numbers]) for one, two in zip(self.rows, other.rows, strict=True)]
        return replace(self, fit=fit, rows=rows)

    @property
    def own(self) -> int:
        """Number of the common unknowns that the fit has; those of patterns come after them."""
        return len(self.fit.problem.common_precision)

    @property
    def densities(self) -> Array:
        """(n,) logarithm of the density of each stretch where the common unknowns are, with the sizes of one start."""
        ((likelihood, noise),) = self.starts
        reduced = likelihood.reduced(noise)[0]
        return np.asarray(reduced.constant - 0.5 * reduced.gram[:, -1, -1])
