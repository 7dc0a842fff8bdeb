"""The result type: standard deviations, NIS, whitening, leave-one-out against formulas written out."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.estimation.observations.innovation import LEAST_INFORMATION, leave_position_out
from ballfg.estimation.result import Estimate, Status
from ballfg.factors.batch import Values
from ballfg.factors.linear.definite import whitened as whitened_by
from ballfg.factors.loss import Loss
from ballfg.factors.position import PositionFactors


def spd(rng: np.random.Generator, n: int, size: int) -> np.ndarray:
    root = rng.standard_normal((n, size, size))
    return root @ root.swapaxes(1, 2) + 0.1 * np.eye(size)


def test_sigmas_and_nis() -> None:
    covariances = np.tile(np.diag(np.arange(1.0, 10.0) ** 2), (2, 1, 1))
    whitened = np.array([[1.0, 2.0, 2.0], [np.nan, np.nan, np.nan]])
    estimate = Estimate("t", np.arange(2.0), np.zeros((2, 9)), covariances, Status.OK, {"position": whitened})
    np.testing.assert_array_equal(estimate.sigmas, [np.arange(1.0, 10.0)] * 2)
    np.testing.assert_array_equal(estimate.nis, [9.0, np.nan])
    assert estimate.contacts == ()
    assert len(estimate.hits) == 0
    assert estimate.cross_covariances.shape == (0, 9, 0)
    assert estimate.unknown_covariance.shape == (0, 0)
    assert np.isnan(estimate.error)


def test_an_estimate_without_innovations_has_no_numbers_for_them() -> None:
    """As from an estimator of a user's; a StopIteration would end the caller's loop without a word."""
    estimate = Estimate("t", np.arange(2.0), np.zeros((2, 9)), np.zeros((2, 9, 9)), Status.OK)
    assert np.isnan(estimate.whitened).all()
    assert estimate.whitened.shape == (2, 3)
    assert np.isnan(estimate.nis).all()


def test_states_and_covariances_are_one_a_stamp() -> None:
    times, states = np.arange(2.0), np.zeros((2, 9))
    with pytest.raises(
        ValueError, match=r"covariances of an Estimate must have shape \(2, 9, 9\); got \(2, 9\)\. Give"
    ):
        Estimate("t", times, states, states, Status.OK)
    with pytest.raises(ValueError, match=r"states of an Estimate must have shape \(2, 9\); got \(2, 6\)\. Give"):
        Estimate("t", times, states[:, :6], np.zeros((2, 9, 9)), Status.OK)


def test_whitened_innovations_have_unit_covariance() -> None:
    """Their squared length is the Mahalanobis distance; drawn from the covariance, their scatter is the identity."""
    rng = np.random.default_rng(0)
    covariance = np.tile(spd(rng, 1, 3), (20_000, 1, 1))
    innovation = rng.multivariate_normal(np.zeros(3), covariance[0], 20_000)
    whitened = whitened_by(innovation, covariance)
    distance = np.einsum("ni,nij,nj->n", innovation, np.linalg.inv(covariance), innovation)
    np.testing.assert_allclose((whitened**2).sum(axis=1), distance, rtol=1e-9)
    np.testing.assert_allclose(np.cov(whitened.T), np.eye(3), atol=0.03)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 2.0)], ids=lambda loss: loss.name)
def test_leave_one_out_takes_the_sample_back_out(loss) -> None:
    """Others: mean m, covariance C. With z, R they give the posterior; from it leave_one_out finds m and C again."""
    rng = np.random.default_rng(1)
    n, sigma = 5, np.full((5, 3), 0.5)
    C, mean, z = spd(rng, n, 3), rng.standard_normal((n, 3)), rng.standard_normal((n, 3))
    states, covariances = np.zeros((n, 9)), np.tile(np.eye(9), (n, 1, 1))
    R = np.diag(sigma[0] ** 2)
    for i in range(n):
        K = C[i] @ np.linalg.inv(C[i] + R)
        states[i, :3] = mean[i] + K @ (z[i] - mean[i])
        covariances[i, :3, :3] = (np.eye(3) - K) @ C[i]
    kind = PositionFactors(np.arange(n), z, sigma, loss)
    rows = kind.linearize(Values(states, np.zeros(0)))
    core = np.linalg.norm(rows.residual, axis=1) < 2.0  # where Huber's loss is the squared one
    assert core.sum() >= 2
    expected = whitened_by(z - mean, C + R)
    np.testing.assert_allclose(
        leave_position_out(states, covariances, z, R, rows)[core], expected[core], rtol=1e-4, atol=1e-5
    )


def test_a_sample_that_stands_alone_surprises_nobody() -> None:
    """Nothing else knows the position: the prediction's covariance is bounded, the whitened distance goes to zero."""
    sigma = np.full((1, 3), 0.01)
    states = np.zeros((1, 9))
    covariances = np.eye(9)[None] * 1e-4  # all of it the sample's own
    rows = PositionFactors(np.array([0]), states[:, :3], sigma).linearize(Values(states, np.zeros(0)))
    noise = np.diag(sigma[0] ** 2)
    whitened = leave_position_out(states, covariances, states[:, :3] + 1e-3, noise, rows)
    np.testing.assert_allclose(whitened, 1e-3 / 0.01 * np.sqrt(LEAST_INFORMATION), rtol=1e-3)


@pytest.mark.parametrize("status", list(Status))
def test_a_status_is_a_sentence(status) -> None:
    assert status.value[0].islower()
    assert not status.value.endswith(".")
    if status is not Status.OK:
        assert any(word in status.value for word in ("Check", "Observe", "Give"))
