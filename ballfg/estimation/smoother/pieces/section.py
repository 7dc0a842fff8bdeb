"""A section of a long track has samples, margins on both sides, events, and factors of its own."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.estimation.segmentation.result import Contact, Rest, Segmentation
from ballfg.estimation.smoother.problem import Events, TrackProblem
from ballfg.estimation.smoother.settle import places_of, timed_contacts
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Rows, Values
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.estimation.smoother.smoother import Smoother


@dataclass(frozen=True)
class Section:
    """Samples `first` to `last` of a part of a track. The last one is the first of the next section.

    A factor belongs to the section of its first state. So the factors on the last state alone belong to the next
    section, except at the end of the track.

    Attributes:
        track: the part, with margins on both sides; labels only at the beginning of the track.
        segmentation: the events in the part, with refined contacts.  first, last: index in the part.
        ends: True if the track ends with the section.
        spans: as of `Events`.
    """

    track: Track
    segmentation: Segmentation
    first: int
    last: int
    ends: bool
    spans: Mapping[int, tuple[float, float]] = field(default_factory=dict)

    @property
    def events(self) -> Events:
        """The events in the part."""
        return Events(self.segmentation.contacts, self.segmentation, self.spans)

    def padded(self, array: Array) -> Array:
        """One entry per sample of the part from one per state; the margins repeat those at the ends."""
        index = np.clip(np.arange(len(self.track)) - self.first, 0, self.last - self.first)
        return np.asarray(array[index])

    def padded_values(self, values: Values) -> Values:
        """Values of all samples of the part from those of the section's states."""
        biases = None if values.biases is None else self.padded(values.biases)
        return replace(values, states=self.padded(values.states), biases=biases)

    def owns(self, states: Index) -> NDArray[np.bool_]:
        """(m,) bool: True for the section's own factors, by their first states (m,), index in the part."""
        return (states >= self.first) & (states < self.last + self.ends)

    def linearized(self, own: Sequence[FactorBatch], values: Values) -> list[Rows]:
        """The section's own factors at values of its states, which are counted from its first."""
        found = [batch.linearize(self.padded_values(values)) for batch in own]
        counted = (np.where(rows.variables < 0, rows.variables, rows.variables - self.first) for rows in found)
        return [replace(rows, variables=variables) for rows, variables in zip(found, counted, strict=True)]

    def own(self, problem: TrackProblem) -> list[FactorBatch]:
        """The section's factors, states counted as in the part. Args: problem: of the part."""
        none, found = np.iinfo(np.int64).max, []
        for batch in problem.graph(self.events).batches:
            states = np.where(batch.variables == COEFFICIENTS, none, batch.variables)
            own = self.owns(states.min(axis=1, initial=none))  # none: of coefficients alone
            if own.any():
                found.append(batch.select(np.flatnonzero(own)))
        return found


@dataclass(frozen=True)
class State:
    """A section with its present states and coefficients."""

    section: Section
    values: Values


def prior_rows(problem: TrackProblem, section: Section, values: Values) -> list[Rows]:
    """The factors on the coefficients alone, which all sections share, at a point."""
    batches = problem.graph(section.events).batches
    return [batch.linearize(values) for batch in batches if len(batch) and (batch.variables == COEFFICIENTS).all()]


def part_of(track: Track, begin: int, end: int) -> Track:
    """The samples begin to end - 1; labels belong to the first sample of the track only."""
    if track.observations:
        mask = np.zeros(len(track), dtype=bool)
        mask[begin:end] = True
        track = replace(track, observations=tuple(one.select(mask) for one in track.observations))
    inside = slice(begin, end)
    return replace(
        track,
        times=track.times[inside],
        positions=track.positions[inside],
        sigmas=None if track.sigmas is None else track.sigmas[inside],
        labels=track.labels if begin == 0 else {},
        dataset=None,
    )


def events_of(segmentation: Segmentation, begin: int, end: int) -> Segmentation:
    """The events among the samples begin to end - 1, renumbered from 0."""

    def inside(intervals: Index) -> Index:
        return intervals[(intervals >= begin) & (intervals < end - 1)] - begin

    contacts = (replace(c, interval=c.interval - begin) for c in segmentation.contacts if begin <= c.interval < end - 1)
    rests = (Rest(max(r.first, begin) - begin, min(r.last, end - 2) - begin, r.height) for r in segmentation.rests)
    return Segmentation(
        tuple(contacts),
        inside(segmentation.hits),
        inside(segmentation.restarts),
        tuple(rest for rest in rests if rest.first <= rest.last),
        segmentation.quality[begin:end],
    )


def shifted(segmentation: Segmentation, by: int) -> Segmentation:
    """The same events, counted from a sample `by` earlier."""
    contacts = tuple(Contact(c.interval + by, c.time, c.height) for c in segmentation.contacts)
    rests = tuple(Rest(r.first + by, r.last + by, r.height) for r in segmentation.rests)
    hits, restarts = segmentation.hits + by, segmentation.restarts + by
    return Segmentation(contacts, hits, restarts, rests, segmentation.quality)


