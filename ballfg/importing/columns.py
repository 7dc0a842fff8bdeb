"""Determines the role of each column by its name or else by its numbers."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.checks import did_you_mean, listed, short_text, shown
from ballfg.importing.choices import Choices, UndecidedError
from ballfg.importing.fall import LENGTHS
from ballfg.importing.formats.raw import MISSING, RawTable, is_number, numbers
from ballfg.importing.names import Meaning, meanings
from ballfg.importing.several_balls import identified
from ballfg.importing.stamps import as_stamps

RATES: Final = ("rate", "fps", "frame_rate", "framerate", "hz", "sampling_rate", "frequency")  # frames per second
UNITS: Final = ("unit", "units", "length_unit", "position_unit")
UNMEASURED: Final = "(not measured)"  # In place of the column of an axis
_REGULAR: Final = 0.3  # largest median deviation of the steps of a time column, in median steps; coordinates vary more
_FORWARD: Final = 0.9
_PIECES: Final = 0.2  # largest number of changes, per row, of a column with the names of trajectories


@dataclass(frozen=True)
class Roles:
    """The columns of one table by role."""

    places: tuple[str, str, str]
    time: tuple[str, ...]  # one column of stamps, two of s and ns, or none
    frame: str | None = None
    trajectory: str | None = None
    sigmas: tuple[str, str, str] | None = None
    length_unit: str | None = None
    time_unit: str | None = None
    rate: float | None = None
    by_name: bool = True
    others: tuple[str, ...] = ()
    identities: tuple[str, ...] = ()  # columns that tell several balls of a trajectory apart
    sigma_units: tuple[str | None, ...] = (None, None, None)  # of length, where the names state others than of x, y, z


def roles_of(table: RawTable, choices: Choices) -> Roles | None:
    """The roles of a table's columns; None without positions. Raises: UndecidedError. ValueError: an unknown column."""
    given = {role: _existing(table, name) for role, name in choices.columns.items()}
    read = {name: meanings(name) for name in table.columns} if table.named else {}
    places, units = _places(table, read, given)
    counters: list[str] = []
    by_name = places is not None
    time = _named_time(table, read, given, places or ())
    trajectory = _trajectory(table, read, given, {*(places or ()), *time})
    if places is None:
        if table.named and not _numeric_rest(table, {*time, *([trajectory] if trajectory else [])}):
            return None
        frames = [name for name, found in read.items() if any(one.role == "frame" for one in found)]
        if not time and (table.named or len(table.columns) > 3):  # three columns alone are x, y and z
            time, counter = _time_by_numbers(table, {trajectory} if trajectory else set())
            frames += [counter] if counter else []
        if table.named and not time and not frames:
            return None
        for name, column in table.columns.items() if trajectory is None else ():
            changes = int((column[1:] != column[:-1]).sum()) if column.dtype.kind != "f" else 0
            if name not in (*time, *frames) and 0 < changes <= _PIECES * len(column):
                trajectory = name
                break
        found = _numeric_rest(table, {*time, *frames, *([trajectory] if trajectory else [])})
        left = [n for n, c in table.columns.items() if is_number(c) and n not in (*time, *frames, trajectory)]
        if len(found) < 3 and len(left) == 3:  # a coordinate may be constant
            found = left
        if len(found) < 3:
            return None
        if len(found) > 3:
            what = f"{table.where}: x, y and z must be three columns; {listed(found[:8])} may be meant"
            raise UndecidedError(what, "columns", (), "x={},y={},z={}".format(*found[:3]))
        places = (found[0], found[1], found[2])
        counters = frames
    frame = given.get("frame") or next((n for n, ms in read.items() for m in ms if m.role == "frame"), None)
    frame = frame or (counters[0] if counters else None)
    if not time and frame is None:
        time, frame = _time_by_numbers(table, {*places, *([trajectory] if trajectory else [])})
    sigmas, unit, rate = _sigmas(read, given), _constant(table, UNITS), _constant(table, RATES)
    time_unit = "ns" if len(time) == 2 else None
    if len(time) == 1:
        time_unit = next((m.unit for m in read.get(time[0], []) if m.role in ("t", "seconds") and m.unit), None)
    stated = [next((m.unit for m in read.get(name, []) if m.unit), None) for name in sigmas or ()]
    used = {*places, *time, *(sigmas or ())} | {one for one in (frame, trajectory) if one}
    trajectory, identities = identified(table, trajectory, time or tuple(filter(None, [frame])), used)
    used.update(identities, [trajectory or ""])
    return Roles(
        places,
        time,
        None if time else frame,
        trajectory,
        sigmas,
        units or (unit.strip().lower() if isinstance(unit, str) else None),
        time_unit,
        float(rate) if isinstance(rate, int | float) and rate > 0 else None,
        by_name,
        tuple(name for name in table.columns if name not in used and name.lower() not in (*RATES, *UNITS)),
        identities,
        tuple(own if own in LENGTHS and own != units else None for own in stated),
    )


