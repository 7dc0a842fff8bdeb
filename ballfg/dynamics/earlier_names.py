"""Names of parameters in files and scripts of earlier versions."""

import re
from collections.abc import Container
from typing import Final

_OF_BOUNCE: Final = re.compile(r"^((?:model\.|base\.)*)contact\.")


def todays_name(name: str, known: Container[str] = ()) -> str:
    """The name of a parameter today: a coefficient of the bounce, as `bounce.restitution.e`, began with `contact.`.

    Args:
        name: today's or an earlier one.
        known: names of today, which stay as they are: a network for the contact still is `contact`.
    """
    return name if name in known else _OF_BOUNCE.sub(r"\1bounce.", name)
