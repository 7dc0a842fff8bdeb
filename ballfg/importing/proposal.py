"""The proposal: tables to tracks in SI units with z up, and every guess on the way."""

from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.importing.bounces import surface
from ballfg.importing.choices import Choices, Guess, UndecidedError
from ballfg.importing.columns import Roles, roles_of
from ballfg.importing.fall import TIMES
from ballfg.importing.formats.raw import RawTable
from ballfg.importing.formats.sources import tables_of
from ballfg.importing.frame import Frame, find_frame, likely_rate
from ballfg.importing.shots import GAP, GAP_STEPS, Counts, Shot, cut, split_at_gaps
from ballfg.importing.stamps import in_seconds, origin_of
from ballfg.tracks import TABLE_TENNIS, TENNIS, Ball, DatasetInfo, Track
from ballfg.tracks.checks import Findings, tidy
from ballfg.tracks.grouping import RowGroup
from ballfg.tracks.track import Label

BALLS: Final = {"table-tennis": TABLE_TENNIS, "tennis": TENNIS}
_MOST_SHOTS: Final = 60
"""Shots from which the units are read, evenly over the source."""
_TENNIS_DRAG: Final = 0.045
"""1/m; halfway, in ratio, between the drags of the two balls."""
_SURE_WINDOWS: Final = 30
_INTERRUPTED: Final = 0.5
"""Share of the files or recordings with gaps, from which on a gap ends a shot and is not a ball out of sight."""


@dataclass(frozen=True)
class Proposal:
    """What a source was understood to be."""

    info: DatasetInfo
    tracks: list[Track]
    guesses: list[Guess]
    notes: list[str]
    """What was left out or put in order, one sentence each."""


