"""A proposal holds the tracks of a source in SI units with z up, and every guess on the way."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any, Final

import numpy as np

from ballfg.checks import short_text
from ballfg.importing.bounces import ball_of, table_of
from ballfg.importing.choices import AllUndecidedError, Choices, Guess, UndecidedError, decided
from ballfg.importing.columns import UNMEASURED, Roles
from ballfg.importing.formats.raw import RawTable
from ballfg.importing.formats.sources import tables_of
from ballfg.importing.frame import Frame, find_frame
from ballfg.importing.gathering import MOST_SHOTS, relative, shots_of, split, understood, with_labels
from ballfg.importing.recordings import Recordings, recordings
from ballfg.importing.several_balls import balls_of
from ballfg.importing.shots import Counts, SourceShot
from ballfg.importing.stamps import in_seconds, origin_of
from ballfg.tracks import Track
from ballfg.tracks.checks import Findings, tidy
from ballfg.tracks.grouping import RowGroup
from ballfg.tracks.info import DatasetInfo

MOST_QUESTIONS: Final = 8  # Largest number of questions about one source; with more, something else is wrong


@dataclass(frozen=True)
class Proposal:
    """The interpretation of a source."""

    info: DatasetInfo
    tracks: list[Track]
    guesses: list[Guess]
    notes: list[str]  # omitted or reordered rows, one sentence each


def propose(data: Any, choices: Choices) -> Proposal:
    """Reads a source and guesses open choices.

    Raises: UndecidedError, AllUndecidedError: unsafe guesses, all at once. FileNotFoundError. ValueError: unreadable.
    """
    read = tables_of(data, choices.topic, choices.key)
    tables = [ball for table in read for ball in balls_of(table, choices)]
    try:
        return _proposed(tables, choices)
    except UndecidedError as question:
        questions = [question, *_further(tables, choices, question)]
        raise question if len(questions) == 1 else AllUndecidedError(questions) from None
    except ValueError as error:
        where = short_text(", ".join(dict.fromkeys(table.source for table in tables)))
        raise error if where in str(error) else ValueError(f"{where}: {error}") from None


def _further(tables: list[RawTable], choices: Choices, question: UndecidedError) -> Iterator[UndecidedError]:
    """The questions that follow if the first value of a question is its answer."""
    for _ in range(MOST_QUESTIONS):
        try:
            choices = decided(choices, question.option, question.first)
            _proposed(tables, choices)
        except UndecidedError as following:
            if following.option == question.option:
                return
            question = following
            yield question
        except ValueError:  # that value does not lead on
            return
        else:
            return


def _proposed(tables: list[RawTable], choices: Choices) -> Proposal:
    chosen, roles, beside = understood(tables, choices)
    counts = Counts()
    shots = shots_of(chosen, roles, choices, counts)
    stated_time = "ns" if counts.dates else "s" if not roles.time else roles.time_unit
    time_why = "dates" if counts.dates else "frames divided by the rate" if not roles.time else "named in the source"
    some = shots[:: max(1, len(shots) // MOST_SHOTS)]
    frame, guesses = find_frame([relative(shot) for shot in some], choices, roles.length_unit, stated_time, time_why)
    shots, split_guess = split(shots, roles, frame, choices)
    shots = with_labels(shots, beside)
    tracks, notes = _tracks(shots, frame)
    ball, ball_guess = ball_of(choices, frame)
    recorded = recordings(tracks)
    height, height_guess, table_doubt = table_of(tracks, recorded.cut, ball, choices)
    flights_guess = recorded.guess(choices.flights)
    tracks = _flights(recorded) if choices.flights else tracks
    rate = float(f"{1.0 / np.median(np.concatenate([np.diff(track.seconds) for track in tracks])):.4g}")
    guesses = [*_column_guesses(roles), *guesses, height_guess, split_guess, ball_guess]
    guesses += [] if flights_guess is None else [flights_guess]
    source = ", ".join(dict.fromkeys(table.source for table in chosen))
    info = DatasetInfo(
        name=choices.name or "imported",
        table_height=height,
        ball=ball,
        rate=rate,
        source=source[:200],
        imported={guess.what: f"{guess.value} ({guess.sure}: {guess.why})" for guess in guesses},
        doubts=(*_unseen(roles), *frame.doubts, *recorded.doubts(frame, choices.flights), *table_doubt),
    )
    used = (*roles.time, *roles.places, roles.frame)
    doubts = [[*table.notes, *(said for name, said in table.doubts.items() if name in used)] for table in chosen]
    table_notes = list(dict.fromkeys(note for notes_of_one in doubts for note in notes_of_one))
    return Proposal(info, tracks, guesses, [*table_notes[:5], *counts.notes(), *notes])


def _unseen(roles: Roles) -> list[str]:
    """A sentence on axes of the source without a column."""
    axes = [axis for axis, name in zip("xyz", roles.places, strict=True) if name == UNMEASURED]
    if not axes:
        return []
    return [f"{' and '.join(axes)} of the source {'are' if len(axes) > 1 else 'is'} not measured and set to zero"]


def _flights(recorded: Recordings) -> list[Track]:
    """The flights of all tracks. Raises: ValueError: there are none."""
    if not recorded.cut:
        raise ValueError(
            "--flights must find flights; nothing in the tracks flies like a ball. Check units and up axis."
        )
    return recorded.cut


def _tracks(shots: Sequence[SourceShot], frame: Frame) -> tuple[list[Track], list[str]]:
    """Tracks in m and s with z up, and notes on their repairs."""
    far = [origin_of(shot.stamps, frame.time) for shot in shots]
    origin = min(far, key=abs) if all(far) else 0
    findings = Findings()
    tracks = []
    for shot in shots:
        times = in_seconds(shot.stamps, frame.time, origin)
        parts = [times[:, None], frame.turned(frame.metres(shot.positions))]
        if shot.sigmas is not None:
            parts.append(frame.turned_sizes(frame.metres(shot.sigmas)))

        def where(*rows: int, table: RawTable = shot.table) -> str:
            return f"{table.where}, rows {' and '.join(str(row + 1) for row in rows)}"

        try:
            values = tidy(RowGroup(shot.name, shot.rows, np.concatenate(parts, axis=1)), where, findings)
        except ValueError as error:
            what = f"{str(error).rpartition('. ')[0]}; a column may tell two balls apart"
            raise UndecidedError(what, "columns", (), "trajectory=NAME") from None
        sigmas = values[:, 4:] if values.shape[1] > 4 else None
        tracks.append(Track(values[:, 0], values[:, 1:4], sigmas, shot.labels, name=shot.name))
    notes = findings.notes()
    if origin:
        notes.append(f"times count from the stamp {origin} {frame.time}")
    return tracks, notes


def _column_guesses(roles: Roles) -> list[Guess]:
    why = "names" if roles.by_name else "what the numbers are like"
    sure = "sure" if roles.by_name else "likely"
    time = "+".join(roles.time) or (f"{roles.frame} / rate" if roles.frame else "row / rate")
    columns = (
        ("t", time, "--columns t=NAME"),
        ("x, y, z", ", ".join(roles.places), "--columns x=NAME,y=NAME,z=NAME"),
        ("trajectory", roles.trajectory, "--columns trajectory=NAME"),
        ("sigmas", ", ".join(roles.sigmas or ()), ""),
    )
    return [Guess(f"column {key}", value, why, sure, typed) for key, value, typed in columns if value]
