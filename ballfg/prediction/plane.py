"""Describes a plane that a ball may cross: where it is, in which direction, and after how many bounces."""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from typing import Final, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_array, check_choice, check_count, check_number, shown
from ballfg.state import POSITION, STATE_DIM, VZ

AXES: Final = ("x", "y", "z")
APEX, CONTACT = "apex", "next-contact"
DIRECTIONS: Final = ("either", "up", "down")
MOST_BOUNCES: Final = 20  # Largest number of bounces before a crossing: after so many a ball rolls
TOP: Final = np.eye(STATE_DIM)[VZ]  # An apex is a fall of this line (9,) . state through zero


@dataclass(frozen=True)
class Plane:
    """The plane normal . p = offset, and the crossings of it that count.

    Attributes:
        normal: (3,) dimensionless, of any length but zero.
        offset: m, in units of the normal's length.
        direction: `up` along the normal, `down` against it, or `either`.
        after: number of bounces before the crossing.

    Raises: ValueError, TypeError: numbers that are not finite, a normal of zero, an unknown direction, a number of
        bounces beyond `MOST_BOUNCES`.
    """

    normal: tuple[float, float, float]
    offset: float
    direction: str = "either"
    after: int = 0

    def __post_init__(self) -> None:
        normal = check_array("normal", self.normal)
        if normal.shape != (3,) or not (np.isfinite(normal).all() and normal.any()):
            raise ValueError(f"normal must be three finite numbers, not all zero; got {normal.tolist()}")
        check_number("offset", self.offset, "m")
        check_choice("direction", self.direction, DIRECTIONS)
        check_count("after", self.after, 0, MOST_BOUNCES)

    @classmethod
    def parse(cls, text: str) -> Self:
        """The plane of a text such as `x=2.0`, `z=3.05,down`, `z=0.9,up,after=1`, or `0.6:0:0.8=1.2` for any normal.

        Raises: ValueError: any other text.
        """
        place, *words = (word.strip() for word in text.split(","))
        given = {"direction" if word in DIRECTIONS else "after": word for word in words}
        bounces = re.fullmatch(r"after=(\d{1,3})", given.get("after", "after=0"))
        found = re.fullmatch(r"(\S+?)\s*=\s*(\S+)", place)
        normal = _normal(found[1]) if found else None
        offset = _number(found[2]) if found else math.nan
        if normal is None or bounces is None or len(given) != len(words) or not math.isfinite(offset):
            raise ValueError(
                f"plane must be an axis and a place in m; got {shown(text)}. Write x=2.0, for instance; z=3.05,down or "
                "z=0.9,up,after=1 for a direction and bounces before it; 0.6:0:0.8=1.2 across any other normal."
            )
        return cls(normal, offset, given.get("direction", "either"), int(bounces[1]))

    @property
    def line(self) -> tuple[Array, float]:
        """Normal (3,) of length one, and the offset in m."""
        normal = np.array(self.normal)
        length = float(np.linalg.norm(normal))
        return normal / length, self.offset / length


@dataclass(frozen=True, eq=False)
class Line:
    """An event at which a line of the state goes through an offset: an apex, or the crossing of a plane.

    Attributes:
        normal: (9,), offset: the ball has the event where normal . state is the offset.
        direction: `up`, `down` or `either`.  after: number of bounces before it.
    """

    normal: Array
    offset: float
    direction: str
    after: int

    @classmethod
    def of(cls, asked: Plane | str) -> Line:
        """The line of a plane; of `apex` for any text."""
        if not isinstance(asked, Plane):
            return cls(TOP, 0.0, "down", 0)
        normal, (towards, place) = np.zeros(STATE_DIM), asked.line
        normal[POSITION] = towards
        return cls(normal, place, asked.direction, asked.after)

    @property
    def is_apex(self) -> bool:
        """True for an apex."""
        return bool(self.normal[VZ])

    def value(self, states: Array) -> Array:
        """(...) line . state beyond the offset, of states (..., 9)."""
        return np.asarray(states @ self.normal - self.offset)

    @property
    def falling(self) -> tuple[Array, float]:
        """The normal and the offset, both turned where only a rise counts: a ball with the event falls through them."""
        return (-self.normal, -self.offset) if self.direction == "up" else (self.normal, self.offset)

    @property
    def either_way(self) -> bool:
        """True if a fall and a rise count."""
        return self.direction == "either"


def _normal(text: str) -> tuple[float, float, float] | None:
    """The normal of an axis by its name, or of three numbers; None for any other text."""
    if text in AXES:
        x, y, z = (float(axis == text) for axis in AXES)
        return x, y, z
    numbers = [_number(part) for part in text.split(":")]
    return (numbers[0], numbers[1], numbers[2]) if len(numbers) == 3 and np.isfinite(numbers).all() else None


def _number(text: str) -> float:
    try:
        return float(text)
    except ValueError:
        return math.nan


def asked_event(text: str) -> Plane | str:
    """The plane of a text, or `apex` or `next-contact` as they are. Raises: ValueError: any other text."""
    if text in (APEX, CONTACT):
        return text
    if "=" not in text:
        raise ValueError(f"event must be {APEX}, {CONTACT} or a plane such as z=3.05,down; got {shown(text)}")
    return Plane.parse(text)
