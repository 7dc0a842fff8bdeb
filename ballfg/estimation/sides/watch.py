"""Which samples of a ball lie so close to a contact that it may be on either side, and what is told of it there."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.special import chdtri

from ballfg.arrays import Array
from ballfg.estimation.plausible import possible
from ballfg.estimation.sides.covering import covering
from ballfg.estimation.sides.passage import Passage, Seen, Ways
from ballfg.factors.linear.definite import definite, variances_positive
from ballfg.state import STATE_DIM

NEGLIGIBLE: Final = 1e-6
"""Chance of a side that does not count."""
LONGEST: Final = 8
"""Samples after which the estimator must have seen what happened."""
MOST_MISSES: Final = 2
"""Samples in a row that neither side explains: something else has happened to the ball."""
GATE_CHANCE: Final = 1e-6
"""Share of good positions that are taken for such samples."""


@dataclass(frozen=True)
class Told:
    """A ball near a contact: the more probable side, and by how much the other one widens what is stated.

    Attributes:
        mean: (d,) state, coefficients and bias on that side.  covariance: (d, d) on that side alone.
        other: (9, 9) to be added to the state's covariance.
        risen: whether that side is that of a ball that has bounced.
    """

    mean: Array
    covariance: Array
    other: Array
    risen: bool

    @property
    def widened(self) -> Array:
        """(d, d) covariance that holds both sides."""
        covariance = self.covariance.copy()
        covariance[:STATE_DIM, :STATE_DIM] += self.other
        return covariance


class Watch:
    """Follows a ball from sample to sample while it passes a contact, beside its estimator.

    Args: ways: of the ball.
    """

    def __init__(self, ways: Ways) -> None:
        self.ways = ways
        self._passage: Passage | None = None
        self._since = 0
        self._misses = 0

    def copy(self) -> Watch:
        """Another one that has seen the same; what either sees from now on is its own."""
        return copy.copy(self)

    def leave(self) -> None:
        """Something else than flight and a bounce has happened: look no further."""
        self._passage = None

    def take(self, before: tuple[Array, Array], dt: float, seen: Seen, bounced: Callable[[int], bool]) -> Told | None:
        """What is to be told of the ball at the next sample.

        Args:
            before: mean (d,) and covariance (d, d) of state, coefficients and bias that the estimator had a sample ago.
            dt: s since then.
            seen: what was measured now.
            bounced: whether the estimator holds that the ball has bounced within the last so many intervals.
        Returns: None where the ball is far from a contact, and the estimator's own answer holds.
        """
        if self._passage is None:
            if not self.ways.may_touch(*before, dt):
                return None
            self._begin(*before)
        return self._step(dt, seen, bounced)

    def follow(
        self, before: tuple[Array, Array], steps: list[tuple[float, Seen]], bounced: Callable[[int], bool]
    ) -> Told | None:
        """What is to be told of the ball some samples later, without an estimator between.

        Args: before, bounced: as of `take`.  steps: time in s and measurements of each sample.
        """
        self._begin(*before)
        told = None
        for dt, seen in steps:
            if self._passage is None:
                return None
            told = self._step(dt, seen, bounced)
        return told

    def join(self, seen: Seen, bounced: Callable[[int], bool]) -> Told | None:
        """The same as `take` after more was measured at the present sample."""
        if self._passage is None:
            return None
        self._passage = self._passage.measured(seen)
        return self._told(self._passage, bounced, fresh=True)

    def _begin(self, mean: Array, covariance: Array) -> None:
        self._passage, self._since, self._misses = Passage.begun(self.ways, mean, covariance), 0, 0

    def _step(self, dt: float, seen: Seen, bounced: Callable[[int], bool]) -> Told | None:
        assert self._passage is not None
        before = self._passage
        fresh = bool(before.sides()[0].logs[0] > np.log(NEGLIGIBLE))  # the bounce may lie in this interval
        after = before.after(dt, seen)
        if after.nearest > chdtri(3, GATE_CHANCE):
            self._misses += 1
            after = before.after(dt, Seen())
        else:
            self._misses = 0
        self._since += 1
        self._passage = after
        told = self._told(after, bounced, fresh=fresh) if self._misses < MOST_MISSES else None
        if told is None or self._since >= LONGEST:
            self._passage = None
        return told

    def _told(self, passage: Passage, bounced: Callable[[int], bool], *, fresh: bool) -> Told | None:
        """None where both agree on what has happened, or neither side is a ball's."""
        sides = passage.sides()
        chances = np.exp([side.logs[0] for side in sides])
        if not np.isfinite(chances).all():
            return None
        near = int(chances[1] > chances[0])
        certain = chances[1 - near] < NEGLIGIBLE
        if certain and bool(near) == bounced(self._since) and not (near and fresh):
            return None
        mean, covariance = sides[near].means[0], sides[near].covariances[0]
        if not (possible(mean[:STATE_DIM]) and variances_positive(covariance)):
            return None
        covariance, own = definite(covariance), slice(STATE_DIM)
        other = np.zeros((STATE_DIM, STATE_DIM))
        if not certain:
            jump = sides[1 - near].means[0] - mean
            far = sides[1 - near].covariances[0, own, own]
            other = covering(covariance[own, own], far, jump[own], float(chances[1 - near]))
        return Told(mean, covariance, other, bool(near))
