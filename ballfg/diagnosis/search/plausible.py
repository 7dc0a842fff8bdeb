"""Judges fitted coefficients by their bounds and by what is plausible for a ball, its table and its room."""

from typing import Final

from ballfg.diagnosis.result import Value
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.effect import Coefficient, Range
from ballfg.tracks import TABLE_TENNIS

NEAR: Final = 0.15
"""Relative. Largest difference from the radius of a table-tennis ball, for these ranges to apply."""
MARGIN: Final = 0.1
"""Share of a range by which a fitted value may lie outside of it."""
SIGMAS: Final = 3.0
"""Largest distance of a plausible value from its range, in standard deviations of the value."""


def range_of(name: str, radius: float) -> Range | None:
    """The plausible range of a coefficient, for a ball of some radius in m; None if unknown."""
    effect, _, coefficient = name.partition(".")
    known = EFFECTS.get(effect)
    if known is None or abs(radius / TABLE_TENNIS.radius - 1.0) > NEAR:
        return None
    return known.plausible if coefficient in {c.name for c in known.coefficients if c.absent is not None} else None


def implausible(name: str, value: Value, radius: float) -> str:
    """The reason why a fitted value is implausible; empty if it is plausible, or without a known range.

    Args: name: of effect and coefficient, `wind.x`.  radius: of the ball, m.
    """
    known = range_of(name, radius)
    if known is None:
        return ""
    slack = MARGIN * (known.high - known.low)
    if value.sigma > 0.0:
        slack = min(slack, SIGMAS * value.sigma)
    if known.low - slack <= value.value <= known.high + slack:
        return ""
    unit = "" if value.unit == "1" else f" {value.unit}"
    return f"{name} = {value.value:.3g}{unit} lies outside of {known.low:g} to {known.high:g}{unit} ({known.source})"


def at_bound(name: str, value: Value, coefficient: Coefficient) -> str:
    """The finding that tracks pull a coefficient to its bound; empty if it is inside, or held there by the model.

    Args: name: of effect and coefficient.  coefficient: as declared, with its bounds.
    """
    if value.value not in (coefficient.low, coefficient.high) or value.value == value.declared:
        return ""
    unit = "" if value.unit == "1" else f" {value.unit}"
    return f"{name} = {value.value:.3g}{unit} is the bound of that coefficient: the tracks ask for more"
