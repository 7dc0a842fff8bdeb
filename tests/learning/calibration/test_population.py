from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.stats import multivariate_normal, norm

from ballfg.arrays import Array
from ballfg.learning.calibration.population import Evidence, agreeing, evidence, fit_population

WIDE = 1e6
"""Prior sigma that says nothing: the posterior is the likelihood to 1e-12."""


def gaussian(y: Array, covariance: Array, about: Array | None = None) -> Evidence:
    """A track that saw `y` with `covariance`."""
    about = np.zeros(len(y)) if about is None else about
    information = np.linalg.inv(covariance)
    return Evidence(information, information @ (y - about), about)


def unbounded(p: int) -> tuple[Array, Array]:
    return np.full(p, -np.inf), np.full(p, np.inf)


def log_prior(spread: Array, sigma: Array) -> float:
    """Of Rayleigh distributions with the scales `sigma`, up to a constant."""
    return float((np.log(spread / sigma) - 0.5 * (spread / sigma) ** 2).sum())


@pytest.mark.parametrize("spread", [0.5, 0.05])
@pytest.mark.parametrize("count", [4, 40])
def test_balanced_tracks_have_the_spread_of_a_scalar_search(spread: float, count: int) -> None:
    # equal noise s: the mean is the average, and each spread the maximum of a function of one variable
    rng = np.random.default_rng(0)
    noise, sigma = np.array([0.1, 0.3]), np.array([2.0, 1.0])
    y = np.array([1.0, -2.0]) + rng.normal(size=(count, 2)) * np.hypot(noise, spread)
    tracks = [gaussian(row, np.diag(noise**2)) for row in y]
    found = fit_population(tracks, y.mean(axis=0), sigma, *unbounded(2))
    np.testing.assert_allclose(found.mean, y.mean(axis=0), atol=1e-12)  # where the prior sits
    for k in range(2):

        def cost(log: float, k: int = k) -> float:
            own = np.exp([log])
            likely = norm.logpdf(y[:, k], y[:, k].mean(), np.hypot(own, noise[k])).sum()
            return -float(likely) - log_prior(own, sigma[k : k + 1])

        best = minimize_scalar(cost, bounds=(-8.0, 3.0), method="bounded", options={"xatol": 1e-9})
        np.testing.assert_allclose(found.spread[k], np.exp(best.x), rtol=1e-6)
    expected = 1.0 / np.sqrt(count / (found.spread**2 + noise**2) + sigma**-2.0)
    np.testing.assert_allclose(found.sigma, expected, rtol=1e-9)


@pytest.mark.parametrize("apart", [0.3, 3.0])
def test_tracks_that_contradict_each_other_know_less(apart: float) -> None:
    """Scalars by hand: the error of a weighted mean, times the root of chi^2 over n - 1 where that is above 1."""
    y, sigma = np.array([1.0, 1.0 + apart, 1.0 - apart, 1.2]), np.array([0.5, 1.0, 0.8, 2.0])
    tracks = [gaussian(np.array([a]), np.array([[s**2]]), np.array([0.7])) for a, s in zip(y, sigma, strict=True)]
    given = (np.zeros(1), np.array([WIDE]), *unbounded(1))
    first = fit_population(tracks, *given, alike=np.array([0]))
    found = fit_population(agreeing(tracks, first.mean), *given, alike=np.array([0]))
    mean = np.average(y, weights=sigma**-2.0)
    chi2 = (((y - mean) / sigma) ** 2).sum()
    expected = np.sqrt(max(1.0, chi2 / 3.0) / (sigma**-2.0).sum())
    np.testing.assert_allclose([found.mean[0], found.sigma[0]], [mean, expected], rtol=1e-9)
    assert (chi2 > 3.0) == (apart > 1.0)


def test_many_tracks_leave_the_usual_estimate_of_the_spread() -> None:
    rng = np.random.default_rng(1)
    y = rng.normal(size=(3000, 1)) * 0.5
    found = fit_population([gaussian(row, np.array([[0.04]])) for row in y], y.mean(axis=0), np.ones(1), *unbounded(1))
    np.testing.assert_allclose(found.spread**2, y.var() - 0.04, rtol=2e-3)


