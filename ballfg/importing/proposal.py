"""A proposal holds the tracks of a source in SI units with z up, the flights of recordings, and every guess."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import chain
from typing import Any, Final

import numpy as np

from ballfg.checks import short_text
from ballfg.estimation.configure import FEW_TRACKS, LEAST_TRACKS
from ballfg.estimation.flights.dataset import ENOUGH, SMOOTHED, Contents, flies_throughout, smoothed, tracks_of
from ballfg.estimation.flights.labels import label_samples
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.importing.bounces import ball_of, table_of
from ballfg.importing.choices import AllUndecidedError, Choices, Guess, UndecidedError, decided
from ballfg.importing.columns import UNMEASURED, Roles
from ballfg.importing.formats.raw import RawTable
from ballfg.importing.formats.sources import tables_of
from ballfg.importing.frame import TURNS, Frame, find_frame
from ballfg.importing.gathering import MOST_SHOTS, relative, shots_of, split, understood, with_labels, with_spins
from ballfg.importing.several_balls import balls_of
from ballfg.importing.shots import Counts, SourceShot
from ballfg.importing.stamps import in_seconds, origin_of
from ballfg.tracks import Track
from ballfg.tracks.checks import Findings, tidy
from ballfg.tracks.info import DatasetInfo
from ballfg.tracks.rows import RowGroup

STUCK: Final = 4  # samples in a row that are exactly the largest or smallest of all: no moving ball does that
AGAIN: Final = 2  # times that it happens where a limit clips; once is a ball at rest
ANY_BALL: Final = SegmentationPhysics(drag=0.06)
"""Between the drag of a heavy and of a light ball; the labels leave room for either."""


@dataclass(frozen=True)
class Recordings:
    """Imported tracks, and the flights in them.

    Attributes:
        tracks: as they were recorded.  flights: those of each track; the track itself if nothing else is in it.
        contents: of all tracks.
    """

    tracks: Sequence[Track]
    flights: Sequence[Sequence[Track]]
    contents: Contents

    @property
    def cut(self) -> list[Track]:
        """All flights."""
        return list(chain.from_iterable(self.flights))

    @property
    def mixed(self) -> int:
        """Number of tracks with something else than flight."""
        return sum(list(own) != [track] for own, track in zip(self.flights, self.tracks, strict=True))

    def guess(self, chosen: bool) -> Guess | None:
        """The line of the proposal, where something else than flight is in the tracks. Args: chosen: cut them."""
        if not self.mixed:
            return None
        share = int(100 * self.contents.share)
        rest = f"{share} % of the samples fly; in the others the ball is held, rolls, rests or is lost"
        if chosen:
            return Guess("flights", f"{len(self.cut)}, from {self.mixed} tracks", rest, "stated", "")
        return Guess("flights", "left in their tracks", rest, "likely", "--flights")

    def doubts(self, frame: Frame, cut: bool) -> list[str]:
        """Sentences for `dataset.yaml`. Args: frame: the units.  cut: True if only flights are kept."""
        said, share = list[str](), self.contents.share
        if share < ENOUGH:
            said.append(
                f"{'the flights were cut from tracks of which ' if cut else ''}only {100 * share:.0f} % of the "
                f"samples fall like a ball, in {frame.length} and {frame.time} with {frame.up} up: check units and axis"
            )
        if self.contents.smoothing > SMOOTHED:
            said.append(smoothed(self.contents.smoothing))
        said += filter(None, [self.contents.others, self.contents.repeated, self.contents.filled])
        if len(self.cut) < LEAST_TRACKS:
            said.append(FEW_TRACKS)
        return [*said, *clipped(self.tracks)]


def clipped(tracks: Sequence[Track]) -> list[str]:
    """A sentence on places that stick to a limit: the largest or smallest of all, again and again, sample by sample.

    The lowest place is none: balls lie and roll there.
    """
    said = list[str]()
    for axis, letter in enumerate("xyz"):
        for sign in (1.0,) if letter == "z" else (1.0, -1.0):
            most = max(float((sign * track.positions[:, axis]).max()) for track in tracks)
            stays = [sign * track.positions[:, axis] == most for track in tracks]
            ends = [np.flatnonzero(np.diff(own, prepend=False, append=False)) for own in stays if not own.all()]
            stuck = sum(int((own[1::2] - own[::2] >= STUCK).sum()) for own in ends)
            if stuck >= AGAIN:
                said.append(f"{letter} is clipped: {stuck} times it stays at {sign * most:.6g} m")
    return said


def recordings(tracks: Sequence[Track]) -> Recordings:
    """The flights of imported tracks."""
    labelled = ((track, label_samples(track, ANY_BALL)) for track in tracks)
    found = Contents.of(labelled, lambda _, labels: flies_throughout(labels))
    pieces = (found.pieces[track.name] for track in tracks)
    flights = [[track] if own is None else tracks_of(track, own) for track, own in zip(tracks, pieces, strict=True)]
    return Recordings(tracks, flights, found)


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
    shots, spin_notes = with_spins(with_labels(shots, beside))
    tracks, notes = _tracks(shots, frame, roles.sigma_units)
    ball, ball_guess, ball_doubt = ball_of(choices, frame)
    recorded = recordings(tracks)
    height, height_guess, table_doubt = table_of(tracks, recorded.cut, ball, choices)
    flights_guess = recorded.guess(choices.flights)
    if choices.flights and not recorded.cut:
        raise ValueError(
            "--flights must find flights; nothing in the tracks flies like a ball. Check units and up axis."
        )
    tracks = recorded.cut if choices.flights else tracks
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
        doubts=(*_unseen(roles), *frame.doubts, *recorded.doubts(frame, choices.flights), *table_doubt, *ball_doubt),
    )
    used = (*roles.time, *roles.places, roles.frame)
    doubts = [[*table.notes, *(said for name, said in table.doubts.items() if name in used)] for table in chosen]
    table_notes = list(dict.fromkeys(note for notes_of_one in doubts for note in notes_of_one))
    return Proposal(info, tracks, guesses, [*table_notes[:5], *counts.notes(), *spin_notes, *notes])


def _unseen(roles: Roles) -> list[str]:
    """A sentence on axes of the source without a column."""
    axes = [axis for axis, name in zip("xyz", roles.places, strict=True) if name == UNMEASURED]
    if not axes:
        return []
    return [f"{' and '.join(axes)} of the source {'are' if len(axes) > 1 else 'is'} not measured and set to zero"]


def _tracks(
    shots: Sequence[SourceShot], frame: Frame, sigma_units: Sequence[str | None]
) -> tuple[list[Track], list[str]]:
    """Tracks in m and s with z up, and notes on their repairs."""
    far = [origin_of(shot.stamps, frame.time) for shot in shots]
    origin = min(far, key=abs) if all(far) else 0
    findings = Findings()
    tracks = []
    for shot in shots:
        times = in_seconds(shot.stamps, frame.time, origin)
        parts = [times[:, None], frame.turned(frame.metres(shot.positions))]
        if shot.sigmas is not None:
            own = [replace(frame, length=unit or frame.length) for unit in sigma_units]
            sigmas = np.stack([one.metres(column) for one, column in zip(own, shot.sigmas.T, strict=True)], axis=1)
            parts.append(sigmas @ np.abs(np.array(TURNS[frame.up], dtype=np.float64)).T)

        def where(*rows: int, table: RawTable = shot.table) -> str:
            return f"{table.where}, rows {' and '.join(str(row + 1) for row in rows)}"

        try:
            values = tidy(RowGroup(shot.name, shot.rows, np.concatenate(parts, axis=1)), where, findings)
        except ValueError as error:
            what = f"{str(error).rpartition('. ')[0]}; a column may tell two balls apart"
            raise UndecidedError(what, "columns", (), "trajectory=NAME") from None
        spreads = values[:, 4:] if values.shape[1] > 4 else None
        tracks.append(Track(values[:, 0], values[:, 1:4], spreads, frame.turned_spin(shot.labels), name=shot.name))
    notes = findings.notes()
    if any(track.labels != shot.labels for track, shot in zip(tracks, shots, strict=True)):
        notes.append(f"spin labels turned with the axes: {frame.rotation}")
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
