"""Translates torch's operations on small tensors to operations on numbers of a program."""

import operator
from collections.abc import Callable, Sequence
from typing import Any, Final

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from ballfg.dynamics.compiled.translation.program import Program

Numbers = NDArray[np.object_]  # A tensor of numbers of a program
aten: Any = torch.ops.aten
SQUEEZES: Final = (aten.squeeze.dim, aten.squeeze_.dim)
RESHAPES: Final = (aten.view.default, aten.reshape.default, aten._unsafe_view.default)
COPIES: Final = (aten.clone.default, aten.alias.default, aten.detach.default, aten._to_copy.default)


class UnknownOperationError(Exception):
    """No rule covers an operation."""


class Rules:
    """Rules for torch's operations on tensors of numbers."""

    def __init__(self, program: Program) -> None:
        self.program = program

    def constants(self, tensor: Tensor) -> Numbers:
        """The numbers of a constant tensor."""
        flat = [self.program.constant(v) for v in tensor.detach().double().reshape(-1).tolist()]
        return np.array(flat, dtype=object).reshape(tuple(tensor.shape))

    def numbers(self, value: Any) -> Numbers:
        """A tensor of numbers, or one constant."""
        return value if isinstance(value, np.ndarray) else np.array(self.program.constant(float(value)), dtype=object)

    def each(self, name: str, *operands: Any, constant: float | None = None) -> Numbers:
        """An elementwise operation."""
        arrays = np.broadcast_arrays(*map(self.numbers, operands))
        made = [
            self.program.apply(name, *(int(a) for a in one), constant=constant)
            for one in zip(*(a.flat for a in arrays), strict=True)
        ]
        return np.array(made, dtype=object).reshape(arrays[0].shape)

    def total(self, numbers: Numbers, dims: Sequence[int] | None, keep: bool) -> Numbers:
        """Sums over dimensions."""
        axes = tuple(d % numbers.ndim for d in dims) if dims else tuple(range(numbers.ndim))
        moved = np.moveaxis(numbers, axes, range(len(axes)))
        flat = moved.reshape(-1, *moved.shape[len(axes) :])
        result = np.empty(flat.shape[1:], dtype=object)
        for place in np.ndindex(result.shape):
            result[place] = self.program.total(int(flat[(k, *place)]) for k in range(len(flat)))
        if keep:
            result = np.expand_dims(result, axes)
        return result

    def matmul(self, a: Numbers, b: Numbers) -> Numbers:
        """Products of matrices (..., m, k) and (..., k, n)."""
        return self.total(self.each("mul", a[..., :, :, None], b[..., None, :, :]), [-2], keep=False)


def _each(name: str) -> Callable[..., Numbers]:
    return lambda rules, *operands: rules.each(name, *operands)


def _pow(rules: Rules, base: Numbers, exponent: float) -> Numbers:
    if exponent == 2:
        return rules.each("mul", base, base)
    if exponent == 0.5:
        return rules.each("sqrt", base)
    return rules.each("pow", base, constant=float(exponent))


def _add(rules: Rules, a: Any, b: Any, alpha: float = 1) -> Numbers:
    return rules.each("add", a, b if alpha == 1 else rules.each("mul", b, alpha))


def _sub(rules: Rules, a: Any, b: Any, alpha: float = 1) -> Numbers:
    return rules.each("sub", a, b if alpha == 1 else rules.each("mul", b, alpha))


def _slice(
    rules: Rules, x: Numbers, dim: int = 0, start: int | None = None, end: int | None = None, step: int = 1
) -> Numbers:
    where = [slice(None)] * x.ndim
    where[dim] = slice(start, end, step)
    return x[tuple(where)]


def _norm(
    rules: Rules, x: Numbers, order: float = 2, dims: Sequence[int] | None = None, keep: bool = False, **_: Any
) -> Numbers:
    if order != 2:
        raise UnknownOperationError(f"a norm of order {order} cannot be compiled")
    return rules.each("sqrt", rules.total(rules.each("mul", x, x), dims, keep))


def _cross(rules: Rules, a: Numbers, b: Numbers, dim: int = -1) -> Numbers:
    a, b = (np.moveaxis(v, dim, -1) for v in np.broadcast_arrays(a, b))
    parts = []
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        parts.append(
            rules.each("sub", rules.each("mul", a[..., j], b[..., k]), rules.each("mul", a[..., k], b[..., j]))
        )
    return np.moveaxis(np.stack(parts, axis=-1), -1, dim)


def _clamp(rules: Rules, x: Numbers, low: float | None = None, high: float | None = None) -> Numbers:
    x = x if low is None else rules.each("maximum", x, low)
    return x if high is None else rules.each("minimum", x, high)


def _padded(rules: Rules, x: Numbers, sizes: Sequence[int], value: float = 0.0) -> Numbers:
    pairs = list(zip(sizes[::2], sizes[1::2], strict=True))[::-1]  # torch begins with the last dimension
    width = [(0, 0)] * (x.ndim - len(pairs)) + pairs
    return np.pad(x, width, constant_values=rules.program.constant(value))


def _mean(rules: Rules, x: Numbers, dims: Sequence[int] | None = None, keep: bool = False, **_: Any) -> Numbers:
    total = rules.total(x, dims, keep)
    return rules.each("mul", total, total.size / x.size)


