"""Score tests: would an effect that is absent make the samples more probable, everything else being free to adapt?

At the minimum of the declared model the derivative of the objective by an absent effect's coefficients is its score.
First states are eliminated stretch by stretch, declared coefficients over all tracks; what information is left tells
how large the score may be by chance. Tracks are the independent units: the scatter of their scores says how far the
stated noise can be trusted, so that a false alarm stays as rare as stated when noise is misjudged or has a memory.
docs/derivations/diagnosis.md derives all of it.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnosis.remains.clustered import Pattern, judge_patterns
from ballfg.diagnosis.search.signatures import Efficient, Signatures, visible_directions

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Score:
    """The outcome of a score test.

    Attributes:
        estimate: (p,) coefficients after one step from absent.
        sigma: (p,) their standard deviations.
        explained: squared whitened residual that the effect would explain: chi-square of `rank` degrees by chance.
        p_value: probability of so much by chance.
        rank: number of directions in which the data show the coefficients.
    """

    estimate: Array
    sigma: Array
    explained: float
    p_value: float
    rank: int


def score_tests(signatures: Signatures, candidates: Sequence[Sequence[int]]) -> list[Score | None]:
    """One test for each candidate; None where the data do not show it at all.

    Args: candidates: for each the columns that are its coefficients, counted after the common ones.
    """
    efficient = signatures.efficient()
    turns = [_visible(efficient, np.array(chosen)) for chosen in candidates]
    seen = [turn for turn in turns if turn is not None]
    outcomes = iter(judge_patterns(signatures, seen))
    return [
        None if turn is None else _score(next(outcomes), turn[np.array(chosen)])
        for turn, chosen in zip(turns, candidates, strict=True)
    ]


def _score(pattern: Pattern, turn: Array) -> Score:
    """Args: turn: (p, r) the coefficients of a candidate in the directions that were tested."""
    inverse = np.linalg.inv(pattern.information)
    spread = turn @ inverse @ pattern.scatter @ inverse @ turn.T
    spread[np.diag_indices_from(spread)] += np.where((turn**2).sum(axis=1) > 0.0, 0.0, np.inf)  # nothing tells it
    return Score(
        turn @ pattern.estimate, np.sqrt(np.diagonal(spread)), pattern.explained, pattern.p_value, pattern.rank
    )


def _visible(efficient: Efficient, chosen: NDArray[np.int64]) -> Array | None:
    """(p, r) the directions of some of all p columns that projection leaves; None: it leaves none."""
    directions = visible_directions(efficient.total[np.ix_(chosen, chosen)], efficient.raw[chosen])
    if not directions.shape[1]:
        return None
    turn = np.zeros((len(efficient.raw), directions.shape[1]))
    turn[chosen] = directions
    return turn
