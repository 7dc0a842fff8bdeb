"""The banded control ends at the minimum of what it says it minimises."""

import numpy as np
from scipy.optimize import least_squares

from ballfg.benchmarks.speed.suite import banded_problem, problem_model, problem_track


def test_it_is_the_minimum_that_a_general_solver_finds() -> None:
    """scipy's least squares with differences for derivatives, started where the control ends and a little off."""
    problem = banded_problem(problem_track(problem_model()))
    states, spin, count = problem.solve()
    assert 2 <= count <= 8

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([r.ravel() for r in problem.residuals(x[:-3].reshape(-1, 6), x[-3:])])

    end = np.concatenate((states.ravel(), spin))
    scale = np.concatenate((np.tile((1e-3,) * 3 + (1e-2,) * 3, len(states)), np.ones(3)))
    away = end + scale * np.random.default_rng(0).standard_normal(len(end))
    found = least_squares(residuals, away, x_scale=scale, xtol=1e-13, ftol=1e-14, gtol=1e-12)
    np.testing.assert_allclose((found.x - end) / scale, 0.0, atol=1e-3)
    assert (residuals(end) ** 2).sum() < 1.0001 * 2.0 * found.cost