def propose(data: Any, choices: Choices) -> Proposal:
    """Reads a source and guesses what is not decided.

    Args: data: as for `import_tracks`.  choices: what is decided.
    Raises: UndecidedError: a guess that is not safe. FileNotFoundError: no such file. ValueError: unreadable input.
    """
    tables = tables_of(data, choices.topic, choices.key)
    chosen, roles, beside = _understood(tables, choices)
    counts = Counts()
    shots = _frames_to_shots(chosen, roles, choices, counts)
    stated_time = "ns" if counts.dates else "s" if not roles.time else roles.time_unit
    time_why = "dates" if counts.dates else "frames divided by the rate" if not roles.time else "named in the source"
    some = shots[:: max(1, len(shots) // _MOST_SHOTS)]
    frame, guesses = find_frame([_relative(shot) for shot in some], choices, roles.length_unit, stated_time, time_why)
    shots, split = _split(shots, roles, frame, choices)
    shots = _with_labels(shots, beside)
    tracks, notes = _tracks(shots, frame)
    ball, ball_guess = _ball(choices, frame)
    height, height_guess = _table(tracks, ball, choices)
    rate = float(f"{1.0 / np.median(np.concatenate([np.diff(track.times) for track in tracks])):.4g}")
    guesses = [*_column_guesses(roles), *guesses, height_guess, split, ball_guess]
    source = ", ".join(dict.fromkeys(table.source for table in chosen))
    info = DatasetInfo(
        name=choices.name or "imported",
        table_height=height,
        ball=ball,
        rate=rate,
        source=source[:200],
        imported={guess.what: f"{guess.value} ({guess.sure}: {guess.why})" for guess in guesses},
    )
    used = (*roles.time, *roles.places, roles.frame)
    doubts = [[*table.notes, *(said for name, said in table.doubts.items() if name in used)] for table in chosen]
    table_notes = list(dict.fromkeys(note for notes_of_one in doubts for note in notes_of_one))
    return Proposal(info, tracks, guesses, [*table_notes[:5], *counts.notes(), *notes])


def _understood(tables: Sequence[RawTable], choices: Choices) -> tuple[list[RawTable], Roles, list[RawTable]]:
    """The tables of positions, which all have the same columns; their roles; and the tables beside them."""
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
        columns = ", ".join(list(largest.columns)[:12])
        raise UndecidedError(
            f"{largest.where}: no columns look like x, y and z; there are {columns}",
            "columns",
            (),
            "t=NAME,x=NAME,y=NAME,z=NAME",
        )
    signatures = {(one.places, one.time, one.trajectory) for _, one in read}
    if len(signatures) > 1 and len(read) > 1:
        names = [same[0].name or same[0].source for same, _ in read]
        raise UndecidedError(f"{' and '.join(names[:4])} hold positions in different columns", "key", names)
    chosen = [table for same, _ in read for table in same]
    return chosen, read[0][1], beside


def _frames_to_shots(tables: Sequence[RawTable], roles: Roles, choices: Choices, counts: Counts) -> list[Shot]:
    """The shots of all tables, with names of their own; says which rate fits where none is known."""
    try:
        parts = [(table, cut(table, roles, choices, counts)) for table in tables]
    except UndecidedError as undecided:
        if undecided.option != "rate":
            raise
        guessed = replace(choices, rate=1.0)
        frames = [shot for table in tables for shot in cut(table, roles, guessed, Counts())]
        rate = likely_rate([_relative(shot) for shot in frames[:_MOST_SHOTS]], roles.length_unit)
        if rate is None:
            raise
        raise UndecidedError(
            f"{tables[0].where} has no times in s: the number of frames per second is needed; the fall of the ball "
            f"fits about {rate} Hz",
            "rate",
            (str(rate),),
        ) from None
    if not any(shots for _, shots in parts):
        raise ValueError(f"{tables[0].where} must hold two samples of a shot or more; each has less. Check the export.")
    named = Counter(shot.name for _, shots in parts for shot in shots)
    clash = len(parts) > 1 and max(named.values()) > 1
    found: list[Shot] = []
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


def _unique(shots: Iterable[Shot]) -> list[Shot]:
    seen: Counter[str] = Counter()
    found = []
    for shot in shots:
        seen[shot.name] += 1
        found.append(shot if seen[shot.name] == 1 else replace(shot, name=f"{shot.name}#{seen[shot.name]}"))
    return found


def _relative(shot: Shot) -> tuple[Array, Array]:
    return np.asarray(shot.stamps - shot.stamps[0], dtype=np.float64), shot.positions


def _split(shots: list[Shot], roles: Roles, frame: Frame, choices: Choices) -> tuple[list[Shot], Guess]:
    unit = TIMES[frame.time]
    count = len(shots)
    if choices.split_gap is not None:
        done = _unique(split_at_gaps(shots, unit, choices.split_gap))
        return done, Guess(
            "shots",
            str(len(done)),
            f"cut at gaps of {choices.split_gap:g} s, as given",
            "stated",
            f"--split-gap {choices.split_gap:g}",
        )
    if roles.trajectory is not None:
        why = f"one for each value of {roles.trajectory!r}"
        return shots, Guess("shots", str(count), why, "sure", f"--columns trajectory={roles.trajectory}")
    steps = [np.diff(shot.stamps).astype(np.float64) * unit for shot in shots]
    typical = float(np.median(np.concatenate(steps)))
    gap = max(GAP, GAP_STEPS * typical)
    interrupted = sum(bool((one > gap).any()) for one in steps)
    typed = f"--split-gap {gap:g}"
    if interrupted < _INTERRUPTED * count:
        why = "a shot ends where time starts again or the file ends"
        if interrupted:
            why += f"; gaps over {gap:g} s in {interrupted} of them are taken for a ball out of sight"
        return shots, Guess("shots", str(count), why, "likely" if interrupted else "sure", typed)
    done = split_at_gaps(shots, unit, gap)
    if count == 1:
        done = [replace(shot, name=f"{i:03d}") for i, shot in enumerate(done)]
    held = np.concatenate(steps)
    longest = float(held[held <= gap].max())
    why = f"a shot ends at a gap over {gap:.3g} s; the longest gap within one is {longest:.2g} s"
    return _unique(done), Guess("shots", str(len(done)), why, "sure" if longest < gap / 2 else "likely", typed)


def _with_labels(shots: list[Shot], beside: Sequence[RawTable]) -> list[Shot]:
    """The shots with the labels of tables that have one row for each of them."""
    names = {shot.name for shot in shots}
    for table in beside:
        for key, column in table.columns.items():
            keys = [str(value) for value in column.tolist()]
            if not set(keys) & names or len(set(keys)) < len(keys):
                continue
            rows = {one: i for i, one in enumerate(keys)}
            others = {name: values.tolist() for name, values in table.columns.items() if name != key}
            shots = [
                replace(shot, labels={**shot.labels, **_row(others, rows[shot.name])}) if shot.name in rows else shot
                for shot in shots
            ]
            break
    return shots


def _row(columns: Mapping[str, list[Any]], row: int) -> dict[str, Label]:
    found: dict[str, Label] = {}
    for name, values in columns.items():
        value = values[row]
        if isinstance(value, str) and value:
            found[name] = value
        elif isinstance(value, int | float) and np.isfinite(value):
            found[name] = float(value)
    return found


def _tracks(shots: Sequence[Shot], frame: Frame) -> tuple[list[Track], list[str]]:
    """Tracks in m and s with z up, and notes on their repairs."""
    stamps = [shot.stamps for shot in shots]
    far = [origin_of(one, frame.time) for one in stamps]
    origin = min(far, key=abs) if all(far) else 0
    findings = Findings()
    tracks = []
    for shot in shots:
        times = in_seconds(shot.stamps, frame.time, origin)
        positions = frame.turned(frame.metres(shot.positions))
        parts = [times[:, None], positions]
        if shot.sigmas is not None:
            parts.append(frame.turned_sizes(frame.metres(shot.sigmas)))

        def where(*rows: int, table: RawTable = shot.table) -> str:
            return f"{table.where}, rows {' and '.join(str(row + 1) for row in rows)}"

        try:
            values = tidy(RowGroup(shot.name, shot.rows, np.concatenate(parts, axis=1)), where, findings)
        except ValueError as error:
            raise UndecidedError(
                f"{str(error).rpartition('. ')[0]}; a column may tell two balls apart", "columns", (), "trajectory=NAME"
            ) from None
        sigmas = values[:, 4:] if values.shape[1] > 4 else None
        tracks.append(Track(values[:, 0], values[:, 1:4], sigmas, shot.labels, name=shot.name))
    notes = findings.notes()
    if origin:
        notes.append(f"times count from the stamp {origin} {frame.time}")
    return tracks, notes


def _ball(choices: Choices, frame: Frame) -> tuple[Ball, Guess]:
    if choices.ball is not None:
        if choices.ball in BALLS:
            ball = BALLS[choices.ball]
        else:
            from ballfg.simulation import ball_kind

            ball = ball_kind(choices.ball).ball
        return ball, Guess("ball", choices.ball, "as given", "stated", f"--ball {choices.ball}")
    if frame.drag is None or frame.windows < _SURE_WINDOWS:
        return TABLE_TENNIS, Guess(
            "ball", "table-tennis", "too little flight to show the drag", "unsure", "--ball tennis"
        )
    if frame.drag < _TENNIS_DRAG:
        why = f"the drag is only {frame.drag:.2f} 1/m (a tennis ball has 0.02): if it is another ball, name it"
        return TABLE_TENNIS, Guess("ball", "table-tennis", why, "unsure", "--ball tennis")
    why = f"drag {frame.drag:.2f} 1/m; a table-tennis ball has 0.13, a tennis ball 0.02"
    return TABLE_TENNIS, Guess("ball", "table-tennis", why, "likely", "--ball tennis")


def _table(tracks: Sequence[Track], ball: Ball, choices: Choices) -> tuple[float, Guess]:
    if choices.table_height is not None:
        height = choices.table_height
        return height, Guess("table height", f"{height:g} m", "as given", "stated", f"--table-height {height:g}")
    found = surface((track.times, track.positions) for track in tracks)
    if found is None:
        lowest = min(float(track.positions[:, 2].min()) for track in tracks)
        raise UndecidedError(
            f"no bounce shows the height of the table (m, along the up axis); the lowest sample is at {lowest:.2f} m",
            "table-height",
            (),
            f"{lowest - ball.radius:.2f}" if lowest > 0.5 else "0.76",
        )
    height = round(found.centre - ball.radius, 4)
    others = "".join(f"; also at {other - ball.radius:.2f} m" for other in found.others)
    one = "1 bounce" if found.bounces == 1 else f"{found.bounces} bounces"
    why = f"{one}, scatter {1e3 * found.spread:.1f} mm{others}"
    sure = "sure" if found.bounces >= 3 and not found.others else "likely"
    return height, Guess("table height", f"{height:g} m", why, sure, f"--table-height {height:g}")


def _column_guesses(roles: Roles) -> list[Guess]:
    why = "names" if roles.by_name else "what the numbers are like"
    sure = "sure" if roles.by_name else "likely"
    time = "+".join(roles.time) or (f"{roles.frame} / rate" if roles.frame else "row / rate")
    columns = {"t": time, "x, y, z": ", ".join(roles.places)}
    if roles.trajectory:
        columns["trajectory"] = roles.trajectory
    if roles.sigmas:
        columns["sigmas"] = ", ".join(roles.sigmas)
    typed = {
        "t": "--columns t=NAME",
        "x, y, z": "--columns x=NAME,y=NAME,z=NAME",
        "trajectory": "--columns trajectory=NAME",
    }
    return [Guess(f"column {key}", value, why, sure, typed.get(key, "")) for key, value in columns.items()]
