"""Expands an MNN of N steps to a polynomial of degree N + 1, with coefficients computed from the weights.

For many states with few features that costs a small part of running the network, derivatives included: the coefficients
need one pass through the wide hidden states, instead of one for each state (docs/derivations/gram_schmidt.md).
"""

import functools
from dataclasses import dataclass
from itertools import combinations_with_replacement

import torch
from torch import Tensor

CPU = torch.device("cpu")
Weights = tuple[Tensor, Tensor]  # Of a linear layer: weight (outputs, inputs), bias (outputs,)


def expand(first: Weights, step: Weights, last: Weights, depth: int) -> Tensor:
    """Coefficients (outputs, m) of the monomials of degree `depth` + 1 in (1, features), in lexical order.

    Args: first, step, last: layers of the network h_0 = first(x), h_k = h_0 step(h_{k-1}) + h_{k-1}, y = last(h_N).
    """
    start = torch.cat((first[1].unsqueeze(-1), first[0]), dim=-1)  # (width, 1 + features): degree one
    hidden = start
    for table, size in _tables(start.shape[-1], depth, start.device).raised:
        stepped = step[0] @ hidden
        stepped = torch.cat((stepped[:, :1] + step[1].unsqueeze(-1), stepped[:, 1:]), dim=-1)
        product = (start.unsqueeze(-1) * stepped.unsqueeze(-2)).flatten(-2)
        raised = hidden.new_zeros(hidden.shape[0], size)
        hidden = raised.index_add(1, table.flatten(), product).index_add(1, table[0], hidden)
    result = last[0] @ hidden
    return torch.cat((result[:, :1] + last[1].unsqueeze(-1), result[:, 1:]), dim=-1)


def evaluate(coefficients: Tensor, features: Tensor, depth: int) -> Tensor:
    """Values (..., outputs) of polynomials at features (..., f).

    A matrix stands between monomials of half the degree: fewer numbers than all monomials.
    """
    tables = _tables(features.shape[-1] + 1, depth, features.device)
    one = torch.nn.functional.pad(features, (1, 0), value=1.0)
    powers = [one]
    for low, high in tables.powers:
        powers.append(powers[-1].index_select(-1, low) * one.index_select(-1, high))
    left, right = powers[tables.left], powers[-1]
    matrix = coefficients[:, tables.pairs] * tables.shares  # (outputs, left, right)
    outputs, m, n = matrix.shape
    partial = (left @ matrix.transpose(0, 1).reshape(m, outputs * n)).unflatten(-1, (outputs, n))
    return (partial * right.unsqueeze(-2)).sum(-1)


def evaluation_cost(features: int, outputs: int, depth: int) -> int:
    """Multiplications that `evaluate` takes for each state, but for the few of the monomials."""
    return outputs * _tables(features + 1, depth, CPU).pairs.numel()


@dataclass(frozen=True)
class _Tables:
    """Places of products of monomials."""

    raised: tuple[tuple[Tensor, int], ...]
    """For degree k = 1, 2, ...: (variables, m_k), number of each monomial times each variable in degree k + 1, and how
    many monomials there are in degree k + 1."""
    powers: tuple[tuple[Tensor, Tensor], ...]
    """For degree k = 2, 3, ...: the monomial of degree k - 1 and the variable whose product each is."""
    left: int
    pairs: Tensor  # (left, right), number of their product in the full degree
    shares: Tensor  # (left, right), one over the number of pairs that give the same product


@functools.cache
def _tables(variables: int, depth: int, device: torch.device) -> _Tables:
    indices = functools.partial(torch.tensor, device=device)
    monomials = [combinations_with_replacement(range(variables), k) for k in range(depth + 2)]
    number = [{m: i for i, m in enumerate(of_degree)} for of_degree in monomials]
    products = [
        [[number[k + 1][tuple(sorted((*m, v)))] for m in number[k]] for v in range(variables)]
        for k in range(1, depth + 1)
    ]
    raised = tuple((indices(table), len(number[k])) for k, table in enumerate(products, start=2))
    degree = depth + 1
    high = (degree + 1) // 2
    powers = tuple(
        (indices([number[k - 1][m[:-1]] for m in number[k]]), indices([m[-1] for m in number[k]]))
        for k in range(2, high + 1)
    )
    pairs = indices([[number[degree][tuple(sorted(a + b))] for b in number[high]] for a in number[degree - high]])
    counts = torch.bincount(pairs.flatten())
    return _Tables(raised, powers, degree - high - 1, pairs, (1.0 / counts.double())[pairs])
