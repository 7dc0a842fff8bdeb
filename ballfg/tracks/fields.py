"""Checks of single fields of a frozen dataclass."""

import numpy as np


def kind(value: object) -> str:
    """The name of a value's type, for a message."""
    return "nothing" if value is None else type(value).__name__


def check_text(key: str, value: object, *, optional: bool) -> None:
    """Refuses a value that is not text with something in it; TypeError, ValueError."""
    if value is None and optional:
        return
    if not isinstance(value, str):
        raise TypeError(f"{key} must be text; got {kind(value)} {value}. Put it in quotes.")
    if not value.strip():
        raise ValueError(f"{key} must not be empty; got {value!r}. Give it a text.")


def set_number(
    owner: object,
    attribute: str,
    label: str,
    unit: str,
    *,
    above: float | None = None,
    limit: float = np.inf,
    instead: str = "",
) -> None:
    """Checks one numeric field of a frozen dataclass and stores it as float.

    Args:
        owner: the dataclass.
        attribute: its field.
        label: what the message calls it.
        unit: the field's unit.
        above: the value must be greater, if given.
        limit: the largest size that can be meant in this unit.
        instead: the unit that a larger value is probably in.
    Raises: TypeError: not a number. ValueError: not finite, or out of range.
    """
    value = getattr(owner, attribute)
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise TypeError(
            f"{label} must be a number in {unit}; got {kind(value)} {value!r}. Write it like 0.02 or 2.0e-2."
        )
    number = float(value)
    if not np.isfinite(number) or (above is not None and number <= above):
        rule = "finite" if above is None else f"finite and above {above:g}"
        raise ValueError(f"{label} must be {rule}; got {number:g}. Correct it (unit: {unit}).")
    if abs(number) > limit:
        raise ValueError(
            f"{label} must be in {unit}, at most {limit:g}; got {number:g}. "
            f"It is probably in {instead}: convert it to {unit}."
        )
    object.__setattr__(owner, attribute, number)
