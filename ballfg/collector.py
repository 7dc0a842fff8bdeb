"""How often Python looks for objects that nothing but themselves refers to."""

import gc
from typing import Final

MADE: Final = 50_000
"""Objects made, beyond those that went, before Python looks among the new ones; 700 by itself."""


def collect_rarely() -> None:
    """Has a program's process look less often.

    torch and its like make a million objects that stay. To look through them again and again while they are being
    imported takes a tenth of a command's start.
    """
    gc.set_threshold(MADE, *gc.get_threshold()[1:])