def test_spread_is_not_zero_where_a_few_tracks_happen_to_agree() -> None:
    # the noise explains all of y; what the tracks leave open is a spread of the standard error of their scatter
    noise, y = 0.2, np.linspace(-0.01, 0.01, 5)[:, None]
    found = fit_population([gaussian(row, np.eye(1) * noise**2) for row in y], np.zeros(1), np.ones(1), *unbounded(1))
    assert 0.2 * noise < found.spread[0] < noise
    more = np.linspace(-0.01, 0.01, 500)[:, None]
    many = fit_population([gaussian(r, np.eye(1) * noise**2) for r in more], np.zeros(1), np.ones(1), *unbounded(1))
    assert many.spread[0] < 0.12 * noise


def test_unequal_tracks_reach_the_maximum_of_the_dense_likelihood() -> None:
    rng = np.random.default_rng(2)
    start, sigma = np.array([0.5, 0.0, 1.0]), np.array([2.0, 1.0, 3.0])
    y, covariances = [], []
    for _ in range(25):
        root = rng.normal(size=(3, 3)) * np.array([0.3, 0.8, 0.5])
        covariances.append(root @ root.T + 0.01 * np.eye(3))
        y.append(rng.multivariate_normal([1.0, -1.0, 2.0], covariances[-1] + np.diag([0.2, 0.1, 0.4]) ** 2))
    tracks = [gaussian(a, c, about=rng.normal(size=3)) for a, c in zip(y, covariances, strict=True)]
    found = fit_population(tracks, start, sigma, *unbounded(3))

    def dense(mean: Array, variance: Array) -> float:
        total = sum(
            multivariate_normal.logpdf(a, mean, c + np.diag(variance)) for a, c in zip(y, covariances, strict=True)
        )
        prior = log_prior(np.sqrt(variance), sigma)
        return float(total + prior + multivariate_normal.logpdf(mean, start, np.diag(sigma**2)))

    variance = found.spread**2
    best = dense(found.mean, variance)
    for k in range(3):
        for step in (1e-3, -1e-3):
            shift = step * np.eye(3)[k]
            assert dense(found.mean + shift, variance) < best
            assert dense(found.mean, np.maximum(variance + shift, 1e-4)) < best
    elsewhere = fit_population(tracks[::-1], start, sigma, *unbounded(3))
    np.testing.assert_allclose(elsewhere.mean, found.mean, rtol=1e-9)
    # its own likelihood differs from the dense one by what depends on the data only
    other = fit_population(tracks, start, sigma, np.full(3, -np.inf), np.array([0.3, np.inf, np.inf]))
    np.testing.assert_allclose(
        found.log_likelihood - other.log_likelihood, best - dense(other.mean, other.spread**2), rtol=1e-8
    )


def test_mean_and_spread_of_a_simulated_population() -> None:
    rng = np.random.default_rng(3)
    mean, spread = np.array([0.12, 0.93]), np.array([0.01, 0.004])
    tracks = []
    for _ in range(600):
        sigma = np.array([0.01, 0.006]) * rng.uniform(0.5, 2.0)
        covariance = np.diag(sigma**2) + 0.5 * sigma.prod() * (1 - np.eye(2))
        tracks.append(gaussian(rng.multivariate_normal(mean + spread * rng.normal(size=2), covariance), covariance))
    found = fit_population(tracks, np.array([0.1, 0.9]), np.array([0.035, 0.02]), *unbounded(2))
    assert (np.abs(found.mean - mean) < 3.0 * found.sigma).all()
    np.testing.assert_allclose(found.spread, spread, rtol=0.25)  # 3 sigma at this noise
    np.testing.assert_allclose(found.next_track, np.hypot(found.spread, found.sigma))


def test_prior_is_taken_out_of_a_posterior() -> None:
    rng = np.random.default_rng(4)
    root = rng.normal(size=(3, 3))
    information = root @ root.T
    y, prior_mean, prior_sigma = rng.normal(size=3), np.array([1.0, -1.0, 0.5]), np.array([0.5, 2.0, 1.0])
    prior = np.diag(prior_sigma**-2)
    covariance = np.linalg.inv(information + prior)
    posterior = covariance @ (information @ y + prior @ prior_mean)
    found = evidence(posterior, covariance, prior_mean, prior_sigma)
    np.testing.assert_allclose(found.information, information, atol=1e-10)
    np.testing.assert_allclose(found.vector, information @ (y - prior_mean), atol=1e-10)


