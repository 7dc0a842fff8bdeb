"""Four numbers at once: what they give, and which arrays they are of."""

from __future__ import annotations

import numpy as np
import pytest
from numba import njit
from numba.core.errors import TypingError

from ballfg.factors.linear.four_at_once import behind, load, minus, padded, plus, store, times


@njit
def computed(x: np.ndarray, factor: float) -> None:
    store(x, 3, 1, plus(load(x, 0, 2), times(factor, load(x, 1, 3))))
    store(x, 4, 2, behind(3, 2, minus(load(x, 0, 0), load(x, 2, 1))))


@njit
def of_a_part(x: np.ndarray) -> None:
    store(x, 0, 0, load(x[:, 1:], 1, 0))


def test_results_are_those_of_single_numbers_wherever_they_begin() -> None:
    x = np.random.default_rng(1).normal(size=(5, 7))
    right = x.copy()
    right[3, 1:5] = x[0, 2:6] + 0.3 * x[1, 3:7]
    right[4, 2:6] = [0.0, 0.0, *(x[0, 2:4] - x[2, 3:5])]
    computed(x, 0.3)
    np.testing.assert_array_equal(x, right)


def test_rows_that_do_not_lie_one_behind_another_are_refused() -> None:
    with pytest.raises(TypingError, match="must be a matrix whose rows lie one behind another"):
        of_a_part(np.ones((2, 6)))


def test_columns_are_made_a_multiple() -> None:
    assert [padded(n) for n in (1, 4, 5, 20, 21)] == [4, 4, 8, 20, 24]
