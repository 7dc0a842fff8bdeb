"""The assignment of positions to balls, against scipy's."""

import numpy as np
from scipy.optimize import linear_sum_assignment

from ballfg.live.gate import FAR, assign


def test_the_assignment_with_the_smallest_sum() -> None:
    """Up to seven balls and positions, some pairs impossible; none of either too."""
    rng, limit, pairs = np.random.default_rng(0), 30.0, 0
    for _ in range(300):
        costs = rng.exponential(20.0, rng.integers(0, 8, 2))
        rows, columns = linear_sum_assignment(np.where(costs <= limit, costs, FAR))
        best = [(i, j) for i, j in zip(rows.tolist(), columns.tolist(), strict=True) if costs[i, j] <= limit]
        assert assign(costs, limit) == best
        pairs += len(best)
    assert pairs > 300
