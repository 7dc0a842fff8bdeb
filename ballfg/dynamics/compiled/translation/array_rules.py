"""Translates torch's operations on arrays of a program."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any, Final

import numpy as np

from ballfg.dynamics.compiled.translation.arrays import Arrays, Each, Product, Total, View
from ballfg.dynamics.compiled.translation.program import Program
from ballfg.dynamics.compiled.translation.rules import (
    COPIES,
    EACH,
    RESHAPES,
    SQUEEZES,
    Rules,
    UnknownOperationError,
    aten,
)


def each_of(arrays: Arrays, target: Any, args: Sequence[Any], kwargs: Mapping[str, Any]) -> View:
    """An operation of arrays number by number, by its rule for numbers."""
    views = [a for a in args if isinstance(a, View)]
    shape = np.broadcast_shapes(*(view.shape for view in views))
    program = Program()
    inputs = [program.input() for _ in views]
    numbers = iter(inputs)
    given = [np.array(next(numbers), dtype=object) if isinstance(a, View) else a for a in args]
    result = int(EACH[target](Rules(program), *given, **kwargs).item())
    operands = tuple(view.broadcast(shape) for view in views)
    return arrays.make(Each(program, tuple(inputs), result, operands), shape)


def _copied(arrays: Arrays, view: View) -> View:
    program = Program()
    number = program.input()
    return arrays.make(Each(program, (number,), number, (view,)), view.shape)


def _reshaped(arrays: Arrays, view: View, shape: Sequence[int]) -> View:
    same = view.reshaped(shape)
    if same is None:
        same = _copied(arrays, view).reshaped(shape)
    assert same is not None
    return same


def _product(arrays: Arrays, left: View, right: View, plus: View | None = None) -> View:
    shape = left.shape[0], right.shape[1]
    plus = None if plus is None else plus.broadcast(shape)
    if left.block is None and shape[1] == 1:  # rows of states times weights, so that many states are one product
        left, right, plus = right.permuted((1, 0)), left.permuted((1, 0)), plus and plus.permuted((1, 0))
    return arrays.make(Product(left, right, plus), shape)


def _linear(arrays: Arrays, plus: View, left: View, right: View, beta: float = 1, alpha: float = 1) -> View:
    if beta != 1 or alpha != 1:
        raise UnknownOperationError("a matrix product with factors cannot be compiled")
    return _product(arrays, left, right, plus)


def _total(arrays: Arrays, view: View, dims: Sequence[int] | None = None, keep: bool = False, **_: Any) -> View:
    rank = len(view.shape)
    summed = [d % rank for d in dims] if dims else list(range(rank))
    left = [d for d in range(rank) if d not in summed]
    made = arrays.make(Total(view.permuted([*summed, *left]), len(summed)), [view.shape[d] for d in left])
    for dim in sorted(summed) if keep else ():
        made = made.unsqueezed(dim)
    return made


def _mean(arrays: Arrays, view: View, dims: Sequence[int] | None = None, keep: bool = False, **_: Any) -> View:
    total = _total(arrays, view, dims, keep)
    return each_of(arrays, aten.mul.Scalar, [total, total.size / view.size], {})


ARRAY_RULES: Final[dict[Any, Callable[..., View]]] = {
    aten.mm.default: _product,
    aten.addmm.default: _linear,
    **dict.fromkeys((aten.sum.dim_IntList, aten.sum.default), _total),
    **dict.fromkeys((aten.mean.dim, aten.mean.default), _mean),
    **dict.fromkeys(RESHAPES, _reshaped),
    aten.unsqueeze.default: lambda _, view, dim: view.unsqueezed(dim),
    **dict.fromkeys(SQUEEZES, lambda _, view, dim: view.squeezed(dim)),
    aten.expand.default: lambda _, view, shape, **__: view.broadcast(_full(view, shape)),
    aten.permute.default: lambda _, view, dims: view.permuted(dims),
    aten.transpose.int: lambda _, view, a, b: view.swapped(a, b),
    aten.t.default: lambda _, view: view.permuted((1, 0)) if len(view.shape) == 2 else view,
    **dict.fromkeys(COPIES, lambda _, view, **__: view),
}
"""Rules of further operations by operation."""


def _full(view: View, shape: Sequence[int]) -> list[int]:
    missing = len(shape) - len(view.shape)
    return [view.shape[i - missing] if n == -1 else n for i, n in enumerate(shape)]
