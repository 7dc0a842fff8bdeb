"""What generated code calls for layers of networks, against numpy; derivatives of layers that run backward."""

import numpy as np
import pytest
import torch

from ballfg.dynamics.compiled.build import built
from ballfg.dynamics.compiled.layers import add_product, tanh_all
from ballfg.dynamics.compiled.translation.source import function_source
from ballfg.dynamics.compiled.translation.trace import trace


def test_tanh_of_many_numbers() -> None:
    near, far = np.logspace(-320, 3, 4001), np.linspace(-25.0, 25.0, 4001)
    x = np.concatenate((near, -near, far, [0.0, np.inf, -np.inf, np.nan, 0.625, -0.625]))
    y = np.empty_like(x)
    tanh_all(x, y)
    np.testing.assert_allclose(y, np.tanh(x), rtol=5e-16, atol=0.0)
    assert np.isnan(y[-3])


@pytest.mark.parametrize(
    ("m", "k", "n", "count"),
    [(1, 6, 5, 3), (1, 40, 30, 7), (4, 20, 30, 2), (5, 23, 30, 3), (14, 21, 18, 1), (3, 2, 1, 1)],
)
@pytest.mark.parametrize("turned", [False, True])
@pytest.mark.parametrize("shared", [False, True])
@pytest.mark.parametrize("anew", [False, True])
def test_products_of_matrices(m, k, n, count, turned, shared, anew) -> None:
    rng = np.random.default_rng(m * k)
    left, start = rng.normal(size=(count, m, k)), rng.normal(size=(count, m, n))
    right = rng.normal(size=(1 if shared else count, *((n, k) if turned else (k, n))))
    whole, at = np.concatenate((np.zeros(2), start.ravel())), (1, k) if turned else (n, 1)
    step = 0 if shared else k * n
    given = (left.ravel(), 0, m * k, k, 1, right.ravel(), 0, step, *at, count, m, k, n)
    add_product(whole, 2, m * n, *given, int(anew))
    wanted = (0.0 if anew else start) + left @ (right.mT if turned else right)
    np.testing.assert_allclose(whole[2:].reshape(wanted.shape), wanted, rtol=1e-12, atol=1e-13)
    assert (whole[:2] == 0.0).all()


def of_matrices(x, table):
    """A product of two matrices that both depend on the state, sums over one dimension, and a bias."""
    left = torch.tanh(x[:6].unsqueeze(1) * table[:6, :8])  # 6 x 8
    right = torch.exp(x[3:].unsqueeze(0) * table[:8, :6] * 0.1)  # 8 x 6
    middle = torch.mm(left, right) + torch.sum(left, dim=1, keepdim=True)
    return torch.mm(middle, table[:6, :3]).t().sum(1)


def of_layers(x, table):
    """Layers that are narrower at the end than the state is wide, with a sum beside them."""
    h = torch.tanh(torch.addmm(table[:1], x.unsqueeze(0), table[:9]))
    h = h + torch.tanh(torch.mm(h, table))
    flat = h.squeeze(0)
    return torch.cat((torch.mm(h * h, table[:, :2]).squeeze_(0), torch.sum(flat * flat, dim=0, keepdim=True)))


@pytest.mark.parametrize("function", [of_matrices, of_layers])
def test_derivatives_of_few_numbers_by_many(function) -> None:
    table = torch.from_numpy(np.random.default_rng(1).normal(size=(20, 20)) / 4.0)
    traced = trace(function, [9], [table])
    assert traced.arrays.asked, "fewer numbers are read than the state has: derivatives run backward"
    compute = built(function_source(traced, traced.inputs[0], []))
    assert traced.weights is not None
    states = np.random.default_rng(2).normal(size=(5, 9))
    m = len(traced.outputs)
    y, yt = np.empty((5, m)), np.empty((5, m, 9))
    moved = np.tile(np.eye(9), (5, 1, 1))
    compute(states, np.empty((5, 0)), traced.weights(table).numpy(), moved, np.empty((5, 0, 9)), y, yt)
    for row in range(5):
        x = torch.from_numpy(states[row])
        np.testing.assert_allclose(y[row], function(x, table).numpy(), rtol=1e-12, atol=1e-12)
        slopes = torch.autograd.functional.jacobian(lambda x: function(x, table), x)
        np.testing.assert_allclose(yt[row], slopes.numpy(), rtol=1e-10, atol=1e-10)