def _existing(table: RawTable, name: str) -> str:
    if name in table.columns:
        return name
    alike = [one for one in table.columns if one.lower() == name.lower() or one.split(" [")[0] == name]
    if len(alike) == 1:
        return alike[0]
    raise ValueError(
        f"--columns must name columns of {table.where}; it has no {shown(name)} but {listed(table.columns)}."
        f"{did_you_mean(name, table.columns)}"
    )


def _places(
    table: RawTable, read: Mapping[str, list[Meaning]], given: Mapping[str, str]
) -> tuple[tuple[str, str, str] | None, str | None]:
    """The columns of x, y and z and the unit in their names."""
    groups: dict[str, dict[str, tuple[str, Meaning]]] = {}
    for name, found in read.items():
        for meaning in found:
            if meaning.role in "xyz" and is_number(table.columns[name]):
                groups.setdefault(meaning.group, {}).setdefault(meaning.role, (name, meaning))
    if {"x", "y", "z"} <= set(given):
        units = [one.unit for axis in "xyz" for one in read.get(given[axis], []) if one.role in "xyz" and one.unit]
        return (given["x"], given["y"], given["z"]), units[0] if units else None
    _refuse_images(table, groups)
    whole = [group for group in groups.values() if len(group) == 3]
    if not whole:
        return _some_places(table, read, groups, given)
    ranks = [sum(meaning.rank for _, meaning in group.values()) for group in whole]
    best = [group for group, rank in zip(whole, ranks, strict=True) if rank == min(ranks)]
    if len(best) > 1 and not given:
        sets = [",".join(f"{axis}={group[axis][0]}" for axis in "xyz") for group in best]
        raise UndecidedError(f"{table.where}: {len(best)} sets of columns may be the ball's x, y, z", "columns", sets)
    chosen = {axis: given.get(axis, best[0][axis][0]) for axis in "xyz"}
    found_units = {meaning.unit for _, meaning in best[0].values()}
    if len(found_units) > 1:
        units = sorted(short_text(str(unit)) for unit in found_units)
        what = f"{table.where}: x, y and z must have one unit; their names state {', '.join(units)}"
        raise UndecidedError(what, "length", [unit for unit in units if unit != "None"])
    return (chosen["x"], chosen["y"], chosen["z"]), found_units.pop()


def _some_places(
    table: RawTable,
    read: Mapping[str, list[Meaning]],
    groups: Mapping[str, Mapping[str, tuple[str, Meaning]]],
    given: Mapping[str, str],
) -> tuple[tuple[str, str, str] | None, str | None]:
    """The columns of one or two axes, where no others are there. Raises: ValueError: the others hold text."""
    axes = {axis: given[axis] for axis in "xyz" if axis in given}
    if not axes:
        plain = [group for group in groups.values() if all(meaning.rank == 0 for _, meaning in group.values())]
        axes = {axis: name for axis, (name, _) in plain[0].items()} if plain else {}
    if not axes:
        return None, None
    for name, column in table.columns.items():
        role = next((meaning.role for meaning in read.get(name, []) if meaning.rank == 0), "")
        text = [] if is_number(column) else [str(cell) for cell in column if str(cell).lower() not in MISSING]
        if role in set("xyz") - set(axes) and text:
            what = f"{table.where}: column {shown(name)} must hold numbers; it holds {shown(text[0][:30])}"
            raise ValueError(
                f"{what}. Write its numbers with a point for the decimals, or name another one: --columns."
            )
    units = [m.unit for group in groups.values() for name, m in group.values() if name in axes.values() and m.unit]
    x, y, z = (axes.get(axis, UNMEASURED) for axis in "xyz")
    return (x, y, z), units[0] if units else None


def _refuse_images(table: RawTable, groups: Mapping[str, Mapping[str, tuple[str, Meaning]]]) -> None:
    """Refuses pixels: without cameras they give no positions in a room."""
    whole = any(len(group) == 3 for group in groups.values())
    pixels = any(meaning.unit == "px" for group in groups.values() for _, meaning in group.values())
    flat = [
        group
        for group in groups.values()
        if set(group) == {"x", "y"} and not all(meaning.unit in LENGTHS for _, meaning in group.values())
    ]
    if pixels or (flat and not whole):
        names = ", ".join(table.columns)
        raise ValueError(
            f"{table.where} must have x, y and z; its columns are {names[:120]}: places in an image, or z is missing. "
            "Name z with --columns z=NAME, or make tracks from detections of several cameras: ballfg track DETECTIONS "
            "--cameras cameras.yaml --out DATASET."
        )


