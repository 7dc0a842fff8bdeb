"""Finds the flights in imported recordings, and what is doubtful about them."""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain
from typing import Final

import numpy as np

from ballfg.estimation.configure import FEW_TRACKS, LEAST_TRACKS
from ballfg.estimation.flights.cut import flies_throughout, tracks_of
from ballfg.estimation.flights.dataset import ENOUGH, SMOOTHED, Contents, smoothed
from ballfg.estimation.flights.labels import label_samples
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.importing.choices import Guess
from ballfg.importing.frame import Frame
from ballfg.tracks import Track

STUCK: Final = 4  # samples in a row that are exactly the largest or smallest of all: no moving ball does that
AGAIN: Final = 2  # times that it happens where a limit clips; once is a ball at rest
ANY_BALL: Final = SegmentationPhysics(drag=0.06)
"""Between the drag of a heavy and of a light ball; the labels leave room for either."""


@dataclass(frozen=True)
class Recordings:
    """Imported tracks, and the flights in them.

    Attributes:
        tracks: as they were recorded.  flights: those of each track; the track itself if nothing else is in it.
        share: of the samples that are flight, 0 to 1.  smoothing, others: as of `InFlight`.
    """

    tracks: Sequence[Track]
    flights: Sequence[Sequence[Track]]
    share: float
    smoothing: float
    others: str

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
        rest = f"{int(100 * self.share)} % of the samples fly; in the others the ball is held, rolls, rests or is lost"
        if chosen:
            return Guess("flights", f"{len(self.cut)}, from {self.mixed} tracks", rest, "stated", "")
        return Guess("flights", "left in their tracks", rest, "likely", "--flights")

    def doubts(self, frame: Frame, cut: bool) -> list[str]:
        """Sentences for `dataset.yaml`. Args: frame: the units.  cut: True if only flights are kept."""
        said = list[str]()
        if self.share < ENOUGH:
            said.append(
                f"{'the flights were cut from tracks of which ' if cut else ''}only {100 * self.share:.0f} % of the "
                f"samples fall like a ball, in {frame.length} and {frame.time} with {frame.up} up: check units and axis"
            )
        if self.smoothing > SMOOTHED:
            said.append(smoothed(self.smoothing))
        said += filter(None, [self.others])
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
    return Recordings(tracks, flights, found.share, found.smoothing, found.others)
