"""Cuts the flights out of tracks."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.estimation.flights.labels import SHORTEST, Labels, label_samples
from ballfg.estimation.result import Label
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.tracks import Track
from ballfg.tracks.track import Label as TrackLabel

BEFORE: Final = {Label.HELD: "thrown", Label.ROLLING: "left a surface", Label.RESTING: "left a surface"}
"""Reasons of the beginning of a flight, by what was before."""
AFTER: Final = {Label.HELD: "caught", Label.ROLLING: "rolled", Label.RESTING: "came to rest"}
"""Reasons of its end, by what came after."""


@dataclass(frozen=True)
class Piece:
    """A flight in a track: first and last sample, inclusive, and why it begins and ends there."""

    first: int
    last: int
    begins: str
    ends: str

    def of(self, track: Track, name: str) -> Track:
        """The flight as a track, with the reasons among its labels."""
        reasons: dict[str, TrackLabel] = {"recording": track.name, "begins": self.begins, "ends": self.ends}
        part = track.between(float(track.times[self.first]), float(track.times[self.last]))
        return replace(part, name=name, labels={**part.labels, **reasons})


def pieces_of(labels: Labels) -> list[Piece]:
    """The flights of a labelled track."""
    values, found = labels.values, list[Piece]()
    for first, last in labels.stretches(Label.FLIGHT):
        before = Label(int(values[first - 1])) if first else None
        after = Label(int(values[last + 1])) if last + 1 < len(values) else None
        if last - first + 1 >= SHORTEST:
            begins = "start" if before is None else BEFORE.get(before, "seen again")
            found.append(Piece(first, last, begins, "end" if after is None else AFTER.get(after, "lost")))
    return found


def flights_of(track: Track, physics: SegmentationPhysics, levels: Sequence[float] = ()) -> list[Track]:
    """The flights of a track: itself, where nothing else is in it.

    Args: physics: of the ball.  levels: m, heights of its centre at which it is known to lie.
    """
    labels = label_samples(track, physics, levels)
    if flies_throughout(labels):
        return [track]
    return tracks_of(track, pieces_of(labels))


def names_of(track: str, pieces: Sequence[Piece]) -> list[str]:
    """The names of the flights in a track of a name."""
    return [f"{track}-{i:03d}" for i in range(len(pieces))]


def tracks_of(track: Track, pieces: Sequence[Piece]) -> list[Track]:
    """The flights in a track as tracks."""
    return [piece.of(track, name) for name, piece in zip(names_of(track.name, pieces), pieces, strict=True)]


def flies_throughout(labels: Labels) -> bool:
    """True if all samples of a track show a flight, apart from single lost ones."""
    return bool(np.isin(labels.values, (Label.FLIGHT, Label.LOST)).all() and (labels.values == Label.FLIGHT).any())
