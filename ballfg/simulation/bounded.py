"""Declares dataclass fields for numbers within bounds, and checks them."""

from dataclasses import field, fields
from typing import Any

from ballfg.checks import check_count, check_range


def bounded(default: float, low: float, high: float) -> Any:
    """A dataclass field that must lie within [low, high]; a whole number if its default is one."""
    return field(default=default, metadata={"bounds": (low, high)})


def check_bounds(config: Any, group: str = "") -> None:
    """Refuses values out of their bounds, and converts whole numbers to floats in float fields.

    Args: config: a frozen dataclass with `bounded` fields.  group: prefix of its fields' names in messages.
    Raises: TypeError: a value that is not a number. ValueError: a value out of its bounds, or NaN.
    """
    for spec in fields(config):
        if "bounds" in spec.metadata:
            check = check_count if isinstance(spec.default, int) else check_range
            value = check(group + spec.name, getattr(config, spec.name), *spec.metadata["bounds"])
            object.__setattr__(config, spec.name, value)
