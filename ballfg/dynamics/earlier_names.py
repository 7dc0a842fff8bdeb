"""Names of parameters in files and scripts of earlier versions."""

import re
import warnings
from collections.abc import Container, Iterable
from typing import Final

_OF_BOUNCE: Final = re.compile(r"^((?:model\.|base\.)*)contact\.")


def todays_name(name: str, known: Container[str] = ()) -> str:
    """The name of a parameter today: a coefficient of the bounce, as `bounce.restitution.e`, began with `contact.`.

    Args:
        name: today's or an earlier one.
        known: names of today, which stay as they are: a network for the contact still is `contact`.
    """
    return name if name in known else _OF_BOUNCE.sub(r"\1bounce.", name)


def todays_names(names: Iterable[str], known: Container[str] = ()) -> tuple[str, ...]:
    """Names of parameters today, with a `DeprecationWarning` for each that a user wrote in its earlier form.

    Args: names, known: as for `todays_name`.
    """
    pairs = [(name, todays_name(name, known)) for name in names]
    for earlier, name in pairs:
        if earlier != name:
            warn_of(earlier, name)
    return tuple(name for _, name in pairs)


def warn_of(earlier: str, name: str) -> None:
    """A `DeprecationWarning` that gives the name of today, and the version that refuses the earlier one."""
    message = f"'{earlier}' is the earlier name of '{name}' and will be refused from version 0.2 on. Write '{name}'."
    warnings.warn(message, DeprecationWarning, stacklevel=3)
