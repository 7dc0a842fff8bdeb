"""A coefficient is one number of a model, with the spread of its prior, its bounds and its name of today."""

from __future__ import annotations

import re
import warnings
from collections.abc import Container, Iterable
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

DOUBT: Final = "fading."  # Prefix of the names of what a `LearnedModel` doubts in its correction
THIN_SHELL: Final = 2.0 / 3.0  # Moment of inertia of a thin spherical shell divided by m R^2
_OF_BOUNCE: Final = re.compile(r"^((?:model\.|base\.)*)contact\.")


@dataclass(frozen=True)
class Coefficient:
    """One number of an effect: its name, nominal value, prior spread, unit, bounds and where they come from."""

    name: str
    default: float
    """Nominal value for a table-tennis ball."""
    sigma: float
    """Prior standard deviation, from the spread of real balls, tables and cameras. 0: a constant."""
    unit: str
    """SI unit, `1` where the number has none."""
    low: float
    """Smallest value accepted."""
    high: float
    """Largest value accepted."""
    varies: bool = False
    """True if the coefficient differs between balls or days by more than one track can resolve: fit per track."""
    absent: float | None = 0.0
    """The value at which the effect vanishes. None for a shape (a reference, a centre, a size), which changes nothing
    while all other coefficients of its effect are absent."""


def coefficient_sigmas(model: BallModel) -> dict[str, float]:
    """Prior standard deviations of the coefficients that are estimated with each track, by parameter name.

    Args: model: a model without declared coefficients gives an empty mapping.
    Returns: for instance {"flight.drag.k": 0.035}; those that do not vary, or are known, are left out.
    """
    return {name: c.sigma for name, c in model.declared_coefficients().items() if c.varies and c.sigma > 0.0}


def todays_name(name: str, known: Container[str] = ()) -> str:
    """Today's name of a parameter: `bounce.restitution.e`, for instance, was `contact.restitution.e`.

    Args:
        name: today's or an earlier one.
        known: today's names, which stay: `contact` is still the name of a learned model's network.
    """
    return name if name in known else _OF_BOUNCE.sub(r"\1bounce.", name)


def todays_names(names: Iterable[str], known: Container[str] = ()) -> tuple[str, ...]:
    """Today's names of parameters, with a `DeprecationWarning` for each earlier name."""
    pairs = [(name, todays_name(name, known)) for name in names]
    for earlier, name in pairs:
        if earlier != name:
            warn_of(earlier, name)
    return tuple(name for _, name in pairs)


def warn_of(earlier: str, name: str) -> None:
    """A `DeprecationWarning` with today's name and the version that will refuse the earlier one."""
    message = f"'{earlier}' is the earlier name of '{name}' and will be refused from version 0.2 on. Write '{name}'."
    warnings.warn(message, DeprecationWarning, stacklevel=3)