def test_what_a_track_does_not_see_leaves_the_prior() -> None:
    # the second coefficient comes back from the track as it went in, up to rounding
    posterior = evidence(
        np.array([0.3, 0.2]), np.diag([0.01, 4.0 * (1 + 1e-15)]), np.array([0.0, 0.2]), np.array([1.0, 2.0])
    )
    assert posterior.information[1, 1] < 1e-12
    found = fit_population([posterior] * 5, np.array([0.0, 0.2]), np.array([1.0, 2.0]), *unbounded(2))
    np.testing.assert_allclose(found.mean[1], 0.2, atol=1e-12)
    np.testing.assert_allclose(found.sigma[1], 2.0, rtol=1e-6)
    assert found.spread[1] == 0.0


def test_mean_stays_in_its_bounds_and_the_others_follow() -> None:
    covariance = np.array([[0.04, 0.03], [0.03, 0.04]])
    tracks = [gaussian(np.array([1.2, 0.5]), covariance) for _ in range(10)]
    found = fit_population(tracks, np.zeros(2), np.full(2, WIDE), np.zeros(2), np.ones(2))
    assert found.mean[0] == 1.0
    # given the first, the second moves along their correlation
    whole = covariance + np.diag(found.spread**2)
    np.testing.assert_allclose(found.mean[1], 0.5 - 0.2 * whole[1, 0] / whole[0, 0], rtol=1e-6)


@pytest.mark.parametrize(
    ("mean", "covariance", "message"),
    [
        (np.array([np.nan]), np.eye(1), "mean and covariance must be finite"),
        (np.zeros(1), -np.eye(1), "covariance must be positive definite; its least eigenvalue is -1"),
    ],
)
def test_failed_estimates_are_refused(mean: Array, covariance: Array, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        evidence(mean, covariance, np.zeros(1), np.ones(1))
    with pytest.raises(ValueError, match="tracks must hold at least one"):
        fit_population([], np.zeros(1), np.ones(1), *unbounded(1))


def test_groups_share_a_coefficient_and_reach_the_maximum_of_the_dense_likelihood() -> None:
    rng, count = np.random.default_rng(8), 24
    start, sigma = np.array([0.2, 0.0, 0.0]), np.array([1.0, 3.0, 3.0])
    numbers = np.array([[0, 1 + k % 2] for k in range(count)])  # each group has a second mean of its own
    true, spread = np.array([0.5, -2.0, 1.5]), np.array([0.2, 0.5, 0.3])
    y, covariances = [], []
    for own in numbers:
        root = rng.normal(size=(2, 2)) * np.array([0.3, 0.6])
        covariances.append(root @ root.T + 0.02 * np.eye(2))
        y.append(rng.multivariate_normal(true[own], covariances[-1] + np.diag(spread[own] ** 2)))
    tracks = [gaussian(a, c) for a, c in zip(y, covariances, strict=True)]
    found = fit_population(tracks, start, sigma, *unbounded(3), numbers)

    def dense(mean: Array, variance: Array) -> float:
        total = sum(
            multivariate_normal.logpdf(a, mean[own], c + np.diag(variance[own]))
            for a, c, own in zip(y, covariances, numbers, strict=True)
        )
        prior = log_prior(np.sqrt(variance), sigma)
        return float(total + prior + multivariate_normal.logpdf(mean, start, np.diag(sigma**2)))

    variance = found.spread**2
    best = dense(found.mean, variance)
    for k in range(3):
        for step in (1e-3, -1e-3):
            shift = step * np.eye(3)[k]
            assert dense(found.mean + shift, variance) < best
            assert dense(found.mean, np.maximum(variance + shift, 1e-4)) < best
    other = fit_population(tracks, start, sigma, np.full(3, -np.inf), np.array([np.inf, -2.5, np.inf]), numbers)
    np.testing.assert_allclose(
        found.log_likelihood - other.log_likelihood, best - dense(other.mean, other.spread**2), rtol=1e-8
    )
    assert np.all(np.abs(found.mean - true) < 3.5 * found.sigma)
