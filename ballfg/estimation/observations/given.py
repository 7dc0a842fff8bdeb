"""Wraps a user's factors as an observation that all estimators use."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ballfg.checks import check_each
from ballfg.estimation.observations.observation import Context, Observation
from ballfg.factors.batch import FactorBatch


class GivenFactors(Observation):
    """A batch of factors, each on one state of the track.

    Args: factors: their first variable is the index of a sample.  number: index among the user's batches.
    """

    def __init__(self, factors: FactorBatch, number: int) -> None:
        self.name = f"{type(factors).__name__} {number}"  # type: ignore[misc]  # one of a name in a track
        self.factors = factors
        self.number = number
        self.state = factors.variables[:, 0]

    def batch(self, context: Context) -> FactorBatch:
        """The factors."""
        return self.factors

    def select(self, samples: NDArray[np.bool_]) -> GivenFactors:
        """The factors of some samples."""
        kept = self.factors.select(np.flatnonzero(samples[self.state]))
        kept.variables = kept.variables.copy()
        kept.variables[:, 0] = (np.cumsum(samples) - 1)[kept.variables[:, 0]]
        return GivenFactors(kept, self.number)


def given(factors: Sequence[FactorBatch]) -> list[GivenFactors]:
    """Each batch as an observation.

    Raises: ValueError: if a factor ties several states. TypeError: something else than factors.
    """
    for batch in check_each("factors", factors, FactorBatch, "Write one as docs/custom_factors.md shows."):
        if (batch.variables[:, 0] < 0).any() or (batch.variables[:, 1:] >= 0).any():
            raise ValueError(
                f"factors must be on one state each, and on the coefficients beside it at most; {type(batch).__name__} "
                "ties other variables. Add those to a TrackProblem (docs/custom_factors.md)."
            )
    return [GivenFactors(batch, number) for number, batch in enumerate(factors)]
