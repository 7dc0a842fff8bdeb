"""Robust losses against GTSAM's, and the reweighted system against derivatives of the objective."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest

from ballfg.factors.batch import Rows, Values
from ballfg.factors.graph import objective
from ballfg.factors.linear.step import weighted
from ballfg.factors.loss import LEAST_STRETCH, Loss, weight_of
from ballfg.factors.position import PositionFactors

NORMS = np.concatenate((np.linspace(0.0, 12.0, 49), [1e3, 1e8]))


@pytest.mark.parametrize("name", ["huber", "cauchy"])
@pytest.mark.parametrize("scale", [0.5, 1.345, 3.0])
def test_value_and_weight_are_gtsam_s(name, scale) -> None:
    loss = Loss(name, scale)
    estimator = {"huber": gtsam.noiseModel.mEstimator.Huber, "cauchy": gtsam.noiseModel.mEstimator.Cauchy}[name]
    theirs = estimator.Create(scale)
    np.testing.assert_allclose(loss.value(NORMS), [theirs.loss(d) for d in NORMS], rtol=1e-12)
    np.testing.assert_allclose(loss.weight(NORMS), [theirs.weight(d) for d in NORMS], rtol=1e-12)


@pytest.mark.parametrize("name", ["squared", "huber", "cauchy"])
def test_weights_of_machine_code(name) -> None:
    loss, norms = Loss(name, 2.5), np.array([0.0, 1.0, 2.5, 2.6, 40.0])
    own = [weight_of(loss.kind, loss.scale, float(norm**2)) for norm in norms]
    np.testing.assert_allclose(own, loss.weight(norms), rtol=1e-14)


def test_squared() -> None:
    np.testing.assert_allclose(Loss().value(NORMS), 0.5 * NORMS**2)
    np.testing.assert_array_equal(Loss().weight(NORMS), 1.0)


@pytest.mark.parametrize("loss", [Loss(), Loss("huber", 2.0), Loss("cauchy", 2.0)], ids=lambda loss: loss.name)
def test_noise_model_is_the_same_loss_in_a_graph(loss) -> None:
    """A GTSAM factor with this noise model has the error that this package computes."""
    residual = np.array([3.0, -1.0, 4.0])
    graph = gtsam.NonlinearFactorGraph()
    graph.push_back(gtsam.PriorFactorVector(0, np.zeros(3), loss.noise_model(3)))
    values = gtsam.Values()
    values.insert(0, residual)
    assert graph.error(values) == pytest.approx(float(loss.value(np.linalg.norm(residual)[None])[0]), rel=1e-12)


@pytest.mark.parametrize("name", ["huber", "cauchy"])
def test_stretch_is_the_ratio_of_curvatures(name) -> None:
    """rho'' d / rho' by central differences (step 1e-4: truncation 1e-8) where it is above the floor."""
    loss, h = Loss(name, 2.0), 1e-4
    norms = np.array([0.1, 0.7, 1.3, 1.7, 3.0, 9.0])
    first = (loss.value(norms + h) - loss.value(norms - h)) / (2 * h)
    second = (loss.value(norms + h) - 2 * loss.value(norms) + loss.value(norms - h)) / h**2
    np.testing.assert_allclose(loss.weight(norms), first / norms, rtol=1e-6)
    np.testing.assert_allclose(loss.stretch(norms), np.maximum(second * norms / first, LEAST_STRETCH), atol=1e-6)


@pytest.mark.parametrize("loss", [Loss("huber", 2.0), Loss("cauchy", 2.0)], ids=lambda loss: loss.name)
def test_weighted_system_is_gradient_and_hessian(loss, differences) -> None:
    """J^T r equals the objective's gradient everywhere, J^T J its Hessian where the floor is not active.

    Gradient: differences of `objective` good to 1e-8. Hessian: differences of J^T r, rows in the core only.
    """
    rng = np.random.default_rng(3)
    measured, sigma = np.zeros((6, 3)), rng.uniform(0.5, 2.0, (6, 3))
    states = np.zeros((6, 9))
    lengths = np.array(
        [0.3, 1.0, 1.7, 2.6, 5.0, 40.0]
    )  # of the whitened residuals: three in the core, three in the tail
    direction = rng.standard_normal((6, 3))
    states[:, :3] = lengths[:, None] * direction / np.linalg.norm(direction, axis=1, keepdims=True) * sigma
    kind = PositionFactors(np.arange(6), measured, sigma, loss)

    def system(x: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
        padded = np.concatenate((x, np.zeros((6, 6))), axis=1)
        residual, (jacobian,) = weighted(kind.linearize(Values(padded, np.zeros(0))))
        jacobian = jacobian[:, :, :3]
        return np.einsum("nij,ni->nj", jacobian, residual), jacobian.swapaxes(1, 2) @ jacobian

    def losses(x: np.ndarray) -> np.ndarray:
        return loss.value(np.linalg.norm(x / sigma, axis=1))

    gradient, hessian = system(states[:, :3])
    steps = np.full(3, 1e-3)
    np.testing.assert_allclose(gradient, differences(losses, states[:, :3], steps), rtol=1e-8, atol=1e-9)
    expected = differences(lambda x: system(x)[0], states[:, :3], steps)
    core = loss.stretch(lengths) > LEAST_STRETCH
    assert core.sum() == 3
    np.testing.assert_allclose(hessian[core], expected[core], rtol=1e-7, atol=1e-8)
    # in the tail J^T J is larger than the Hessian, so that a step stays finite
    assert (np.linalg.eigvalsh(hessian[~core] - expected[~core])[:, 0] > -1e-8).all()


def test_weighted_at_zero_residual_is_finite() -> None:
    rows = Rows(np.zeros((1, 1), dtype=np.int64), np.zeros((1, 3)), (np.ones((1, 3, 9)),), Loss("cauchy"))
    residual, (jacobian,) = weighted(rows)
    assert not residual.any()
    np.testing.assert_array_equal(jacobian, 1.0)


def test_objective_sums_losses_and_flags_what_is_not_finite() -> None:
    one = Rows(np.zeros((2, 1), dtype=np.int64), np.array([[3.0], [1.0]]), (np.ones((2, 1, 9)),), Loss("huber", 2.0))
    assert objective([one, one]) == pytest.approx(2 * (2 * (3 - 1) + 0.5))
    bad = Rows(one.variables, np.array([[np.nan], [1.0]]), one.jacobians, Loss())
    assert objective([one, bad]) == np.inf


def test_bad_arguments_are_named() -> None:
    with pytest.raises(ValueError, match="loss must be one of squared, huber, cauchy; got 'tukey'"):
        Loss("tukey")
    for scale in (0.0, -1.0, float("nan")):
        with pytest.raises(ValueError, match="scale must be finite and above 0"):
            Loss("huber", scale)
