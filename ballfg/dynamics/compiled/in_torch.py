"""Calls a model's torch functions from machine code, for models that cannot be compiled.

Prediction then runs the same code for every model, only more slowly.
"""

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from itertools import count
from typing import Final

import numpy as np
import torch
from numba import njit, objmode, types
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import Code
from ballfg.dynamics.compiled.functions import PARTS, CompiledModel, Function
from ballfg.dynamics.compiled.motion import FAILED
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.dynamics.compiled.signatures import ONE, THREE, TWO
from ballfg.dynamics.model import BallModel, substitute

SIZES: Final = (6, 9, 3, 6)  # Number of outputs of rates, impact, surface and rolling

_asked: dict[int, Callable[[Tensor, Tensor], Tensor]] = {}


def _answer(number, x, c, xt, ct, y, yt):  # type: ignore[no-untyped-def]
    """Computes one function; an error waits for `motion.raise_errors`, since machine code cannot pass it on."""
    try:
        given = (torch.from_numpy(np.array(x)), torch.from_numpy(np.array(c)))
        if not xt.shape[1]:
            with torch.no_grad():
                y[:] = _asked[number](*given).numpy()
            return
        leaves = [value.expand(len(y), -1).clone().requires_grad_(True) for value in given]  # one row an output
        with torch.enable_grad():
            rows = _asked[number](*leaves)
        y[:], yt[:] = rows[0].detach().numpy(), 0.0
        if not rows.requires_grad:  # a weight alone
            return
        slopes = torch.autograd.grad(rows.diagonal().sum(), leaves, allow_unused=True)
        for slope, moved in zip(slopes, (xt, ct), strict=True):
            if slope is not None:
                yt += slope.numpy() @ moved
    except Exception as error:
        FAILED.errors.append(error)
        y[:], yt[:] = np.nan, np.nan


@cache
def _code() -> Code:
    @njit(types.void(TWO, TWO, ONE, THREE, THREE, TWO, THREE))
    def compute(x, c, w, xt, ct, y, yt):  # type: ignore[no-untyped-def]
        with objmode():
            for given in zip(x, c, xt, ct, y, yt, strict=True):
                _answer(int(w[0]), *given)

    return Code(compute)


@dataclass(frozen=True)
class InTorch(CompiledModel):
    """The functions of a model in torch; their weights are the `numbers` that identify them."""

    numbers: tuple[int, ...]

    def weights(self, model: BallModel) -> tuple[Array, ...]:
        """The numbers of its parts."""
        return tuple(np.array([float(number)]) for number in self.numbers)


_made: weakref.WeakKeyDictionary[BallModel, InTorch] = weakref.WeakKeyDictionary()
_next = count()


def in_torch(model: BallModel) -> InTorch:
    """The functions of any model; each call costs about half a millisecond."""
    if model not in _made:
        names, known = tuple(numbers_of(model).scalars), weakref.ref(model)
        numbers = tuple(next(_next) for _ in PARTS)
        for number, part in zip(numbers, PARTS, strict=True):
            _asked[number] = partial(_value, known, part, names)
            weakref.finalize(model, _asked.pop, number)
        rates, impact, surface, rolling = (Function(_code(), names, size) for size in SIZES)
        _made[model] = InTorch(rates, impact, surface, rolling, model.radius, numbers)
    return _made[model]


def _value(
    known: weakref.ref[BallModel],
    part: Callable[[BallModel, Tensor], Tensor],
    names: tuple[str, ...],
    state: Tensor,
    coefficients: Tensor,
) -> Tensor:
    model = known()
    assert model is not None, "whoever computes with a model keeps it"
    values = coefficients.unbind() if state.dim() == 1 else coefficients.split(1, dim=1)
    return part(substitute(model, dict(zip(names, values, strict=True))), state)
