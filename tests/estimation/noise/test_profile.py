"""Intervals by profile against closed forms: a parabola, and a noise beside a larger one, flat on one side."""

import numpy as np
import pytest
from scipy.optimize import brentq, minimize_scalar

from ballfg.estimation.noise.profile import HONEST, Profile

WIDE = np.full(2, 10.0)


def parabola(hessian, best):
    def value(at):
        away = at - best
        return 0.5 * float(away @ hessian @ away), hessian @ away

    return value


@pytest.mark.parametrize("scatter", [0.3, 4.0])
def test_of_a_parabola_the_sides_are_those_of_the_curvature_and_the_scatter(scatter):
    hessian, best = np.array([[30.0, 12.0], [12.0, 8.0]]), np.array([0.3, -0.2])
    spread = np.array([1.5, 2.0])
    profile = Profile(parabola(hessian, best), lambda _: scatter * hessian, best + 0.2, spread, -WIDE, WIDE)
    inverse = np.linalg.inv(hessian)
    covariance = inverse @ (scatter * hessian + np.diag(spread**-2)) @ inverse
    np.testing.assert_allclose(profile.best, best, atol=0.05)
    np.testing.assert_allclose(profile.covariance, covariance, rtol=1e-6)
    expected = np.sqrt(np.maximum(np.diagonal(covariance), np.diagonal(inverse)))
    np.testing.assert_allclose(profile.sides(), np.repeat(expected[:, None], 2, axis=1), rtol=1e-3)


def beside(n, m, scale):
    """Negative log likelihood of log a, log b: n numbers of variance a^2 + b^2 and m of variance b^2, with a prior."""

    def value(logs):
        a, b = np.exp(2.0 * logs)
        seen = scale**2 + 1.0
        total = 0.5 * n * (np.log(a + b) + seen / (a + b)) + 0.5 * m * (np.log(b) + 1.0 / b)
        by_sum, by_b = 0.5 * n * (1.0 / (a + b) - seen / (a + b) ** 2), 0.5 * m * (1.0 / b - 1.0 / b**2)
        prior = logs / 1.4**2
        return total + 0.5 * float(logs @ prior), np.array([2.0 * a * by_sum, 2.0 * b * (by_sum + by_b)]) + prior

    return value


def test_a_noise_beside_a_larger_one_is_known_upwards_and_hardly_downwards():
    value, spread = beside(150, 100, 0.35), np.full(2, 1.4)
    profile = Profile(value, lambda _: np.zeros((2, 2)), np.log([0.35, 1.0]), spread, -WIDE, WIDE)

    def risen(log):
        least = minimize_scalar(lambda b: value(np.array([log, b]))[0], bounds=(-2.0, 1.0), method="bounded").fun
        return 2.0 * (least - profile.least) - 1.0

    best = profile.best[0]
    below, above = best - brentq(risen, best - 3.0, best), brentq(risen, best, best + 2.0) - best
    assert below > 1.5 * above
    np.testing.assert_allclose(profile.sides()[0], [below, above], rtol=HONEST - 1.0)
    curvature = float(np.sqrt(profile.inverse[0, 0]))
    assert abs(curvature - above) > 2.0 * abs(profile.sides()[0, 1] - above)
