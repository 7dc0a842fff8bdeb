"""Checks arguments and fields: numbers, arrays, text, names.

Every message names the argument, the rule, the value and the remedy. Pydantic models of configurations check
themselves.
"""

import difflib
import itertools
import math
import reprlib
from collections.abc import Collection, Iterable, Iterator, Sequence
from numbers import Real
from os import PathLike
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

T = TypeVar("T")

_SYNONYMS = {
    "t": ("time", "timestamp", "stamp", "times", "time_s", "t_s"),
    "trajectory": ("track", "track_id", "trajectory_id", "id", "name", "shot"),
    "x": ("pos_x", "px", "x_m"),
    "y": ("pos_y", "py", "y_m"),
    "z": ("pos_z", "pz", "z_m"),
    "licence": ("license",),
}


MAX_SHOWN = 80  # Largest number of characters of a value in a message
LARGEST = 1e100  # Largest size of a measured number, in any unit: squares of much larger ones overflow
MAX_SAID = 160  # Largest number of characters of a library's own words in a message
MAX_LISTED = 12  # Largest number of names of a list in a message
MAX_NAME = 200
"""Largest number of characters of a name of a track, dataset, camera, label or group, which go to files and pages."""
MAX_TEXT = 2000  # Largest number of characters of other text in a file, such as the source of data
MAX_PATH, MAX_PART = 4095, 255
"""Largest numbers of characters of a path and of a name in it: no file system has longer ones."""
_JOINERS = "\u200c\u200d"  # Invisible letters in Persian, Indian scripts and emoji
_MAX_COMPARED = 200  # Largest number of candidates for a misspelt name; each takes some 20 microseconds


def type_name(value: object) -> str:
    """The name of a value's type, for a message."""
    return "nothing" if value is None else type(value).__name__


def is_visible(text: str) -> bool:
    """True for text without control or formatting characters, such as those that reverse its direction.

    Source: Unicode Standard Annex 44, general categories; those that start with C or Z, but for a space.
    """
    return text.isprintable() or all(letter.isprintable() or letter in _JOINERS for letter in text)


def visible(text: str) -> str:
    """The text with Python's escapes for all characters that a terminal would obey or not show."""
    if is_visible(text):
        return text
    return "".join(letter if is_visible(letter) else ascii(letter)[1:-1] for letter in text)


def drawn(text: str) -> str:
    """The text for a picture of matplotlib, which would read what stands between two `$` as mathematics."""
    return text.replace("$", r"\$")


def one_line(error: object) -> str:
    """The text of an error on one line, without its full stop."""
    return visible(" ".join(str(error).split())).rstrip(".")


def shown(value: object) -> str:
    """A value in a message: in Python's notation, or its beginning if that is longer than 80 characters.

    A long value is never written out in full, so that one with a million elements costs no time.
    """
    short = reprlib.Repr()
    short.maxstring = short.maxother = short.maxlong = MAX_SHOWN
    short.maxlevel = 3
    short.maxdict = short.maxlist = short.maxtuple = 8
    return short_text(" ".join(short.repr(value).split("\n")))


def short_text(text: str, most: int = MAX_SHOWN) -> str:
    """The text, or its beginning if it is longer than `most` characters; all of it visible."""
    return visible(text if len(text) <= most else f"{text[: most - 3]}...")


def listed(names: Collection[object]) -> str:
    """Names in a message: the first ones, and the number of further ones; line feeds and the like are escaped."""
    texts = map(str, itertools.islice(names, MAX_LISTED))
    first = [short_text(text if is_visible(text) else repr(text)) for text in texts]
    more = len(names) - len(first)
    return (", ".join(first) or "nothing") + (f" and {more} more" if more else "")


def aligned(rows: Sequence[Sequence[str]]) -> list[str]:
    """Lines of a table whose columns begin below one another."""
    widths = [max(map(len, column)) for column in zip(*rows, strict=True)]
    lines = ("  ".join(cell.ljust(width) for cell, width in zip(row, widths, strict=True)) for row in rows)
    return [line.rstrip() for line in lines]


def check_text(label: str, value: object, *, optional: bool = False) -> None:
    """Refuses a value other than non-empty text. Raises: TypeError: not text. ValueError: only spaces."""
    if value is None and optional:
        return
    if not isinstance(value, str):
        raise TypeError(f"{label} must be text; got {type_name(value)} {short_text(str(value))}. Put it in quotes.")
    if not value.strip():
        raise ValueError(f"{label} must not be empty; got {shown(value)}. Give it a text.")
    if not is_text(value):
        raise ValueError(f"{label} must be {TEXT_RULE}; got {shown(value)}. Correct it.")


