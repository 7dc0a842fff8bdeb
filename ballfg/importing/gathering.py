"""Gathers the shots of a source's tables, with their names, ends, labels and spins."""

import math
import re
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import listed, shown
from ballfg.importing.choices import Choices, Guess, UndecidedError
from ballfg.importing.columns import Roles, roles_of
from ballfg.importing.fall import TIMES
from ballfg.importing.formats.raw import RawTable
from ballfg.importing.frame import Frame, likely_rate
from ballfg.importing.names import names_ball
from ballfg.importing.shots import GAP, GAP_STEPS, Counts, SourceShot, cut, split_at_gaps
from ballfg.tracks.track import SPIN_LABELS, Label

MOST_SHOTS: Final = 60  # number of shots for the determination of units, evenly over the source
_INTERRUPTED: Final = 0.5  # share of files with gaps, above which a gap ends a shot instead of hiding a ball


def understood(tables: Sequence[RawTable], choices: Choices) -> tuple[list[RawTable], Roles, list[RawTable]]:
    """Tables of positions with equal columns; their roles; others. Raises: UndecidedError: none, or several."""
    kinds: dict[tuple[Any, ...], list[RawTable]] = {}
    for table in tables:
        kinds.setdefault((table.named, *table.columns), []).append(table)
    read: list[tuple[list[RawTable], Roles]] = []
    beside: list[RawTable] = []
    questions: list[UndecidedError] = []
    for same in kinds.values():
        try:
            roles = roles_of(max(same, key=len), choices)
        except UndecidedError as question:
            questions.append(question)
            roles = None
        if roles is None:
            beside += same
        else:
            read.append((same, roles))
    if questions and not any(roles.by_name for _, roles in read):
        raise questions[0]
    if not read:
        largest = max(tables, key=len)
        what = f"{largest.where}: no columns look like x, y and z; there are {listed(largest.columns)}"
        raise UndecidedError(what, "columns", (), "t=NAME,x=NAME,y=NAME,z=NAME")
    signatures = {(one.places, one.time, one.trajectory) for _, one in read}
    if len(signatures) > 1 and len(read) > 1:
        names = [same[0].name or same[0].source for same, _ in read]
        raise UndecidedError(f"{' and '.join(names[:4])} hold positions in different columns", "key", names)
    return [table for same, _ in read for table in same], read[0][1], beside


def shots_of(tables: Sequence[RawTable], roles: Roles, choices: Choices, counts: Counts) -> list[SourceShot]:
    """The shots of all tables, in the source's units, with unique names.

    Raises: UndecidedError: no times and no rate; the message has a fitting rate. ValueError: no shot with two samples.
    """
    try:
        parts = [(table, cut(table, roles, choices, counts)) for table in tables]
    except UndecidedError as undecided:
        if undecided.option != "rate":
            raise
        guessed = replace(choices, rate=1.0)
        frames = [shot for table in tables for shot in cut(table, roles, guessed, Counts())]
        rate = likely_rate([relative(shot) for shot in frames[:MOST_SHOTS]], roles.length_unit)
        if rate is None:
            raise
        what = f"{tables[0].where} has no times in s: the number of frames per second is needed"
        raise UndecidedError(f"{what}; the fall of the ball fits about {rate} Hz", "rate", (str(rate),)) from None
    if not any(shots for _, shots in parts):
        raise ValueError(f"{tables[0].where} must hold two samples of a shot or more; each has less. Check the export.")
    named = Counter(shot.name for _, shots in parts for shot in shots)
    clash = len(parts) > 1 and max(named.values()) > 1
    found: list[SourceShot] = []
    for table, shots in parts:
        own = table.name.rpartition("/")[2] or table.source
        for shot in shots:
            name = shot.name
            if roles.trajectory is None and len(parts) > 1:
                name = own if len(shots) == 1 else f"{own}-{shot.name}"
            elif clash:
                name = f"{own}/{shot.name}"
            found.append(replace(shot, name=name))
    return _unique(found)


def _unique(shots: Iterable[SourceShot]) -> list[SourceShot]:
    seen, found = Counter[str](), []
    for shot in shots:
        seen[shot.name] += 1
        found.append(shot if seen[shot.name] == 1 else replace(shot, name=f"{shot.name}#{seen[shot.name]}"))
    return found


def relative(shot: SourceShot) -> tuple[Array, Array]:
    """(n,) stamps since the first one and (n, 3) positions of a shot, in the source's units."""
    return np.asarray(shot.stamps - shot.stamps[0], dtype=np.float64), shot.positions


def split(shots: list[SourceShot], roles: Roles, frame: Frame, choices: Choices) -> tuple[list[SourceShot], Guess]:
    """The shots in the source's units, cut at gaps in time that end a shot, and the guess for that."""
    unit = TIMES[frame.time]
    count = len(shots)
    if (given := choices.split_gap) is not None:
        done = _unique(split_at_gaps(shots, unit, given))
        why = f"cut at gaps of {given:g} s, as given"
        return done, Guess("shots", str(len(done)), why, "stated", f"--split-gap {given:g}")
    named = roles.trajectory is not None
    told = f"one for each value of {' and '.join(map(shown, filter(None, (roles.trajectory, *roles.identities))))}"
    stated = "trajectory" in choices.columns
    if named and (stated or roles.identities or not names_ball(str(roles.trajectory))):
        return shots, Guess("shots", str(count), told, "sure", f"--columns trajectory={roles.trajectory}")
    steps = [np.diff(shot.stamps).astype(np.float64) * unit for shot in shots]
    typical = float(np.median(np.concatenate(steps)))
    gap = max(GAP, GAP_STEPS * typical)
    interrupted = sum(bool((one > gap).any()) for one in steps)
    typed = f"--split-gap {gap:g}"
    if interrupted < _INTERRUPTED * count:
        why = told if named else "a shot ends where time starts again or the file ends"
        if interrupted:
            why += f"; gaps over {gap:g} s in {interrupted} of them are taken for a ball out of sight"
        return shots, Guess("shots", str(count), why, "likely" if interrupted else "sure", typed)
    done = split_at_gaps(shots, unit, gap)
    if count == 1 and not named:
        done = [replace(shot, name=f"{i:03d}") for i, shot in enumerate(done)]
    held = np.concatenate(steps)
    longest = float(held[held <= gap].max())
    why = f"a shot ends at a gap over {gap:.3g} s; the longest gap within one is {longest:.2g} s"
    return _unique(done), Guess("shots", str(len(done)), why, "sure" if longest < gap / 2 else "likely", typed)


def with_labels(shots: list[SourceShot], beside: Sequence[RawTable]) -> list[SourceShot]:
    """The shots with the labels of tables with one row per shot."""
    names = {shot.name for shot in shots}
    for table in beside:
        for key, column in table.columns.items():
            keys = [str(value) for value in column.tolist()]
            if not set(keys) & names or len(set(keys)) < len(keys):
                continue
            labels: dict[str, dict[str, Label]] = {one: {} for one in keys}
            for name, values in table.columns.items():
                for one, value in zip(keys, values.tolist() if name != key else (), strict=False):
                    if isinstance(value, str) and value:
                        labels[one][name] = value
                    elif isinstance(value, int | float) and np.isfinite(value):
                        labels[one][name] = float(value)
            shots = [replace(shot, labels={**shot.labels, **labels.get(shot.name, {})}) for shot in shots]
            break
    return shots


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
