"""What a test for a pattern of any cause says of a fit."""

from dataclasses import dataclass
from typing import Final

ALARM: Final = 0.005
"""Probability that any of the tests of a fit that lacks nothing raises an alarm: p-values below it are alarms."""


@dataclass(frozen=True)
class GenericTest:
    """A test for a pattern of any cause.

    Attributes:
        name: `flight`, `contact`, `measurement`, `recording` (coefficients from track to track), `label` (spin labels
            against flights) or `time` (whiteness along the tracks).
        where: place, dependence and size of the pattern in words.
        p_value: probability of such a pattern by chance; of `label`, that every label is right.
        share: part of the pattern at the start that is still there, 0 to 1.
    """

    name: str
    where: str
    p_value: float
    share: float