TEXT_RULE = f"text of at most {MAX_TEXT} characters without control or formatting characters"
"""The rule for text other than names."""


def is_text(value: str) -> bool:
    """True for text, of one or several lines, that can be shown: `TEXT_RULE`."""
    return len(value) <= MAX_TEXT and is_visible("".join(value.split()))


def is_name(value: str) -> bool:
    """True for text that can name a track, a dataset, a camera, a label or a group: `NAME_RULE`."""
    return bool(value) and not value.isspace() and len(value) <= MAX_NAME and is_visible(value)


NAME_RULE = f"printable text of one line, 1 to {MAX_NAME} characters without control or formatting characters"
"""The rule for names."""


def check_name(label: str, value: object, remedy: str = "Rename it.") -> str:
    """Checks a name and returns it.

    Raises: TypeError: not text. ValueError: a name that files and terminals cannot show: `is_name`.
    """
    if not isinstance(value, str):
        raise TypeError(f"{label} must be text; got {type_name(value)} {shown(value)}. Put it in quotes.")
    if not is_name(value):
        raise ValueError(f"{label} must be {NAME_RULE}; got {shown(value)}. {remedy}")
    return value


def check_keys(where: str, content: dict[Any, Any], known: Collection[str], needed: Collection[str]) -> None:
    """Refuses a mapping with other keys than the known ones, or without a needed one.

    Args: where: start of the message.  content: the mapping.  known: its possible keys.  needed: required keys.
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
            rule, empty = f"{where}: field {shown(key)} is required", key in content
            raise ValueError(f"{rule}; it is empty. Fill it." if empty else f"{rule}; got {listed(content)}. Add it.")


def nearest(name: str, candidates: Iterable[str]) -> str | None:
    """The candidate most like `name` (apart from spaces, case and common synonyms), or None if none is near."""
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
    """True for a real number; a bool is not one, nor is a numpy difference of dates."""
    return isinstance(value, Real) and not isinstance(value, bool | np.timedelta64)


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
        label: name of the argument in the message.  value: to be checked.  unit: of the number.
        above: the value must be greater, if given.  least: the smallest plausible value, if it differs from `above`.
        limit: the largest plausible size in this unit.  instead: the probable unit of a larger value.
    Raises: TypeError: not a number. ValueError: not finite, or out of range.
    """
    number = as_float(label, value, unit)
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
    """A number within [low, high] as a float. Raises: TypeError: not a number. ValueError: out of range, as NaN is."""
    number = as_float(label, value)
    if not low <= number <= high:
        top = "" if math.isinf(high) else f", at most {high:g}"
        raise ValueError(f"{label} must be at least {low:g}{top}; got {number:g}. Correct it (SI units).")
    return number


def check_count(label: str, value: Any, low: int, high: int | None = None) -> int:
    """A whole number within [low, high]; without `high`, of any size from `low` on.

    Raises: TypeError: not a whole number. ValueError: out of range.
    """
    if not is_number(value) or not isinstance(value, int | np.integer):
        raise TypeError(f"{label} must be a whole number; got {shown(value)}. Write it without a point.")
    if value < low or (high is not None and value > high):
        rule = f"be at least {low}" if high is None else f"lie in {low} .. {high}"
        raise ValueError(f"{label} must {rule}; got {shown(value)}. Choose another.")
    return int(value)


def check_instance(label: str, value: Any, kind: type[Any], remedy: str) -> Any:
    """The value, if it is of a type. Raises: TypeError: naming both types."""
    if not isinstance(value, kind):
        article = "an" if kind.__name__[0] in "AEIOaeio" else "a"
        raise TypeError(f"{label} must be {article} {kind.__name__}; got {type_name(value)} {shown(value)}. {remedy}")
    return value


def as_float(label: str, value: Any, unit: str = "") -> float:
    """A real number as a float, which may be NaN or infinite; a bool is refused. Raises: TypeError: naming the type."""
    if not is_number(value):
        rule, got = (
            (f"a number in {unit}", f"{type_name(value)} {shown(value)}") if unit else ("a number", shown(value))
        )
        raise TypeError(f"{label} must be {rule}; got {got}. Write it like 0.02 or 2.0e-2.")
    try:
        return float(value)
    except OverflowError:  # a whole number of 400 digits
        return math.inf if value > 0 else -math.inf


