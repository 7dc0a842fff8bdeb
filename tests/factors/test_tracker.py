"""Factors of a tracker with memory: Jacobians, the same residuals in torch, and what they say of a bias."""

from __future__ import annotations

import gtsam
import numpy as np
import pytest
import torch

from ballfg.factors.batch import FactorBatch, Noise, Values, merge
from ballfg.factors.bridge import Bridge, from_gtsam, nonlinear_graph, to_gtsam
from ballfg.factors.correlated_noise import BiasedPositionFactors, BiasFactors, BiasStartFactors, bias_step
from ballfg.factors.graph import BallGraph, LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.factors.prior import state_prior

SIGMA = np.array([0.004, 0.003, 0.006])
MEMORY_TIME = 0.02
DT = np.array([0.005, 0.03, 0.4])


def covariances(count: int, rng: np.random.Generator) -> np.ndarray:
    roots = rng.standard_normal((count, 3, 3))
    return 1e-6 * (roots @ roots.swapaxes(-1, -2) + np.eye(3))


def values(coefficients: int = 0) -> Values:
    rng = np.random.default_rng(3)
    return Values(rng.standard_normal((4, 9)), rng.standard_normal(coefficients), rng.standard_normal((4, 3)))


def batches() -> list[FactorBatch]:
    rng = np.random.default_rng(1)
    where = np.array([0, 1, 3])
    measured, sigma, stamps = rng.standard_normal((3, 3)), rng.uniform(1e-3, 3e-3, (3, 3)), covariances(3, rng)
    return [
        BiasedPositionFactors(where, measured, sigma, stamps, Loss("huber")),
        BiasedPositionFactors(where, measured, sigma, biased=False),
        BiasFactors(np.arange(3), DT, SIGMA, MEMORY_TIME),
        BiasStartFactors(np.array([0, 2]), SIGMA),
    ]


@pytest.mark.parametrize("kind", batches(), ids=lambda kind: type(kind).__name__)
def test_jacobians_are_central_differences(kind) -> None:
    """All of them are linear: a long step loses no digits to truncation."""
    point, step = values(), 1e-2
    inputs = kind.inputs(point)
    _, blocks = kind.compute(slice(None), inputs)
    for column, block in enumerate(blocks):
        assert block.shape == (len(kind), kind.dim, inputs[column].shape[1])
        for j in range(block.shape[-1]):
            sides = []
            for sign in (1.0, -1.0):
                moved = inputs[column].copy()
                moved[:, j] += sign * step
                sides.append(kind.compute(slice(None), (*inputs[:column], moved, *inputs[column + 1 :]))[0])
            difference = (sides[0] - sides[1]) / (2.0 * step)
            np.testing.assert_allclose(block[:, :, j], difference, atol=1e-9 * np.abs(block).max())


@pytest.mark.parametrize("kind", batches(), ids=lambda kind: type(kind).__name__)
def test_torch_sees_the_same_residuals(kind) -> None:
    inputs = kind.inputs(values())
    residual, _ = kind.compute(slice(None), inputs)
    found = kind.residual(tuple(torch.from_numpy(np.array(x)) for x in inputs))
    np.testing.assert_allclose(found.numpy(), residual, rtol=1e-12)


@pytest.mark.parametrize("kind", batches(), ids=lambda kind: type(kind).__name__)
def test_rows_of_a_batch_are_rows_by_themselves(kind) -> None:
    whole = kind.linearize(values())
    rows = np.array([1, 0])
    part = kind.select(rows).linearize(values())
    np.testing.assert_array_equal(part.residual, whole.residual[rows])
    for block, expected in zip(part.jacobians, whole.jacobians, strict=True):
        np.testing.assert_array_equal(block, expected[rows])
        assert block.shape[-1] == 12
    both = merge([kind.select(np.array([0])), kind.select(np.array([1]))])
    np.testing.assert_array_equal(both.linearize(values()).residual, whole.residual[:2])


def parts() -> tuple[np.ndarray, np.ndarray]:
    """Standard deviations of the white errors, and the covariances of those of stamps."""
    rng = np.random.default_rng(5)
    return rng.uniform(1e-3, 3e-3, (3, 3)), covariances(3, rng)


def whole_noise() -> np.ndarray:
    """(2, 3, 3, 3) both covariances of the three samples."""
    sigma, stamps = parts()
    return np.stack((sigma[:, :, None] ** 2 * np.eye(3), stamps))


