"""Checks of arguments and fields: numbers, arrays, text, names.

Every message says the argument, the rule, what came instead and the remedy. Configurations that are models of pydantic
check themselves.
"""

import difflib
import itertools
import math
import reprlib
from collections.abc import Collection, Iterable
from numbers import Real
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

_SYNONYMS = {
    "t": ("time", "timestamp", "stamp", "times", "time_s", "t_s"),
    "trajectory": ("track", "track_id", "trajectory_id", "id", "name", "shot"),
    "x": ("pos_x", "px", "x_m"),
    "y": ("pos_y", "py", "y_m"),
    "z": ("pos_z", "pz", "z_m"),
    "licence": ("license",),
}


MAX_SHOWN = 80
"""Characters of a value in a message."""
MAX_LISTED = 12
"""Names in a list in a message."""
_MAX_COMPARED = 200
"""Candidates that a misspelt name is compared with; each takes some 20 microseconds."""


def type_name(value: object) -> str:
    """The name of a value's type, for a message."""
    return "nothing" if value is None else type(value).__name__


def one_line(error: object) -> str:
    """The text of an error on one line, without its full stop."""
    return " ".join(str(error).split()).rstrip(".")


def shown(value: object) -> str:
    """A value in a message: as Python writes it, or its beginning where that is longer than 80 characters.

    Nothing of a long value is written out in between, so that one that holds a million others costs no time.
    """
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = MAX_SHOWN
    short.maxlevel = 3
    short.maxdict = short.maxlist = short.maxtuple = 8
    return short_text(short.repr(value))


def short_text(text: str, most: int = MAX_SHOWN) -> str:
    """The text, or its beginning where it is longer than a message can hold, `most` characters."""
    return text if len(text) <= most else f"{text[: most - 3]}..."


def listed(names: Collection[object]) -> str:
    """Names in a message: the first ones, and how many more there are; line feeds and their like as in Python."""
    first = [
        short_text(str(name) if str(name).isprintable() else repr(name)) for name in itertools.islice(names, MAX_LISTED)
    ]
    more = len(names) - len(first)
    return (", ".join(first) or "nothing") + (f" and {more} more" if more else "")


def check_text(label: str, value: object, *, optional: bool = False) -> None:
    """Refuses a value that is not text with something in it.

    Raises: TypeError: not text. ValueError: nothing but spaces.
    """
    if value is None and optional:
        return
    if not isinstance(value, str):
        raise TypeError(f"{label} must be text; got {type_name(value)} {short_text(str(value))}. Put it in quotes.")
    if not value.strip():
        raise ValueError(f"{label} must not be empty; got {shown(value)}. Give it a text.")


def check_keys(where: str, content: dict[Any, Any], known: Collection[str], needed: Collection[str]) -> None:
    """Refuses a mapping with other keys than the known ones, or without a needed one.

    Args: where: begins the message.  content: the mapping.  known: its possible keys.  needed: those with a value.
    Raises: ValueError: naming the key.
    """
    absent = [key for key in known if key not in content]
    for key in content:
        if key not in known:
            hint = did_you_mean(str(key), absent)
            raise ValueError(
                f"{where}: fields must be among {', '.join(known)}; got {shown(key)}.{hint} Rename or delete it."
            )
    for key in needed:
        if content.get(key) is None:
            raise ValueError(f"{where}: field {shown(key)} is required; got {listed(content)}. Add it.")


def nearest(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate most like `name` (spaces, case and common synonyms set aside), or None if none is near."""
    if len(name) > MAX_SHOWN:
        return None
    near = (candidate for candidate in candidates if len(candidate) <= MAX_SHOWN)
    plain = {candidate.strip().lower(): candidate for candidate in itertools.islice(near, _MAX_COMPARED)}
    wanted = name.strip().lower()
    for main, others in _SYNONYMS.items():
        group = (main, *others)
        if wanted in group:
            for other in group:
                if other in plain:
                    return plain[other]
    found = difflib.get_close_matches(wanted, plain, n=1, cutoff=0.6)
    return plain[found[0]] if found else None


def did_you_mean(name: str, candidates: Iterable[str]) -> str:
    """`" Did you mean 'x'?"`, or empty text if nothing is near."""
    found = nearest(name, candidates)
    return "" if found is None else f" Did you mean {found!r}?"


def is_number(value: object) -> bool:
    """Whether a value is a real number; a bool is none."""
    return isinstance(value, Real) and not isinstance(value, bool)


def check_number(
    label: str,
    value: Any,
    unit: str = "",
    *,
    above: float | None = None,
    least: float = -math.inf,
    limit: float = math.inf,
    instead: str = "",
) -> float:
    """A finite number as a float.

    Args:
        label: what the message calls it.
        value: to check.
        unit: of the number.
        above: the value must be greater, if given.
        least: the smallest value that can be meant, where that is another one than `above`.
        limit: the largest size that can be meant in this unit.
        instead: the unit that a larger value is probably in.
    Raises: TypeError: not a number. ValueError: not finite, or out of range.
    """
    _check_type(label, value, unit)
    try:
        number = float(value)
    except OverflowError:  # a whole number of 400 digits
        number = math.inf
    if not math.isfinite(number) or (above is not None and number <= above):
        rule = "finite" if above is None else f"finite and above {above:g}"
        raise ValueError(f"{label} must be {rule}; got {number:g}. Correct it{f' (unit: {unit})' if unit else ''}.")
    if number < least:
        raise ValueError(f"{label} must be at least {least:g} {unit}; got {number:g}. Correct it.")
    if abs(number) > limit:
        raise ValueError(
            f"{label} must be in {unit}, at most {limit:g}; got {number:g}. "
            f"It is probably in {instead}: convert it to {unit}."
        )
    return number


def check_range(label: str, value: Any, low: float, high: float) -> float:
    """A number within [low, high] as a float.

    Raises: TypeError: not a number. ValueError: out of range, as NaN is.
    """
    _check_type(label, value)
    if not low <= value <= high:
        top = "" if math.isinf(high) else f", at most {high:g}"
        raise ValueError(f"{label} must be at least {low:g}{top}; got {value:g}. Correct it (SI units).")
    return float(value)


def check_count(label: str, value: Any, low: int, high: int) -> int:
    """A whole number within [low, high].

    Raises: TypeError: not a whole number. ValueError: out of range.
    """
    if isinstance(value, bool) or not isinstance(value, int | np.integer):
        raise TypeError(f"{label} must be a whole number; got {shown(value)}. Write it without a point.")
    if not low <= value <= high:
        raise ValueError(f"{label} must lie in {low} .. {high}; got {value}. Choose another.")
    return int(value)


def _check_type(label: str, value: object, unit: str = "") -> None:
    if not is_number(value):
        rule, got = (
            (f"a number in {unit}", f"{type_name(value)} {shown(value)}") if unit else ("a number", shown(value))
        )
        raise TypeError(f"{label} must be {rule}; got {got}. Write it like 0.02 or 2.0e-2.")


def check_array(
    label: str, value: ArrayLike, shape: tuple[int, ...] | None = None, remedy: str = "Correct it."
) -> NDArray[np.float64]:
    """A copy as float64.

    Args: label: what the message calls the array.  value: to check.  shape: the right one, if it is fixed.
        remedy: last sentence of the message.
    Raises: ValueError: not numbers, or another shape.
    """
    try:
        array = np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise ValueError(f"{label} must be an array of numbers; {error}. {remedy}") from None
    if shape is not None and array.shape != shape:
        raise ValueError(f"{label} must have shape {shape}; got {array.shape}. {remedy}")
    return array