def check_iterable(label: str, value: object) -> None:
    """Refuses a single value, and text. Raises: TypeError: naming the type."""
    if not isinstance(value, Iterable) or isinstance(value, str | bytes):
        raise TypeError(f"{label} must be a list or tuple; got {type_name(value)} {shown(value)}. Put it in a list.")


def check_each(label: str, values: Iterable[T], kind: type[Any], remedy: str) -> Iterator[T]:
    """The values one by one, each checked on its turn.

    Raises: TypeError: at once for a single value; later for a value of another type.
    """
    check_iterable(label, values)
    return (check_instance(f"each of {label}", value, kind, remedy) for value in values)


def check_flag(label: str, value: object) -> bool:
    """True or False. Raises: TypeError: anything else."""
    if not isinstance(value, bool | np.bool_):
        raise TypeError(f"{label} must be True or False; got {type_name(value)} {shown(value)}. Give one of them.")
    return bool(value)


def check_choice(label: str, value: object, known: Collection[str]) -> None:
    """Refuses a value other than the known names. Raises: ValueError: listing them."""
    if not isinstance(value, str) or value not in known:
        raise ValueError(f"{label} must be one of {listed(known)}; got {shown(value)}. Choose one of them.")


def check_path(label: str, value: object) -> Path:
    """The path of a file or folder.

    Raises: TypeError: neither text nor a path. ValueError: an impossible path: with a NUL, or too long.
    """
    if not isinstance(value, str | PathLike):
        raise TypeError(f"{label} must be a path; got {type_name(value)} {shown(value)}. Give it as text or Path.")
    path = Path(value)
    if "\0" in str(path):
        raise ValueError(f"{label} must be a path without a NUL; got {shown(str(path))}. Correct it.")
    if len(str(path)) > MAX_PATH or any(len(part) > MAX_PART for part in path.parts):
        raise ValueError(
            f"{label} must be a path of at most {MAX_PATH} characters, each name in it of at most {MAX_PART}; got "
            f"{shown(str(path))}. Shorten it."
        )
    return path


def check_array(
    label: str,
    value: ArrayLike,
    shape: tuple[int, ...] | None = None,
    remedy: str = "Correct it.",
    most: float = LARGEST,
) -> NDArray[np.float64]:
    """A copy as float64.

    Args: label: name of the array in the message.  value: to be checked.  shape: the required one, if fixed.
        remedy: last sentence of the message.  most: largest size of a finite number.
    Raises: ValueError: not numbers, numbers under a mask or beyond `most`, or another shape.
    """
    try:
        given = np.asanyarray(value)
        problem = _no_numbers(given)
        plain = given.tolist() if given.dtype.kind == "U" else given  # numpy has messages of its own for texts
        array = np.array(plain, dtype=None if problem else np.float64)
    except (TypeError, ValueError, OverflowError, RuntimeError) as error:  # the last: a tensor with a gradient
        raise ValueError(
            f"{label} must be an array of numbers; {short_text(one_line(error), MAX_SAID)}. {remedy}"
        ) from None
    if problem:
        raise ValueError(f"{label} must be an array of numbers; {problem}")
    if shape is not None and array.shape != shape:
        raise ValueError(f"{label} must have shape {shape}; got {array.shape}. {remedy}")
    if not np.abs(array).max(initial=0.0) <= most:  # one of them is not finite, or too large
        beyond = array[np.isfinite(array) & (np.abs(array) > most)]
        if beyond.size:
            raise ValueError(f"{label} must be within {most:g}; got {beyond[0]:g}. {remedy}")
    return array


_NO_NUMBERS = {
    "b": ("truth values", "Convert them yourself if they are meant."),
    "c": ("complex numbers", "Take their real parts if they are meant."),
    "m": ("time differences", "Divide them by np.timedelta64(1, 's')."),
    "M": ("dates", "Subtract the first one and divide by np.timedelta64(1, 's')."),
}
"""Arrays that numpy converts to numbers silently, by kind: a description, and the remedy."""


def _no_numbers(array: NDArray[Any]) -> str:
    """The reason why an array does not hold numbers, though numpy would convert it, and the remedy; else empty."""
    if array.dtype.kind in _NO_NUMBERS:
        what, instead = _NO_NUMBERS[array.dtype.kind]
        return f"got {what}. {instead}"
    masked = int(np.ma.count_masked(array)) if isinstance(array, np.ma.MaskedArray) else 0
    return f"{masked} of them are masked. Drop those rows." if masked else ""
