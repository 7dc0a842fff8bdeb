"""Fills the sentences that effects have for readers (`says`) with fitted numbers.

| field | gives |
|---|---|
| `{k:.3g}` | a coefficient as fitted, in any format of Python; `{k:abs .3g}` without its sign |
| `{k:%}`, `{k:points}`, `{k:milli}` | its size in per cent, with or without the sign for it, or in thousandths |
| `{k:grows|falls}` | the first word if it is positive or zero, else the second |
| `{k:lost}` | of a rate in 1/s: the loss after one second, in per cent |
| `{size}`, `{direction}`, `{degrees}` | of x, y, z: length, `along -y` or the components, angle in degrees |
| `{apart}` | largest less smallest of x, y, z |
| `{axes:long|short}` | for instance `2 % too long along x`: each of x, y, z that differs from zero by two sigmas |
"""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final, Protocol

MOSTLY_ALONG: Final = 0.9  # Share of a vector's length along one axis above which the vector is said to point along it
CLEAR: Final = 2.0  # Standard deviations from which a component is mentioned


class Fitted(Protocol):
    """A number with its standard deviation, in one unit."""

    @property
    def value(self) -> float:
        """The number."""

    @property
    def sigma(self) -> float:
        """Its standard deviation."""


class _Number(float):
    def __format__(self, spec: str) -> str:
        more, bar, less = spec.partition("|")
        if bar:
            return less if self < 0.0 else more
        if spec.startswith("abs "):
            return format(abs(float(self)), spec.removeprefix("abs "))
        if spec in ("points", "%"):
            return f"{_short(100 * abs(self))}{' %' if spec == '%' else ''}"
        if spec == "milli":
            return _short(1e3 * abs(self))
        return f"{_short(100 * -math.expm1(-self))} %" if spec == "lost" else format(float(self), spec)


def _short(number: float) -> str:
    """Two digits, or all before the point."""
    return f"{number:.0f}" if number >= 99.5 else f"{number:.2g}"


@dataclass(frozen=True)
class _Axes:
    parts: Mapping[str, Fitted]

    def __format__(self, spec: str) -> str:
        clear = {a: v for a, v in self.parts.items() if abs(v.value) > CLEAR * v.sigma} or self.parts
        numbers = {axis: _Number(v.value) for axis, v in clear.items()}
        return ", ".join(f"{number:%} too {number:{spec}} along {axis}" for axis, number in numbers.items())


def said(says: str, values: Mapping[str, Fitted]) -> str:
    """A sentence with its fields filled in.

    Args: says: with fields.  values: of the coefficients, by name, each in its own unit.
    Raises: KeyError: an unknown field. ValueError: an unknown format.
    """
    vector = {axis: values[axis] for axis in "xyz" if axis in values}
    numbers: dict[str, object] = {name: _Number(value.value) for name, value in values.items()}
    if vector:
        parts = {axis: value.value for axis, value in vector.items()}
        size, all_three = math.hypot(*parts.values()), [parts.get(axis, 0.0) for axis in "xyz"]
        numbers |= {"size": _Number(size), "direction": _direction(parts, size), "axes": _Axes(vector)}
        numbers |= {"degrees": f"{math.degrees(size):.2g}°", "apart": _Number(max(all_three) - min(all_three))}
    return says.format_map(numbers)


def _direction(parts: Mapping[str, float], size: float) -> str:
    """For instance `along x`, `along -y`, or the components where no axis is nearly the vector's."""
    axis, largest = max(parts.items(), key=lambda item: abs(item[1]))
    if abs(largest) >= MOSTLY_ALONG * size:
        return f"along {'-' if largest < 0 else ''}{axis}"
    return "with " + ", ".join(f"{name} {value:.2g}" for name, value in parts.items())
