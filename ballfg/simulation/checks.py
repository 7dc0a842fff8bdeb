"""Checks of configuration values."""

from __future__ import annotations

import math


def check_range(name: str, value: object, low: float, high: float) -> float:
    """A field's value as a float within [low, high].

    Raises: TypeError: if it is not a number. ValueError: if it is out of range; NaN is.
    """
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise TypeError(f"{name} must be a number; got {value!r}. Write it like 0.02.")
    if not low <= value <= high:
        top = "" if math.isinf(high) else f", at most {high:g}"
        raise ValueError(f"{name} must be at least {low:g}{top}; got {value:g}. Correct it (SI units).")
    return float(value)


def check_count(name: str, value: object, low: int, high: int) -> int:
    """A field's value as a whole number within [low, high].

    Raises: TypeError: if it is not a whole number. ValueError: if it is out of range.
    """
    if isinstance(value, bool) or not isinstance(value, int):
        raise TypeError(f"{name} must be a whole number; got {value!r}.")
    if not low <= value <= high:
        raise ValueError(f"{name} must lie in {low} .. {high}; got {value}. Choose another.")
    return value
