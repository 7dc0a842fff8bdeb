"""Computes the final estimate of a streamed track: the window's minimum and the states that left the window."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.events import EventTracker
from ballfg.estimation.online.state import Sample
from ballfg.estimation.online.windows.stream_window import StreamWindow
from ballfg.estimation.plausible import measured_only
from ballfg.estimation.result import Estimate, Status, joined, opening
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.settle import Earlier
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.state import STATE_DIM
from ballfg.tracks import Track

_NUMBER = re.compile(r"[0-9]+([.][0-9]+)?")


@dataclass(frozen=True, eq=False)
class Leaving:
    """Collects what is known of the states of a track when they leave the window.

    Attributes: smoother: of the window's samples.  track: whose samples are pushed.  parts: estimates of all that left.
    """

    smoother: Smoother
    track: Track
    parts: list[Estimate] = field(default_factory=list)

    def take(self, window: StreamWindow, events: EventTracker, count: int) -> None:
        """Keeps the oldest states of the window, so many, as its minimum has them."""
        self.parts.append(opening(self._minimum(window, events), count))

    def lose(self, samples: Sequence[Sample], p: int) -> None:
        """Keeps the states of samples as they are known without their window, which could not be solved.

        Args: p: number of coefficients.
        """
        known = [unknown(sample, self.smoother.settings) for sample in samples]
        n, own = len(samples), slice(STATE_DIM)
        part = Estimate(
            self.track.name,
            np.array([sample.time for sample in samples]),
            np.array([state for state, _ in known]).reshape(n, STATE_DIM),
            np.array([joint[own, own] for _, joint in known]).reshape(n, STATE_DIM, STATE_DIM),
            Status.NOT_CONVERGED,
            cross_covariances=np.zeros((n, STATE_DIM, p)),
            hits=np.flatnonzero([sample.motion.hit or not sample.motion.linked for sample in samples[1:]]),
            quality=np.zeros(n, dtype=np.int8),
            other_sides=np.zeros((n, STATE_DIM, STATE_DIM)),
        )
        self.parts.append(part)

    def whole(self, window: StreamWindow, events: EventTracker) -> Estimate:
        """The result over the whole track, from the window at its end and the states before it.

        Of notes that differ in their numbers only, the earliest window's stays.
        """
        late = self._minimum(window, events)
        if not self.parts:
            return late
        parts = [*self.parts, late]
        whole = joined(late, self.track.times, parts, lambda known, own: own if known is Status.OK else known)
        said = {
            _NUMBER.sub("", note): note for part in reversed(parts) for note in part.notes
        }  # the earliest of a kind
        return replace(whole, notes=tuple(reversed(said.values())))

    def _minimum(self, window: StreamWindow, events: EventTracker) -> Estimate:
        """The estimate of the window's samples, with all that is known from those before it."""
        first, times = window.first, self.track.times
        part = self.track.between(float(times[first]), float(times[first + len(window) - 1]))
        found = events.segmentation(first, part.times, part.positions)
        found = events.with_moved_contacts(found, first)  # the window's states fit the refined contacts
        problem = self.smoother.problem(part, found)
        settled = self.smoother.settle(problem, Earlier(window.values, window.summaries()))
        if not first:  # what has left the window is not known well enough
            problem, settled = self.smoother.bridged(problem, settled)
        return self.smoother.result(problem, settled, begins=not first)


def unknown(sample: Sample, settings: Settings) -> tuple[Array, Array]:
    """A state (9,) known by its observation alone, and its covariance (9 + p, 9 + p) with the coefficients."""
    (state,), (own,) = measured_only(sample.position[None], sample.sigma[None], settings)
    return state, np.diag(np.concatenate((np.diagonal(own), np.square([*settings.coefficients.values()]))))