def _named_time(
    table: RawTable, read: Mapping[str, list[Meaning]], given: Mapping[str, str], places: tuple[str, ...]
) -> tuple[str, ...]:
    if "t" in given:
        return (given["t"],)
    if "frame" in given:
        return ()
    parts = {m.role: name for name, found in read.items() for m in found if m.role in ("seconds", "nanoseconds")}
    if len(parts) == 2:
        return parts["seconds"], parts["nanoseconds"]
    candidates = [
        (m.rank, name)
        for name, found in read.items()
        for m in found
        if m.role in ("t", "seconds") and name not in places and as_stamps(table.columns[name]) is not None
    ]
    if not candidates:
        return ()
    least = min(rank for rank, _ in candidates)
    best = [name for rank, name in candidates if rank == least]
    moving = [name for name in best if len(set(table.columns[name][:1000].tolist())) > 1] or best
    if len(moving) > 1 and not _one_clock(table, moving):
        what = f"{table.where}: {' and '.join(moving)} may both be the time"
        raise UndecidedError(what, "columns", [f"t={name}" for name in moving])
    return (moving[0],)


def _one_clock(table: RawTable, names: list[str]) -> bool:
    """True if columns hold the same time apart from its origin and unit."""
    first, *others = (as_stamps(table.columns[name]) for name in names)
    for other in others:
        if first is None or other is None:
            return False
        a, b = (np.asarray(one - one[0], dtype=np.float64) for one in (first, other))
        slope = float(a @ b) / max(float(a @ a), 1e-300)
        power = np.log10(abs(slope)) if slope else np.inf
        if not np.isfinite(power) or abs(power - round(power)) > 1e-3:
            return False
        if np.abs(b - slope * a).max() > 1e-3 * max(np.abs(b).max(), 1e-300):
            return False
    return True


def _trajectory(
    table: RawTable, read: Mapping[str, list[Meaning]], given: Mapping[str, str], used: set[str]
) -> str | None:
    if "trajectory" in given:
        return given["trajectory"]
    ranked = [(m.rank, name) for name, found in read.items() for m in found if m.role == "trajectory"]
    for _, name in sorted(ranked):
        column = table.texts.get(name, table.columns[name])
        if name not in used and len(set(column.tolist())) <= max(1, len(column) // 3):
            return name
    return None


def _numeric_rest(table: RawTable, used: set[str]) -> list[str]:
    """Possible coordinates: columns of numbers that vary, without counters."""
    found = []
    for name, column in table.columns.items():
        values = numbers(column)
        held = values[np.isfinite(values)]
        if name not in used and len(held) > 2 and np.ptp(held) > 0:
            counts = column.dtype.kind == "i" and (np.abs(np.diff(held)) <= 1).mean() > _FORWARD
            found += [] if counts else [name]
    return found


def _time_by_numbers(table: RawTable, used: set[str]) -> tuple[tuple[str, ...], str | None]:
    """The column of times with the most regular steps, or else a counter of frames."""
    found: list[tuple[bool, float, str]] = []
    for name, column in table.columns.items():
        stamps = as_stamps(column)
        if name in used or stamps is None or len(stamps) < 3:
            continue
        steps = np.diff(stamps).astype(np.float64)
        forward = steps[steps > 0]
        if len(forward) < _FORWARD * len(steps):
            continue
        typical = float(np.median(forward))
        spread = float(np.median(np.abs(forward - typical))) / typical
        if spread <= _REGULAR:
            found.append((column.dtype.kind == "i" and typical == 1.0, spread, name))
    if not found:
        return (), None
    counter, _, name = min(found)
    return ((), name) if counter else ((name,), None)


def _sigmas(read: Mapping[str, list[Meaning]], given: Mapping[str, str]) -> tuple[str, str, str] | None:
    found = {m.role: name for name, ms in read.items() for m in ms if m.role.startswith("sigma")} | dict(given)
    x, y, z = (found.get(f"sigma_{axis}") for axis in "xyz")
    return (x, y, z) if x and y and z else None


def _constant(table: RawTable, names: tuple[str, ...]) -> object:
    for name, column in table.columns.items():
        if name.lower() in names and len(column) and len(set(column.tolist())) == 1:
            return column.tolist()[0]
    return None
