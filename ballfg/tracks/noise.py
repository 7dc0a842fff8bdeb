"""Holds the noise of a set of tracks as files state it: of the tracker, labels, bounces and flights."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, fields
from typing import Any, Final, Self

from ballfg.checks import check_instance, check_number, did_you_mean, shown, type_name

LIMITS: Final[Mapping[str, tuple[str, float]]] = {
    "position": ("m", 1.0),
    "memory": ("m", 1.0),
    "memory_time": ("s", 10.0),
    "stamp_jitter": ("s", 1.0),
    "spin_label": ("rad/s", 5000.0),
    "spin_prior": ("rad/s", 5000.0),
    "acceleration": ("m/s^2/sqrt(Hz)", 100.0),
    "contact_velocity": ("m/s", 50.0),
    "contact_tangential": ("m/s", 50.0),
    "contact_spin": ("rad/s", 5000.0),
}
"""Unit and largest value of each number; a larger one is in another unit."""
SMALLEST: Final = 1e-9  # least nonzero value of each number; with smaller noise, rounding errors outweigh the motion
PER_AXIS: Final = ("position", "memory")
MAY_BE_ZERO: Final = ("memory", "stamp_jitter", "contact_tangential")


@dataclass(frozen=True)
class TrackNoise:
    """Standard deviations; None if unknown.

    Raises: ValueError: a number that is negative, not finite, or cannot be in SI units; the message names it.
    """

    position: tuple[float, float, float] | None = None  # m, of the white error of a measured x, y, z
    memory: tuple[float, float, float] | None = None
    """m, of the tracker's error along x, y, z that lasts from sample to sample."""
    memory_time: float | None = None  # s, over which the correlation of that error falls to 1 / e
    stamp_jitter: float | None = None  # s, of the error of a stamp
    spin_label: float | None = None  # rad/s, of one component of a spin label
    spin_prior: float | None = None  # rad/s, of one component of the spin of a ball without a label, about zero
    acceleration: float | None = None  # m/s^2/sqrt(Hz), density of the unmodelled acceleration
    contact_velocity: float | None = None  # m/s, of each component of the velocity after a bounce
    contact_tangential: float | None = None  # m/s, in addition, of its two components along the surface
    contact_spin: float | None = None  # rad/s, of each component of the spin after a bounce
    coefficients: Mapping[str, float] = field(default_factory=dict)
    """Spread of coefficients between tracks, by the name of the parameter, in its own unit."""

    def __post_init__(self) -> None:
        for name in LIMITS:
            value = getattr(self, name)
            if value is not None:
                object.__setattr__(self, name, _checked(name, value))
        check_instance("noise.coefficients", self.coefficients, Mapping, "Write them like {'flight.drag.k': 0.01}.")
        for name, value in self.coefficients.items():
            check_number(f"noise.coefficients.{name}", value, "its own unit", above=0.0)

    @property
    def states_more_than_spreads(self) -> bool:
        """True if a number beside the spreads of coefficients is known."""
        return any(getattr(self, name) is not None for name in LIMITS)

    @classmethod
    def from_mapping(cls, content: Any) -> Self:
        """The noise in a parsed section of a file. Raises: ValueError: an unknown key, or a number out of its range."""
        if not isinstance(content, Mapping):
            raise ValueError(f"noise must be a mapping such as {{memory_time: 0.02}}; got {type_name(content)}.")
        known = [f.name for f in fields(cls)]
        for key in content:
            if key not in known:
                hint = did_you_mean(str(key), known) or f"Known ones: {', '.join(known)}."
                raise ValueError(f"noise.{key} is not known. {hint}")
        values = dict(content)
        coefficients = values.pop("coefficients", None) or {}
        if not isinstance(coefficients, Mapping):
            raise ValueError(f"noise.coefficients must map parameters to numbers; got {type_name(coefficients)}.")
        return cls(**values, coefficients={str(name): value for name, value in coefficients.items()})

    def to_mapping(self) -> dict[str, Any]:
        """The section of a file with this noise, without unknown numbers."""
        content: dict[str, Any] = {}
        for name in LIMITS:
            value = getattr(self, name)
            if value is not None:
                content[name] = list(value) if name in PER_AXIS else value
        return content | ({"coefficients": dict(self.coefficients)} if self.coefficients else {})


def _checked(name: str, value: Any) -> Any:
    above, least = (-1e-300, -math.inf) if name in MAY_BE_ZERO else (0.0, SMALLEST)
    unit, limit = LIMITS[name]

    def number(what: str, one: Any) -> float:
        return check_number(what, one, unit, above=above, least=least, limit=limit, instead=f"m{unit}")

    if name not in PER_AXIS:
        return number(f"noise.{name}", value)
    if not isinstance(value, list | tuple) or len(value) != 3:
        raise ValueError(f"noise.{name} must be three numbers in m, along x, y and z; got {shown(value)}.")
    return tuple(number(f"noise.{name}[{axis}]", one) for axis, one in enumerate(value))
