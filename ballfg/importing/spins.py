"""Takes the spins of shots from columns whose names state their unit."""

import math
import re
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

from ballfg.checks import listed
from ballfg.importing.shots import SourceShot
from ballfg.tracks.track import SPIN_LABELS

SPIN_UNITS: Final = {
    **dict.fromkeys(("rad/s", "rad/sec", "rads"), 1.0),
    **dict.fromkeys(("rev/s", "rev/sec", "rps", "hz"), 2.0 * math.pi),
    **dict.fromkeys(("rev/min", "rpm"), math.pi / 30.0),
    **dict.fromkeys(("deg/s", "deg/sec", "dps", "°/s"), math.pi / 180.0),
}
"""Units of a spin in rad/s."""
_WORDS: Final = re.compile(r"[^\s_.\-\[\](){}/]+")
_JOINED: Final = re.compile(r"\b(spin|omega|w)([xyz])(?![^\W\d_])")


def spin_column(name: str) -> tuple[str, float | None] | None:
    """Which of `SPIN_LABELS` a column's name means, and its unit in rad/s, None if unstated; None for other names."""
    words = _WORDS.findall(_JOINED.sub(r"\1 \2", name.lower()))
    axes = [word for word in words if word in ("x", "y", "z")]
    if len(axes) != 1 or words[0] not in ("spin", "omega", "w"):
        return None
    unit = "/".join(word for word in words[1:] if word not in (axes[0], "per"))
    return (f"spin_{axes[0]}", SPIN_UNITS.get(unit)) if unit in SPIN_UNITS or not unit else None


def with_spins(shots: Sequence[SourceShot]) -> tuple[list[SourceShot], list[str]]:
    """The shots with spin labels in rad/s, and a note on those from columns of other names, or on unused ones."""
    columns = dict.fromkeys(name for shot in shots for name in shot.labels)
    meant = {name: meaning for name in columns if (meaning := spin_column(name)) is not None}
    if not meant or all(name in columns for name in SPIN_LABELS):
        return list(shots), []
    units = {name: unit for name, (_, unit) in meant.items() if unit is not None}
    if sorted(meant[name][0] for name in units) != sorted(SPIN_LABELS):
        remedy = "a spin needs spin_x, spin_y and spin_z in rad/s, or names with a unit such as spin_x [rpm]"
        return list(shots), [f"{listed(meant)} {'stay labels' if len(meant) > 1 else 'stays a label'}: {remedy}"]
    found = []
    for shot in shots:
        numbers = {n: value for n in units if isinstance(value := shot.labels.get(n), int | float)}
        kept = {name: value for name, value in shot.labels.items() if name not in numbers}
        found.append(replace(shot, labels=kept | {meant[n][0]: units[n] * v for n, v in numbers.items()}))
    return found, [f"spin labels in rad/s from {listed(units)}"]
