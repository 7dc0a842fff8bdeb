"""Holds Gaussian beliefs of balls at a sequence of times and carries them on by machine code."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, Any, Final, NamedTuple, Self

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.beliefs.carry import carry
from ballfg.dynamics.compiled.beliefs.events import find
from ballfg.dynamics.compiled.beliefs.mixture import mix
from ballfg.dynamics.compiled.motion import Moving, functions_for, raise_errors, world_of
from ballfg.dynamics.compiled.roll_out import crossed_by_all, scatter
from ballfg.dynamics.compiled.signatures import GIVEN
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import POSITION, STATE_DIM, VELOCITY, Z

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

ENDS: Final = slice(3, 7)  # Of a world for machine code: the ends of the table


@dataclass(frozen=True)
class Course:
    """Beliefs of n balls at k times, linear about the mean, and of their unbounced neighbours.

    Attributes:
        mean: (k, n, 9 + p) states and coefficients.  covariance: (k, n, 9 + p, 9 + p).
        beside, besides: mean and covariance of a neighbour that flew on through a surface a short while ago. level: (k,
        n) m, that surface.  age: (k, n) s since then; NaN without such a neighbour.
    """

    mean: Array
    covariance: Array
    beside: Array
    besides: Array
    level: Array
    age: Array

    @classmethod
    def start(cls, mean: Array, covariance: Array) -> Course:
        """One time, without neighbours: mean (n, d), covariance (n, d, d)."""
        none = np.full((1, len(mean)), np.nan)
        return cls(mean[None], covariance[None], mean[None], covariance[None], none, none)

    def __len__(self) -> int:
        return len(self.mean)

    def at(self, rows: Any) -> Course:
        """A part of the times: a slice or indices."""
        return Course(*(getattr(self, field.name)[rows] for field in fields(self)))

    @staticmethod
    def joined(parts: Sequence[Course]) -> Course:
        """All times of several courses."""
        if len(parts) == 1:
            return parts[0]
        return Course(*(np.concatenate([getattr(part, f.name) for part in parts]) for f in fields(Course)))


@dataclass(frozen=True)
class Flown:
    """The steps that one ball has flown so far from its start on.

    Attributes:
        ends: (m,) s since the start; negative after a step with a contact, or at rest; NaN where none is known.
        means, spreads: (m, 9 + p) and (m, 9 + p, 9 + p), the beliefs then.
    """

    ends: Array
    means: Array
    spreads: Array

    @classmethod
    def empty(cls, width: int, most: int) -> Self:
        """Room for some steps of a ball of 9 + p numbers."""
        return cls(np.full(most, np.nan), np.empty((most, width)), np.empty((most, width, width)))

    def known(self) -> tuple[Array, Array, Array]:
        """The ends, means and covariances of the known steps."""
        rows = np.isfinite(self.ends)
        return self.ends[rows], self.means[rows], self.spreads[rows]


class Found(NamedTuple):
    """The end of a search for an event.

    Attributes:
        how: `events.NONE`, `FOUND`, or `HARD` before a landing, several bounces, or a bounce at a table's edge.
        elapsed: s since the start.  mean, covariance: (9 + p,) and (9 + p, 9 + p) then.
        gradient: (9 + p,) the event's.  rate: (9 + p,) 1/s, the mean's rate of change, of an event that was found.
    """

    how: float
    elapsed: float
    mean: Array
    covariance: Array
    gradient: Array
    rate: Array


class Carrier:
    """Carries the beliefs of n balls on, with the coefficients that they have at the start.

    Args:
        model: of the balls; coefficients that travel with the states are columns of theirs.
        mean: (n, 9 + p) at the start.  surfaces: table and floor.
        noise: (5,) densities of the acceleration, m/s^2/sqrt(Hz), and of the spin, rad/s/sqrt(s); of an impact along
            the vertical and along the surface, m/s, and of its spin, rad/s.
    """

    def __init__(self, model: BallModel, mean: Array, surfaces: Surfaces, noise: Array) -> None:
        functions = functions_for(model)
        moving = Moving(model, functions, mean, mean.shape[1])
        self._laws = moving.laws
        self._given = self._laws[: len(GIVEN)]
        self._functions = functions
        self._world, self._noise = world_of(surfaces, functions.radius), noise
        self._keeps = model  # what torch computes is found by the model as long as it is there

    def carry(self, course: Course, h: Array) -> tuple[Course, Array]:
        """Carry the last beliefs of a course on by steps of h (n, k) s of at most `MAX_STEP`.

        Returns: the course from that time on, 1 + j times for j <= k steps; and hard (n,): nonzero for a ball that has
            not reached the last time of the course, since its bounce is not a plain one.
        """
        last, steps, n = course.at(slice(-1, None)), h.shape[1], h.shape[0]
        whole = Course(*(np.empty((steps + 1, *getattr(last, f.name).shape[1:])) for f in fields(Course)))
        for field in fields(Course):
            getattr(whole, field.name)[0] = getattr(last, field.name)[0]
        hard = np.zeros(n)
        arrays = [getattr(whole, field.name) for field in fields(Course)]
        done = carry(*self._laws, np.ascontiguousarray(h), self._world, self._noise, *arrays, hard)
        raise_errors()
        return whole.at(slice(done + 1 + bool(hard.any()))), hard

    def find(
        self,
        mean: Array,
        covariance: Array,
        horizon: float,
        earliest: float,
        line: tuple[Array, float] | None,
        either_way: bool,
        flown: Flown | None = None,
    ) -> Found:
        """Look for an event on the way of one ball.

        Args:
            mean, covariance: (9 + p,) and (9 + p, 9 + p), at the start.
            horizon, earliest: s from there; only events up to the one and after the other count.
            line: (9,) and an offset: the event is that normal . state falls through it. None: the next contact.
            either_way: count a rise through the offset as well.
            flown: what earlier searches from there have flown, which this one adds to.
        """
        mean, covariance, rate = mean.copy(), covariance.copy(), np.zeros(len(mean))
        normal, offset = (np.zeros(STATE_DIM), 0.0) if line is None else line
        how = (line is None, either_way, normal, offset, earliest, horizon)
        flown = Flown.empty(len(mean), 0) if flown is None else flown
        known = flown.ends, flown.means, flown.spreads
        end, time = find(*self._laws, *how, self._world, self._noise, mean, covariance, rate[:STATE_DIM], *known)
        raise_errors()
        return Found(end, time, mean, covariance, self._gradient(mean, line), rate)

    def _gradient(self, mean: Array, line: tuple[Array, float] | None) -> Array:
        """Gradient (9 + p,) of the event of `find` at a mean (9 + p,)."""
        width, x = len(mean), mean[None, :STATE_DIM].copy()
        gradient, moved = np.zeros(width), np.zeros((1, 3, width))
        s, st, ws = (self._given[k] for k in (7, 8, 11))
        if line is None:
            surface = self._functions.surface.compute
            surface(x, s[:1], ws, np.eye(STATE_DIM, width)[None], st[:1], np.empty((1, 3)), moved)
            gradient[Z] = 1.0
            gradient -= moved[0, 0]
        else:
            gradient[:STATE_DIM] = line[0]
        return gradient

    def mixed(self, course: Course) -> Course:
        """The course with means and covariances of the balls on both sides of contacts of uncertain time."""
        copied = Course(*(np.array(getattr(course, f.name), order="C") for f in fields(Course)))
        mix(*self._given, self._world, self._noise, *(getattr(copied, f.name) for f in fields(Course)))
        raise_errors()
        return copied


@dataclass(frozen=True)
class Scattered:
    """Paths of n possible balls through k moments, with one on each side of a bounce.

    Attributes: times: (n, k) s since the start.  states: (n, k, 9).  met: (n, k) number of bounces so far.
    """

    times: Array
    states: Array
    met: Array

    @classmethod
    def of(
        cls, model: BallModel, start: Array, h: float, chance: tuple[Array, Array, Array], surfaces: Surfaces
    ) -> Self:
        """The paths from start (n, 9 + p) on, in steps of h s.

        Args:
            chance: pushes (steps, n, 3) m/s^2, kicks (n, 3) m/s and by how far the ends of the table are off (n, 4) m.
        """
        pushes, kicks, ends = chance
        functions, (steps, n) = functions_for(model), pushes.shape[:2]
        worlds = np.tile(world_of(surfaces, functions.radius), (n, 1))
        worlds[:, ENDS] += ends
        moving = Moving(model, functions, start, 0)
        states, times, met = np.empty((n, steps, 3, STATE_DIM)), np.empty((n, steps, 3)), np.empty((n, steps, 3))
        first = np.ascontiguousarray(start[:, :STATE_DIM])
        scatter(*moving.laws, first, h, pushes, kicks, worlds, states, times, met)
        raise_errors()
        nodes = (n, 3 * steps)
        return cls(
            np.concatenate((np.zeros((n, 1)), times.reshape(nodes)), axis=1),
            np.concatenate((first[:, None], states.reshape(*nodes, STATE_DIM)), axis=1),
            np.concatenate((np.zeros((n, 1)), met.reshape(nodes)), axis=1),
        )

    def crossed(self, rows: Index, at: Index, normal: Array, offset: float) -> tuple[Array, Array]:
        """Times (m,) s since the start and states (m, 9) of balls that cross normal . p = offset (m).

        Args: rows: (m,) balls.  at: (m,) moments before, with the next one on the other side.
        """
        h, times, states = self.times[rows, at + 1] - self.times[rows, at], np.empty(len(rows)), self.states[rows, at]
        crossed_by_all(states.copy(), self.states[rows, at + 1], h, normal, offset, times, states)
        return self.times[rows, at] + times, states

    def topped(self, rows: Index, at: Index) -> tuple[Array, Array]:
        """Times (m,) s since the start and states (m, 9) at the highest points of balls that rise, then fall.

        Args: rows: (m,) balls.  at: (m,) moments before, with the next one in the same flight.
        """
        x, after, h = self.states[rows, at], self.states[rows, at + 1], self.times[rows, at + 1] - self.times[rows, at]
        rise, slope, last = (
            after[:, POSITION] - x[:, POSITION],
            h[:, None] * x[:, VELOCITY],
            h[:, None] * after[:, VELOCITY],
        )
        bend, twist = 3.0 * rise - 2.0 * slope - last, slope + last - 2.0 * rise  # p + slope s + bend s^2 + twist s^3
        share = slope[:, 2] / (np.sqrt(bend[:, 2] ** 2 - 3.0 * twist[:, 2] * slope[:, 2]) - bend[:, 2])
        s, states = share[:, None], x + share[:, None] * (after - x)
        states[:, POSITION] = x[:, POSITION] + s * (slope + s * (bend + s * twist))
        states[:, VELOCITY] = (slope + s * (2.0 * bend + 3.0 * s * twist)) / h[:, None]
        return self.times[rows, at] + share * h, states


def density_of(noise: Any) -> Array:
    """(5,) the numbers for `Carrier` from a process noise."""
    along = np.hypot(noise.contact_velocity, noise.contact_tangential)
    return np.array([noise.acceleration, noise.spin, noise.contact_velocity, along, noise.contact_spin])
