"""Weights of sets against dense normal densities and ridge regression, and means against planted ones."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product

import numpy as np
import pytest
from scipy import special, stats

from ballfg.diagnosis.evidence.prior import log_odds
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.one_view.weights import CLIPPED, TRIED, Weights, clipped, mean_of, odds_of, slopes_of
from ballfg.dynamics import EFFECTS

DRAG = "flight.drag.k"


def made(mean: Sequence[float] | np.ndarray, seed: int = 0, strokes: int = 80, noise: float = 0.1) -> Weights:
    """Weights of a declared drag and two effects, with a wind of three strengths and a decay of one."""
    asked = [Hypothesis(EFFECTS["wind"], {}, ("x", "y", "z")), Hypothesis(EFFECTS["spin_decay"], {}, ("rate",))]
    names = (DRAG, *(column for one in asked for column in one.columns))
    rng = np.random.default_rng(seed)
    root, slopes = rng.standard_normal((2, 5, 5))
    spread = noise**2 * (root @ root.T + np.eye(5))
    sizes = np.array([0.035, 0.2, 0.2, 0.2, 0.2])
    values, absent = np.array([0.13, 0.1, 0.0, 0.0, 0.0]), np.array([0.12, 0.0, 0.0, 0.0, 0.0])
    return Weights(names, sizes, values, absent, 1, np.array(mean), spread, slopes, strokes, asked)


def test_evidence_is_that_of_dense_normal_densities() -> None:
    weights = made(np.random.default_rng(5).standard_normal(5))
    left = weights.mean - weights.slopes @ ((weights.absent - weights.values) / weights.sizes)
    for chosen in ((), (0,), (1,), (0, 1)):
        listed = [weights.hypotheses[k] for k in chosen]
        columns = [0, *(c for k in chosen for c in ((1, 2, 3), (4,))[k])]
        densities = []
        for widths in product(TRIED, repeat=len(chosen)):
            sigma = np.ones(len(columns))
            sigma[1:] = [w for k, w in zip(chosen, widths, strict=True) for _ in ((1, 2, 3), (4,))[k]]
            root = weights.slopes[:, columns] * sigma
            densities.append(stats.multivariate_normal.logpdf(left, cov=weights.spread + root @ root.T))
        dense = special.logsumexp(densities) - np.log(len(densities)) + 2.5 * np.log(2.0 * np.pi)
        found = weights.weighed(listed)
        assert found.evidence == pytest.approx(dense, abs=1e-9)
        assert found.odds == pytest.approx(dense + log_odds(listed), abs=1e-9)


def test_strengths_are_where_they_were_planted() -> None:
    """A mean that a wind and a drag give, without noise, leads back to them."""
    weights = made(np.zeros(5), noise=1e-3)
    truth = np.array([0.125, 0.5, -0.3, 0.1, 0.0])
    planted = made(weights.slopes @ ((truth - weights.values) / weights.sizes), noise=1e-3)
    found = planted.weighed(planted.hypotheses)
    away = (found.values - truth) / np.sqrt(np.diagonal(found.covariance))
    assert np.abs(away).max() < 1.0
    assert odds_of([planted]).of("wind") > 0.9
    test = planted.score(planted.hypotheses[0])
    assert test.p_value < 1e-3
    assert (np.abs(test.estimate - truth[1:4]) < 2.0 * test.sigma).all()


def test_a_set_is_fitted_by_its_own_scores() -> None:
    """Those of its strengths and of the declared coefficients, by ridge regression with all others absent."""
    weights = made(np.random.default_rng(6).standard_normal(5))
    decay = weights.hypotheses[1]
    found, rows = weights.fitted([decay]), [0, 4]
    away = (weights.absent - weights.values) / weights.sizes
    left = (weights.mean - weights.slopes @ away)[rows]
    slopes, inverse = weights.slopes[np.ix_(rows, rows)], np.linalg.inv(weights.spread[np.ix_(rows, rows)])
    fits = []
    for width in TRIED:
        precision = slopes.T @ inverse @ slopes + np.diag([1.0, width**-2])
        fits.append(weights.absent[rows] + weights.sizes[rows] * np.linalg.solve(precision, slopes.T @ inverse @ left))
    assert found.unknown == (DRAG, *decay.columns)
    assert min(np.abs(found.values - fit).max() for fit in fits) < 1e-12


def test_misfits_of_right_laws_are_uniform() -> None:
    """With a covariance that is as well known as that of so many strokes."""
    rng, found = np.random.default_rng(11), []
    base = made(np.zeros(5))
    prior = base.slopes[:, :1] @ base.slopes[:, :1].T
    at_rest = base.slopes @ ((base.absent - base.values) / base.sizes)
    for _ in range(300):
        mean = at_rest + rng.multivariate_normal(np.zeros(5), base.spread + 0.0 * prior)
        weights = made(mean, strokes=100_000)
        found.append(weights.by_chance(weights.weighed(())))
    assert stats.kstest(found, "uniform").pvalue > 1e-3


def test_odds_take_each_set_where_it_is_likeliest() -> None:
    near, far = made(np.full(5, 0.3)), made(np.full(5, 3.0))
    odds = odds_of([near, far])
    scores = {names: max(w.known(names).odds for w in (near, far)) for names in odds.models}  # type: ignore[union-attr]
    for names, p in odds.models.items():
        assert p == pytest.approx(np.exp(scores[names] - special.logsumexp(list(scores.values()))), abs=1e-12)


def test_means_and_slopes_of_planted_scores() -> None:
    rng, turn = np.random.default_rng(3), np.array([[1.0, 0.6], [0.0, 0.8]])
    scores = rng.standard_normal((5, 400, 2)) @ turn
    mean, spread = mean_of(scores[0] + [0.3, 0.0], scores[1:])
    expected = turn.T @ turn * (1.0 / 400 + 1.0 / 1600)
    np.testing.assert_allclose(spread, expected, rtol=0.2, atol=2e-4)
    assert abs(mean[0] - 0.3) < 4.0 * np.sqrt(spread[0, 0])
    slopes = slopes_of(scores[1], [scores[1] + [0.5, 0.1], scores[1] - [0.0, 0.2]])
    np.testing.assert_allclose(slopes, [[0.5, 0.0], [0.1, -0.2]], atol=0.02)


def test_scattered_scores_widen_the_mean() -> None:
    """Real strokes that scatter twice as far are known half as well."""
    scores = np.random.default_rng(8).standard_normal((4, 400, 3))
    _, narrow = mean_of(scores[0], scores[1:])
    _, wide = mean_of(2.0 * scores[0], scores[1:])
    ratio = np.trace(wide) / np.trace(narrow)
    assert ratio == pytest.approx((4.0 + 1.0 / 3.0) / (1.0 + 1.0 / 3.0), rel=0.15)


def test_a_stroke_of_a_wrong_minimum_does_not_decide() -> None:
    scores = np.random.default_rng(9).standard_normal((101, 2))
    scores[7] = 1e6
    held = clipped(scores)
    assert np.abs(held).max() < 1.5 * CLIPPED
    np.testing.assert_array_equal(held[8:20], scores[8:20])
