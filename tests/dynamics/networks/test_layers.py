"""The three networks are what their formulas say."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics.networks.layers import EXPANSION_ROWS, MLP, MNN, NETWORKS, Skip
from ballfg.dynamics.networks.polynomial import evaluate, evaluation_cost, expand

INPUTS, OUTPUTS, WIDTH, DEPTH = 3, 5, 7, 4


def trained(kind, seed=0):
    """A network whose last layer is not zero any more."""
    generator = torch.Generator().manual_seed(seed)
    network = NETWORKS[kind](INPUTS, OUTPUTS, WIDTH, DEPTH, generator)
    for parameter in network.last.parameters():
        torch.nn.init.normal_(parameter, generator=generator)
    return network


def layer(module, x):
    return x @ module.weight.detach().numpy().T + module.bias.detach().numpy()


@pytest.fixture
def x():
    return np.random.default_rng(0).normal(size=(6, INPUTS))


def test_mlp(x):
    network = trained("mlp")
    h = x
    for module in network.hidden:
        h = np.tanh(layer(module, h))
    assert len(network.hidden) == DEPTH
    np.testing.assert_allclose(network(torch.from_numpy(x)).detach(), layer(network.last, h), rtol=1e-12, atol=1e-14)


def test_skip(x):
    network = trained("skip")
    h = layer(network.first, x)
    for module in network.hidden:
        h = np.tanh(layer(module, h)) + h
    assert len(network.hidden) == DEPTH
    np.testing.assert_allclose(network(torch.from_numpy(x)).detach(), layer(network.last, h), rtol=1e-12, atol=1e-14)


def test_mnn(x):
    network = trained("mnn")
    start = h = layer(network.first, x)
    for _ in range(DEPTH):
        h = start * layer(network.step, h) + h
    np.testing.assert_allclose(network(torch.from_numpy(x)).detach(), layer(network.last, h), rtol=1e-12, atol=1e-14)


def test_mnn_is_a_polynomial_of_one_degree_more_than_its_depth(x):
    """Along a line the differences of order N + 2 vanish, those of order N + 1 do not."""
    network = trained("mnn")
    steps = torch.arange(DEPTH + 3, dtype=torch.float64)[:, None]
    values = network(torch.from_numpy(x[0]) + steps * torch.from_numpy(x[1]))
    largest = values.abs().max()
    assert torch.diff(values, n=DEPTH + 2, dim=0).abs().max() < 1e-11 * largest
    assert torch.diff(values, n=DEPTH + 1, dim=0).abs().max() > 1e-6 * largest


@pytest.mark.parametrize("depth", [1, 2, 3, 4, 5])
def test_mnn_written_out_is_the_network(depth):
    """Value, and first and second derivatives by features and weights."""
    rng = torch.Generator().manual_seed(depth)
    network = MNN(INPUTS, OUTPUTS, 30, depth, rng)
    torch.nn.init.normal_(network.last.weight, generator=rng)
    few = torch.rand(EXPANSION_ROWS - 1, INPUTS, generator=rng, dtype=torch.float64)
    many = torch.cat((few, few[:1]))
    layers = [(layer.weight, layer.bias) for layer in (network.first, network.step, network.last)]
    assert evaluation_cost(INPUTS, OUTPUTS, depth) < depth * 30**2
    assert torch.equal(network(many), evaluate(expand(*layers, depth), many, depth))
    assert torch.allclose(network(many)[:-1], network(few), rtol=1e-12, atol=1e-13)
    derivatives = []
    for rows in (few, many):
        x = rows.clone().requires_grad_(True)
        weighted = network(x)[: len(few)] * torch.arange(OUTPUTS).double()
        (first,) = torch.autograd.grad(weighted.sum(), x, create_graph=True)
        rest = torch.autograd.grad(first[: len(few)].square().sum(), [x, *network.parameters()], allow_unused=True)
        derivatives.append([first[: len(few)], rest[0][: len(few)], *rest[1:-1]])
    for one, other in zip(*derivatives, strict=True):
        assert torch.allclose(one, other, rtol=1e-9, atol=1e-10)


def test_mnn_is_not_written_out_where_that_costs_more():
    """Six features make more monomials than a narrow network has weights."""
    network = MNN(6, 9, 10, 4, torch.Generator().manual_seed(0))
    torch.nn.init.ones_(network.last.weight)
    x = torch.rand(EXPANSION_ROWS, 6, generator=torch.Generator().manual_seed(1), dtype=torch.float64)
    assert evaluation_cost(6, 9, 4) > 4 * 10**2
    start = h = network.first(x)
    for _ in range(4):
        h = torch.addcmul(h, start, network.step(h))
    assert torch.equal(network(x), network.last(h))


def test_weights_counted_by_hand():
    def count(kind):
        return sum(p.numel() for p in trained(kind).parameters())

    ends, square = (INPUTS + 1) * WIDTH + (WIDTH + 1) * OUTPUTS, (WIDTH + 1) * WIDTH
    assert count("mlp") == ends + (DEPTH - 1) * square
    assert count("skip") == ends + DEPTH * square
    assert count("mnn") == ends + square


@pytest.mark.parametrize("network_class", [MLP, Skip, MNN])
def test_start(network_class, x):
    """An untrained network says nothing, is the same for the same seed and leaves torch's own generator alone."""
    before = torch.get_rng_state()
    one, same, other = (network_class(3, 5, 7, 4, torch.Generator().manual_seed(s)) for s in (1, 1, 2))
    assert torch.equal(torch.get_rng_state(), before)
    assert bool((one(torch.from_numpy(x)) == 0).all())
    weights, again, differ = (torch.nn.utils.parameters_to_vector(n.parameters()) for n in (one, same, other))
    assert weights.dtype == torch.float64
    assert torch.equal(weights, again)
    assert not torch.equal(weights, differ)


@pytest.mark.parametrize("kind", ["mlp", "skip", "mnn"])
def test_derivatives(kind, x):
    network = trained(kind)
    point = torch.from_numpy(x[:2]).requires_grad_(True)
    assert torch.autograd.gradcheck(lambda point, *_: network(point), (point, *network.parameters()))
    assert torch.autograd.gradgradcheck(network, point)


@pytest.mark.parametrize("kind", ["mlp", "skip", "mnn"])
def test_batches(kind, x):
    network, rows = trained(kind), torch.from_numpy(x)
    assert torch.allclose(network(rows.reshape(2, 3, INPUTS)).reshape(6, OUTPUTS), network(rows), rtol=1e-13, atol=0)
    assert torch.allclose(network(rows[0]), network(rows)[0], rtol=1e-13, atol=1e-15)
