"""Declares the argument types of compiled functions."""

from typing import Any, Final, NamedTuple

from numba import types

ONE: Final[Any] = types.Array(types.float64, 1, "C")
TWO: Final[Any] = types.Array(types.float64, 2, "C")
THREE: Final[Any] = types.Array(types.float64, 3, "C")
FOUR: Final[Any] = types.Array(types.float64, 4, "C")
FIVE: Final[Any] = types.Array(types.float64, 5, "C")
COUNTS: Final[Any] = types.Array(types.int64, 1, "C")
INDEX: Final[Any] = types.Array(types.int64, 2, "C")
REAL: Final[Any] = types.float64
COUNT: Final[Any] = types.int64
FLAG: Final[Any] = types.boolean
NOTHING: Final[Any] = types.void
FUNCTION: Final[Any] = types.FunctionType(types.void(TWO, TWO, ONE, THREE, THREE, TWO, THREE))
"""A compiled function of a model, `compute(x, c, w, xt, ct, y, yt)`, of many states."""


class Law(NamedTuple):
    """A compiled function of a model, of n balls with coefficients c (n, p) and their tangents ct (n, p, d)."""

    compute: Any
    c: Any
    ct: Any
    w: Any  # (k,) weights


class Laws(NamedTuple):
    """Rates, impact and surface of a model, of n balls."""

    rates: Law
    impact: Law
    surface: Law


LAW: Final[Any] = types.NamedTuple((FUNCTION, TWO, THREE, ONE), Law)
LAWS: Final[Any] = types.NamedUniTuple(LAW, 3, Laws)
ADDRESS: Final[Any] = types.int64
"""Where a `FUNCTION` lies: numba takes 6 us to see what a function is that Python passes."""
GIVEN: Final = (*[ADDRESS] * 3, *[TWO, THREE] * 3, *[ONE] * 3)
"""`Laws` as Python passes them, since numba is slow to see what a tuple is: functions, coefficients, weights."""
ROLLING: Final = (ADDRESS, TWO, THREE, ONE)
"""The law of a ball that rests on a surface, as Python passes it."""


def several(kind: Any, count: int) -> Any:
    """A tuple of `count` equal types."""
    return types.UniTuple(kind, count)
