"""Holds the result of a test for a pattern of any cause."""

from dataclasses import dataclass
from typing import Final

ALARM: Final = 0.005
"""Probability that any test of a complete fit raises an alarm: smaller p-values are alarms."""

APART: Final = "tracks"
"""Name of the test for whiteness where nothing is left once each track has its own coefficients."""

PREDICTED: Final = "predictions"
"""Name of the test of a model's noise on tracks that it was not fitted to."""


@dataclass(frozen=True)
class GenericTest:
    """A test for a pattern of any cause.

    Attributes:
        name: `flight`, `contact`, `measurement`, `recording` (coefficients from track to track), `label` (spin labels
            against flights), `time` (whiteness along the tracks), `tracks` (the same, where each track's own
            coefficients explain it) or `predictions` (errors on the held-out half against the noise).
        where: place, dependence and size of the pattern in words.
        p_value: probability of such a pattern by chance; for `label`, that every label is right.
        share: remaining part of the initial pattern, 0 to 1.
    """

    name: str
    where: str
    p_value: float
    share: float
