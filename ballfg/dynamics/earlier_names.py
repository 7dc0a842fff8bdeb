"""Translates parameter names of earlier versions in files and scripts."""

import re
import warnings
from collections.abc import Container, Iterable
from typing import Final

_OF_BOUNCE: Final = re.compile(r"^((?:model\.|base\.)*)contact\.")


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