@dataclass(frozen=True)
class Look:
    """Events and states of a part of a track by itself.

    Attributes:
        begin: first sample of the part, in the track.  values: of its states.
        segmentation: its events, the contacts in their estimated intervals; counted from the track's first sample.
        moved: True if one of its contacts moved into another interval.
        timed: the contacts with their estimated times, with the same numbering.
        rival: (3,) rad/s, another first spin that explains the part nearly as well, or None.
        spans: as of `Events`, counted from the track's first sample.
    """

    begin: int
    values: Values
    segmentation: Segmentation
    moved: bool
    timed: tuple[Contact, ...]
    rival: Array | None
    spans: Mapping[int, tuple[float, float]]

    @property
    def end(self) -> int:
        """The sample after the last."""
        return self.begin + len(self.values.states)

    def busy(self) -> Index:
        """Intervals and samples of the track with events."""
        s = self.segmentation
        bounds = [edge for rest in s.rests for edge in (rest.first, rest.last)]
        bad = self.begin + np.flatnonzero(s.quality)
        return np.concatenate(([c.interval for c in s.contacts], s.hits, bounds, bad)).astype(np.int64)

    def select(self, begin: int, end: int) -> Values:
        """The values of the states begin to end - 1 of the track."""
        return self.values.select(begin - self.begin, end - self.begin)


def bounds_of(samples: int, length: int, overlap: int) -> list[tuple[int, int]]:
    """First sample of each part of some length and the one after its last; neighbours share 2 `overlap` samples."""
    parts = max(1, round(samples / length))
    cuts = np.linspace(0, samples, parts + 1).round().astype(int).tolist()
    return [(max(0, a - overlap), min(samples, b + overlap)) for a, b in pairwise(cuts)]


def look(smoother: "Smoother", part: tuple[int, Track]) -> Look | None:
    """The events and states of a part, given with its first sample's number; None without a finite explanation."""
    begin, track = part
    problem = smoother.problem(track)
    _, solution = smoother.bridged(problem, smoother.settle(problem))
    if solution.minimum.step is None:
        return None
    found = replace(solution.events.segmentation, contacts=solution.events.contacts)
    timed = replace(found, contacts=timed_contacts(track.times, solution))
    moved = places_of(found.contacts) != places_of(solution.events.segmentation.contacts)
    events, contacts = shifted(found, begin), shifted(timed, begin).contacts
    spans = {interval + begin: span for interval, span in (solution.events.spans or {}).items()}
    return Look(begin, solution.minimum.values, events, moved, contacts, solution.rival, spans)


def cut_between(one: Look, other: Look) -> int:
    """The shared sample of two neighbours that is furthest from all events in either of them.

    There they agree on the events, and no event is lost or counted twice. The outer quarters of the shared samples are
    excluded: a part is uncertain of the events at its end.
    """
    margin = (one.end - other.begin) // 4
    candidates = np.arange(other.begin + margin, one.end - margin)
    busy = np.concatenate((one.busy(), other.busy()))
    middle = 0.5 * (one.end - 1 + other.begin)
    distance = np.abs(candidates[:, None] - 0.5 - busy).min(axis=1, initial=len(candidates))
    return int(candidates[np.lexsort((np.abs(candidates - middle), -distance))[0]])


def joined(looks: Sequence[Look], cuts: Sequence[int]) -> Segmentation:
    """The events of the whole track: each interval's from its own part.

    If a contact has moved, all get their estimated times, as in a track that is smoothed at once.

    Args: looks: in order.  cuts: (k + 1,) first sample of each part, and the number of samples.
    """
    contacts, rests = list[Contact](), list[Rest]()
    hits, restarts, quality = list[Index](), list[Index](), list[NDArray[np.int8]]()
    moved = any(one.moved for one in looks)
    for one, first, last in zip(looks, cuts[:-1], cuts[1:], strict=True):
        s = one.segmentation
        contacts += [c for c in (one.timed if moved else s.contacts) if first <= c.interval < last]
        hits.append(s.hits[(s.hits >= first) & (s.hits < last)])
        restarts.append(s.restarts[(s.restarts >= first) & (s.restarts < last)])
        for rest in s.rests:
            inside = replace(rest, first=max(rest.first, first), last=min(rest.last, last - 1))
            if inside.first > inside.last:
                continue
            if rests and rests[-1].last + 1 == inside.first == first and rests[-1].height == rest.height:
                inside = replace(inside, first=rests.pop().first)
            rests.append(inside)
        quality.append(s.quality[first - one.begin : last - one.begin])
    contacts.sort(key=lambda c: c.time)
    whole = np.concatenate
    return Segmentation(tuple(contacts), whole(hits), whole(restarts), tuple(rests), whole(quality))


def section_of(track: Track, events: Segmentation, one: Look, first: int, last: int, margin: int) -> Section:
    """A section from sample `first` to `last`, the first of the next one or the track's last, with margins.

    Args: one: the look at its part of the track.
    """
    begin, end = max(0, first - margin), min(len(track), last + 1 + margin)
    part = part_of(track, begin, end)
    spans = {interval - begin: span for interval, span in one.spans.items() if begin <= interval < end - 1}
    return Section(part, events_of(events, begin, end), first - begin, last - begin, last == len(track) - 1, spans)
