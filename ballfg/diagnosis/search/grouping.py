"""Ways in which tracks of a dataset may differ: by a label, or by their place in the recording."""

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Index
from ballfg.dynamics.variation import TRACK, number_of, place_of
from ballfg.tracks import Track

MOST_GROUPS: Final = 8
"""Labels with more values than this (a wheel speed, a player) are not groups."""
LEAST_TRACKS: Final = 3
"""Tracks on either side of a change, and in each group of either half: fewer cannot tell their scatter."""
PARTS: Final = 8
"""A recording is first asked for a change after each of so many parts of it; then the change is looked for between."""


@dataclass(frozen=True)
class Grouping:
    """One way in which tracks differ.

    Attributes:
        by: the label, or "track" for the place in the recording.
        weights: by name of a level, the weight (by name of the track) of the level's own deviation.
        first: name of the first track, of a place in the recording.
        line: whether the change along the recording is steady.
    """

    by: str
    weights: Mapping[str, Mapping[str, float]]
    first: str = ""
    line: bool = False

    @property
    def suffix(self) -> str:
        """End of the name of a finding."""
        return "_drift" if self.by == TRACK else "_by_group"

    def named(self, level: str) -> str:
        """A level in a report: `backspin`, `from 024`, `at 099`."""
        return level if self.by != TRACK else f"{'at' if self.line else 'from'} {level}"


def groupings(tracks: Sequence[Track], searched: Sequence[str]) -> list[Grouping]:
    """All ways in which the tracks of a dataset may differ.

    Args: tracks: all, in the order of the recording.  searched: names of those of the search half.
    """
    return [*_by_labels(tracks, set(searched)), *_by_place([track.name for track in tracks], searched)]


def steps_near(grouping: Grouping, searched: Sequence[str], names: Sequence[str]) -> list[Grouping]:
    """A step moved to every track of the search half that no other part begins nearer to; itself if it is no step."""
    if grouping.by != TRACK or grouping.line:
        return [grouping]
    reach, at = max(1, len(searched) // PARTS), searched.index(next(iter(grouping.weights)))
    begins = range(max(LEAST_TRACKS, at - reach), min(len(searched) - LEAST_TRACKS, at + reach) + 1)
    return [_step(names, searched[begin]) for begin in begins]


def steps_between(grouping: Grouping, searched: Sequence[str], names: Sequence[str]) -> list[Grouping]:
    """A step moved to every track since the last one of the search half before it; itself if it is no step."""
    if grouping.by != TRACK or grouping.line:
        return [grouping]
    begin = next(iter(grouping.weights))
    last = max(names.index(name) for name in searched if names.index(name) < names.index(begin))
    return [_step(names, name) for name in names[last + 1 : names.index(begin) + 1]]


def _by_labels(tracks: Sequence[Track], searched: set[str]) -> list[Grouping]:
    found = []
    for label in sorted({name for track in tracks for name, value in track.labels.items() if isinstance(value, str)}):
        known = {track.name: str(track.labels[label]) for track in tracks if label in track.labels}
        levels = sorted(set(known.values()))
        halves = [[v for n, v in known.items() if (n in searched) is half] for half in (True, False)]
        enough = all(half.count(level) >= LEAST_TRACKS for level in levels for half in halves)
        if 2 <= len(levels) <= MOST_GROUPS and enough:
            weights = {level: {n: 1.0 for n, value in known.items() if value == level} for level in levels}
            found.append(Grouping(label, weights))
    return found


def _by_place(names: Sequence[str], searched: Sequence[str]) -> list[Grouping]:
    """Steps and a line; none where names do not tell the order of the recording."""
    places = [place_of(name) for name in names]
    if any(later <= earlier for earlier, later in itertools.pairwise(places)):
        return []
    begins = np.unique(np.linspace(0, len(searched), PARTS + 1).round().astype(int)[1:-1])
    inside = [b for b in begins.tolist() if LEAST_TRACKS <= b <= len(searched) - LEAST_TRACKS]
    found = [_step(names, searched[begin]) for begin in inside]
    numbers = [number_of(name) for name in names]
    known: Index = np.array([n for n in numbers if n is not None])
    if inside and len(known) == len(names) and (np.diff(known) > 0).all():
        along = (known - known[0]) / (known[-1] - known[0])
        weights = dict(zip(names, along.tolist(), strict=True))
        found.append(Grouping(TRACK, {names[-1]: weights}, names[0], line=True))
    return found


def _step(names: Sequence[str], begin: str) -> Grouping:
    return Grouping(TRACK, {begin: {n: 1.0 for n in names if place_of(n) >= place_of(begin)}}, names[0])
