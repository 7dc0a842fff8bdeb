"""A section of a long track has samples, margins on both sides, events, and factors of its own."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.estimation.segmentation.result import Contact, Rest, Segmentation
from ballfg.estimation.smoother.problem import Events, TrackProblem
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Rows, Values
from ballfg.tracks import Track


@dataclass(frozen=True)
class Section:
    """Samples `first` to `last` of a part of a track. The last one is the first of the next section.

    A factor belongs to the section of its first state. So the factors on the last state alone belong to the next
    section, except at the end of the track.

    Attributes:
        track: the part, with margins on both sides; labels only at the beginning of the track.
        segmentation: the events in the part, with refined contacts.
        first, last: index in the part.
        ends: True if the track ends with the section.
    """

    track: Track
    segmentation: Segmentation
    first: int
    last: int
    ends: bool

    def __len__(self) -> int:
        """States from the first to the last."""
        return self.last - self.first + 1

    @property
    def events(self) -> Events:
        """The events in the part."""
        return Events(self.segmentation.contacts, self.segmentation)

    def inside(self, array: Array) -> Array:
        """The entries of the section's states, from one per sample of the part."""
        return array[self.first : self.last + 1]

    def padded(self, array: Array) -> Array:
        """One entry per sample of the part from one per state; the margins repeat those at the ends."""
        index = np.clip(np.arange(len(self.track)) - self.first, 0, len(self) - 1)
        return np.asarray(array[index])

    def padded_values(self, values: Values) -> Values:
        """Values of all samples of the part from those of the section's states."""
        biases = None if values.biases is None else self.padded(values.biases)
        return replace(values, states=self.padded(values.states), biases=biases)

    def owns(self, states: Index) -> NDArray[np.bool_]:
        """(m,) bool: True for the section's own factors, by their first states (m,), index in the part."""
        return (states >= self.first) & (states < self.last + self.ends)

    def linearized(self, own: Sequence[FactorBatch], values: Values) -> list[Rows]:
        """The section's factors at a point, their states counted from its first.

        Args: own: its factors.  values: of the section's states.
        """
        padded = self.padded_values(values)
        found = [batch.linearize(padded) for batch in own]
        return [
            replace(rows, variables=np.where(rows.variables < 0, rows.variables, rows.variables - self.first))
            for rows in found
        ]

    def own(self, problem: TrackProblem) -> list[FactorBatch]:
        """The section's factors, states counted as in the part. Args: problem: of the part."""
        batches = ((batch, self.owns(first_states(batch))) for batch in problem.graph(self.events).batches)
        return [batch.select(np.flatnonzero(own)) for batch, own in batches if own.any()]


@dataclass(frozen=True)
class State:
    """A section with its present states and coefficients."""

    section: Section
    values: Values


def first_states(batch: FactorBatch) -> Index:
    """(m,) index of the first state of each factor; -1 for factors of coefficients alone."""
    states = batch.variables
    least = np.where(states == COEFFICIENTS, np.iinfo(np.int64).max, states).min(axis=1, initial=np.iinfo(np.int64).max)
    return np.where(least == np.iinfo(np.int64).max, -1, least)


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
