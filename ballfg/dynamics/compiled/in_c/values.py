"""Values of a function that is translated to C: constants, C expressions, and arrays whose sizes are known."""

import math
from collections.abc import Hashable, Sequence
from dataclasses import dataclass
from math import prod
from typing import Any, Final, TypeAlias

DOUBLE: Final = "double"
INT: Final = "int"  # C's types of numbers; truth values are int


ATOM, TIMES, PLUS, ANY = range(4)  # Ranks of operators: none, products, sums, and all that bind less than these


class UntranslatableError(Exception):
    """A function uses what has no translation to C."""


@dataclass(frozen=True)
class Constant:
    """A number that is known when the C text is written."""

    value: bool | int | float


@dataclass(frozen=True)
class Scalar:
    """A C expression without effects."""

    text: str  # without brackets around it
    kind: str  # its type
    rank: int = ATOM  # of its operator; more binds less


@dataclass(frozen=True)
class Array:
    """Numbers that lie one behind another."""

    pointer: str  # C expression
    shape: tuple[int | str | None, ...]
    """A length is a number, the name of an int of the function, or None, which nobody knows; only the first may be."""
    root: str  # name of the storage, to tell which arguments a function writes to
    fixed: bool = False  # true for a table of the whole text, which functions read without an argument

    @property
    def size(self) -> int:
        """Number of entries. Raises: UntranslatableError: if it is not known."""
        known = [n for n in self.shape if isinstance(n, int)]
        if len(known) < len(self.shape):
            raise UntranslatableError(f"the length of {self.pointer} is not known")
        return prod(known)

    @property
    def empty(self) -> bool:
        """True if there are no entries, and so no storage."""
        return 0 in self.shape

    def strides(self) -> list[int | str]:
        """How many numbers further the next entry along each dimension lies."""
        return [_product(self.shape[i + 1 :]) for i in range(len(self.shape))]


def _product(lengths: Sequence[int | str | None]) -> int | str:
    number, names = prod(n for n in lengths if isinstance(n, int)), [n for n in lengths if isinstance(n, str)]
    return " * ".join([*([str(number)] if number != 1 else []), *names]) if names else number


Value: TypeAlias = Any
"""A `Constant`, `Scalar` or `Array`, a (named) tuple of them, or an object of Python: a function, module or class."""


def kind_of(value: Value) -> str:
    """C's type of a number."""
    if isinstance(value, Constant):
        return DOUBLE if isinstance(value.value, float) else INT
    if isinstance(value, Scalar):
        return value.kind
    raise UntranslatableError(f"{value!r} is no number")


def text_of(value: Value, rank: int = ANY) -> str:
    """C expression of a number. Args: rank: of an operator; in brackets if its own binds less."""
    if isinstance(value, Scalar):
        return value.text if value.rank <= rank else f"({value.text})"
    if not isinstance(value, Constant):
        raise UntranslatableError(f"{value!r} is no number")
    number = value.value
    if isinstance(number, float) and math.isnan(number):
        return "NAN"
    size = abs(number)
    written = "INFINITY" if math.isinf(size) else repr(size) if isinstance(size, float) else str(int(size))
    if math.copysign(1.0, number) > 0:
        return written
    return f"-{written}" if rank == ANY else f"(-{written})"


def common(values: Sequence[Value]) -> str:
    """The type that can hold all of some numbers."""
    return DOUBLE if DOUBLE in map(kind_of, values) else INT


def lifted(value: object) -> Value:
    """A value from an object of Python: numbers become constants, also within tuples."""
    if isinstance(value, bool | int | float):
        return Constant(value)
    if type(value) is tuple:
        return tuple(map(lifted, value))
    return value


def leaves(value: Value) -> list[Any]:
    """The parts of a value that C passes as arguments: arrays and numbers, but for known truth values."""
    if isinstance(value, tuple):
        return [leaf for part in value for leaf in leaves(part)]
    if isinstance(value, Constant):
        return [] if isinstance(value.value, bool) else [value]
    passed = not (value.empty or value.fixed) if isinstance(value, Array) else isinstance(value, Scalar)
    return [value] if passed else []


def form(value: Value) -> Hashable:
    """What the translation of a function with such an argument depends on."""
    if isinstance(value, tuple):
        return type(value), tuple(map(form, value))
    if isinstance(value, Constant) and isinstance(value.value, bool):
        return value.value
    if isinstance(value, Constant | Scalar):
        return kind_of(value)
    if isinstance(value, Array):
        return value.shape, value.pointer if value.fixed else ""
    return value