def test_whitened_residuals_have_the_declared_covariance() -> None:
    """A stationary process stays stationary: variance a^2 s^2 + (1 - a^2) s^2 after any interval."""
    decay, spread = bias_step(DT, SIGMA, MEMORY_TIME)
    np.testing.assert_allclose(decay, np.exp(-DT / MEMORY_TIME))
    np.testing.assert_allclose(decay[:, None] ** 2 * SIGMA**2 + spread**2, np.tile(SIGMA**2, (3, 1)), rtol=1e-12)
    kind = BiasFactors(np.arange(3), DT, SIGMA, MEMORY_TIME)
    np.testing.assert_allclose(kind.information_root * spread, 1.0, rtol=1e-12)
    noise, root = whole_noise().sum(0), BiasedPositionFactors(np.arange(3), np.zeros((3, 3)), *parts()).information_root
    np.testing.assert_allclose(root @ noise @ root.swapaxes(-1, -2), np.tile(np.eye(3), (3, 1, 1)), atol=1e-9)


def test_spreads_are_half_the_log_determinants() -> None:
    kind = BiasedPositionFactors(np.arange(3), np.zeros((3, 3)), *parts())
    assert kind.log_spread() == pytest.approx(0.5 * np.linalg.slogdet(whole_noise().sum(0))[1].sum(), rel=1e-12)
    _, spread = bias_step(DT, SIGMA, MEMORY_TIME)
    assert BiasFactors(np.arange(3), DT, SIGMA, MEMORY_TIME).log_spread() == pytest.approx(np.log(spread).sum())
    assert BiasStartFactors(np.array([0, 2]), SIGMA).log_spread() == pytest.approx(2.0 * np.log(SIGMA).sum())


def test_learned_position_noise_scales_the_white_part() -> None:
    """As factors built anew with it; errors of stamps stay as they are, and no other kind has this noise."""
    scale = Noise(position=torch.tensor(2.5, dtype=torch.float64))
    sigma, stamps = parts()
    where, measured = np.arange(3), np.random.default_rng(2).standard_normal((3, 3))
    old = BiasedPositionFactors(where, measured, sigma, stamps)
    new = BiasedPositionFactors(where, measured, 2.5 * sigma, stamps)
    change, inputs = old.noise_scale(scale), tuple(torch.from_numpy(np.array(x)) for x in old.inputs(values()))
    found = (change @ old.residual(inputs)[..., None])[..., 0]
    torch.testing.assert_close(found, new.residual(inputs), rtol=1e-9, atol=1e-9)
    grown = -float(change.diagonal(dim1=-2, dim2=-1).log().sum())
    assert new.log_spread() - old.log_spread() == pytest.approx(grown, rel=1e-9)
    assert [kind.noise_scale(scale) for kind in batches()[2:]] == [None, None]
    assert old.noise_scale(Noise()) is None


def test_gtsam_finds_the_same_minimum_with_biases_behind_its_states() -> None:
    """Batches that know of no bias see the states alone; their Jacobians get columns of zeros."""
    kinds = [batches()[0].with_loss(Loss()), *batches()[2:]]
    kinds += [state_prior(i, np.full(9, 0.1 * i), np.full(9, 0.5)) for i in range(4)]
    graph, start = BallGraph(tuple(kinds)), values()
    expected = LevenbergMarquardt().minimize(graph, start).values
    nonlinear, bridges = nonlinear_graph(graph)
    assert nonlinear.error(to_gtsam(start)) == pytest.approx(graph.error(start), rel=1e-12)
    found = from_gtsam(gtsam.GaussNewtonOptimizer(nonlinear, to_gtsam(start)).optimize())
    np.testing.assert_allclose(found.states, expected.states, atol=1e-7)
    np.testing.assert_allclose(found.biases, expected.biases, atol=1e-7)
    assert all(bridge.calls <= 8 for bridge in bridges)


def test_a_row_asked_by_itself_sees_the_state_alone() -> None:
    prior = Bridge(state_prior(2, np.zeros(9), np.ones(9)), "row")
    residual, (block,) = prior.answer(0, [gtsam.symbol("x", 2)], to_gtsam(values()))
    np.testing.assert_allclose(residual, values().states[2])
    np.testing.assert_array_equal(block, np.eye(9, 12))


def test_a_bad_argument_is_named() -> None:
    with pytest.raises(ValueError, match="dt, sigma and memory_time must be positive"):
        BiasFactors(np.array([0]), np.zeros(1), SIGMA, MEMORY_TIME)
    with pytest.raises(ValueError, match="measured and sigma must have shape"):
        BiasedPositionFactors(np.array([0]), np.zeros((1, 3)), np.ones(3))
    with pytest.raises(ValueError, match="measured must be finite"):
        BiasedPositionFactors(np.array([0]), np.full((1, 3), np.nan), np.ones((1, 3)))
    with pytest.raises(ValueError, match="sigma positive"):
        BiasedPositionFactors(np.array([0]), np.zeros((1, 3)), np.zeros((1, 3)))