def _filled(value: float) -> Callable[..., Numbers]:
    def make(rules: Rules, like: Any, *_: Any, **__: Any) -> Numbers:
        shape = like.shape if isinstance(like, np.ndarray) else tuple(like)
        return np.full(shape, rules.program.constant(value), dtype=object)

    return make


def _new(rules: Rules, _: Numbers, shape: Sequence[int], value: float = 0.0, **__: Any) -> Numbers:
    return np.full(tuple(shape), rules.program.constant(value), dtype=object)


EACH: Final[dict[Any, Callable[..., Numbers]]] = {
    **{getattr(aten, name).default: _each(name) for name in ("neg", "sqrt", "exp", "tanh", "abs", "sin", "cos", "log")},
    **dict.fromkeys((aten.add.Tensor, aten.add.Scalar), _add),
    **dict.fromkeys((aten.sub.Tensor, aten.sub.Scalar), _sub),
    aten.rsub.Scalar: lambda r, a, b, alpha=1: _sub(r, b, a, alpha),
    **dict.fromkeys((aten.mul.Tensor, aten.mul.Scalar), _each("mul")),
    **dict.fromkeys((aten.div.Tensor, aten.div.Scalar), _each("div")),
    aten.addcmul.default: lambda r, a, b, c: r.each("add", a, r.each("mul", b, c)),
    aten.reciprocal.default: lambda r, x: r.each("div", 1.0, x),
    aten.rsqrt.default: lambda r, x: r.each("div", 1.0, r.each("sqrt", x)),
    aten.square.default: lambda r, x: r.each("mul", x, x),
    aten.pow.Tensor_Scalar: _pow,
    aten.clamp.default: _clamp,
    aten.clamp_min.default: lambda r, x, low: r.each("maximum", x, low),
    aten.clamp_max.default: lambda r, x, high: r.each("minimum", x, high),
}
"""Rules of operations number by number that arrays have too."""

RULES: Final[dict[Any, Callable[..., Any]]] = {
    **EACH,
    **{getattr(aten, name).default: _each(name) for name in ("tan", "minimum", "maximum", "sign")},
    aten.where.self: _each("where"),
    **dict.fromkeys((aten.lt.Scalar, aten.lt.Tensor), _each("lt")),
    **dict.fromkeys((aten.gt.Scalar, aten.gt.Tensor), _each("gt")),
    aten.le.Scalar: _each("le"),
    aten.ge.Scalar: _each("ge"),
    aten.sum.dim_IntList: lambda r, x, dims, keep=False, **_: r.total(x, dims, keep),
    aten.sum.default: lambda r, x, **_: r.total(x, None, keep=False),
    **dict.fromkeys((aten.mean.dim, aten.mean.default), _mean),
    aten.linalg_vector_norm.default: _norm,
    aten.linalg_cross.default: lambda r, a, b, dim=-1: _cross(r, a, b, dim),
    **dict.fromkeys((aten.mm.default, aten.bmm.default), Rules.matmul),
    aten.addmm.default: lambda r, plus, a, b: r.each("add", plus, r.matmul(a, b)),
    aten.constant_pad_nd.default: _padded,
    aten.index_select.default: lambda r, x, dim, index: np.asarray(np.take(x, index.numpy(), axis=dim), dtype=object),
    aten.slice.Tensor: _slice,
    aten.select.int: lambda r, x, dim, index: np.asarray(np.take(x, index, axis=dim), dtype=object),
    aten.split_with_sizes.default: lambda r, x, sizes, dim=0: np.split(x, np.cumsum(sizes)[:-1], axis=dim),
    aten.split.Tensor: lambda r, x, size, dim=0: np.split(x, range(size, x.shape[dim], size), axis=dim),
    aten.unbind.int: lambda r, x, dim=0: [np.asarray(part, dtype=object) for part in np.moveaxis(x, dim, 0)],
    aten.cat.default: lambda r, parts, dim=0: np.concatenate(parts, axis=dim),
    aten.stack.default: lambda r, parts, dim=0: np.stack(parts, axis=dim),
    aten.flip.default: lambda r, x, dims: np.flip(x, dims),
    aten.expand.default: lambda r, x, shape, **_: np.broadcast_to(
        x, [x.shape[i - len(shape)] if n == -1 else n for i, n in enumerate(shape)]
    ),
    aten.unsqueeze.default: lambda r, x, dim: np.expand_dims(x, dim),
    **dict.fromkeys(SQUEEZES, lambda r, x, dim: np.squeeze(x, dim) if x.shape[dim] == 1 else x),
    **dict.fromkeys(RESHAPES, lambda r, x, shape: x.reshape(shape)),
    aten.permute.default: lambda r, x, dims: np.transpose(x, dims),
    aten.transpose.int: lambda r, x, a, b: np.swapaxes(x, a, b),
    aten.t.default: lambda r, x: x.T,
    **dict.fromkeys((aten.zeros_like.default, aten.zeros.default), _filled(0.0)),
    **dict.fromkeys((aten.ones_like.default, aten.ones.default), _filled(1.0)),
    **dict.fromkeys((aten.new_zeros.default, aten.new_full.default), _new),
    **dict.fromkeys((*COPIES, aten.lift_fresh_copy.default), lambda r, x, **_: x),
    operator.getitem: lambda r, parts, i: parts[i],
}
"""Rules by operation."""
