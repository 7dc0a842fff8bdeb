"""Propagates a belief: mean and covariance through flight, contacts and rest, with process noise.

The mean is the rollout of the mean. The covariance uses the derivative of that rollout, including the contact times.
Near a contact of uncertain time the reported mean and covariance include the balls on both sides of it
(docs/derivations/prediction.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array
from ballfg.dynamics.compiled.beliefs.course import Carrier, Course, Flown, Found, density_of
from ballfg.dynamics.compiled.beliefs.edges import share_over_table
from ballfg.dynamics.compiled.motion import world_of
from ballfg.dynamics.motion import arrays
from ballfg.dynamics.motion.arrays import advance_jacobian
from ballfg.dynamics.motion.limits import LONGEST_MOTION, NEGLIGIBLE, steps_over_each
from ballfg.dynamics.surfaces import Surfaces
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.belief import Belief
from ballfg.state import POSITION, STATE_DIM, VZ

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ballfg.dynamics.model import BallModel

AT_ONCE = 128
"""Largest number of steps of free flight in one call of machine code, or kept for searches: more would waste memory."""


@dataclass(frozen=True)
class Prediction:
    """Future states. Near a contact they include the balls that have bounced and those that have not.

    Attributes:
        times: (n, k) s, on each track's clock.  states: (n, k, 9) position m, velocity m/s, spin rad/s.
        covariances: (n, k, 9, 9) of the states, in the products of those units; without measurement noise.
    """

    times: Array
    states: Array
    covariances: Array

    def plot(self, ball: int = 0) -> Figure:
        """A picture of x, y and z of one ball over time, each with the band that holds 90 %.

        Args: ball: index of the ball.
        """
        from ballfg.pages.pictures import by_axis
        from ballfg.pages.shot import ShownShot

        sigmas = np.sqrt(np.diagonal(self.covariances[ball], axis1=1, axis2=2)[:, POSITION])
        places = self.states[ball][:, POSITION]
        return by_axis(
            ShownShot(str(ball), predicted_times=self.times[ball], predicted=places, predicted_sigmas=sigmas)
        )


@dataclass(frozen=True)
class Propagator:
    """Carries beliefs forward in time.

    Attributes:
        surfaces: table and floor.
        noise: process noise of the motion.
    """

    surfaces: Surfaces
    noise: ProcessNoise

    def rollout(self, belief: Belief, times: ArrayLike) -> Prediction:
        """The states at given times.

        Args:
            belief: n balls.
            times: (n, k) s on each ball's clock, or (k,) for all; not decreasing, not before the belief.
        Raises: ValueError: if the shape is another, or a time lies before the one before it.
        """
        stamps = np.asarray(times, dtype=np.float64)
        if stamps.ndim == 1:
            stamps = np.tile(stamps, (len(belief), 1))
        course = Course.joined([part for part, _ in self._mixed(belief, stamps)])
        states = course.mean[:, :, :STATE_DIM].swapaxes(0, 1).copy()
        covariances = course.covariance[:, :, :STATE_DIM, :STATE_DIM].swapaxes(0, 1).copy()
        return Prediction(stamps.copy(), states, covariances)

    def walk(self, belief: Belief, times: ArrayLike) -> Iterator[Belief]:
        """The beliefs at given times (n, k) s, one after the other.

        Near a contact of uncertain time a belief is the mean and covariance of the balls on both sides of it. Start a
        later prediction from `forward` instead: it stays on the mean's side, as the propagation needs.

        Raises: ValueError: as `rollout`.
        """
        for part, elapsed in self._mixed(belief, np.asarray(times, dtype=np.float64)):
            yield from _beliefs(belief, part, elapsed)

    def forward(self, belief: Belief, dt: ArrayLike) -> Belief:
        """The belief after dt (n,) s, on the mean's side of every contact.

        Raises: ValueError: if a dt is negative, infinite or not a number.
        """
        ((part, elapsed),) = self._over(self._carrier(belief), belief, np.asarray(dt, dtype=np.float64)[:, None])
        return next(_beliefs(belief, part, elapsed))

    def search(
        self,
        belief: Belief,
        horizon: float,
        earliest: float,
        line: tuple[Array, float] | None = None,
        *,
        either_way: bool = False,
    ) -> Found:
        """Searches for an event on the way of one ball, through flight and plain bounces.

        Args:
            belief: of the ball.
            horizon, earliest: s from the belief's time; only events up to the one and after the other count.
            line: (9,) and an offset: the event is that normal . state falls through it. None: the next contact.
            either_way: count a rise through the offset as well.
        """
        carrier, flown = self._known_from(belief)
        return carrier.find(belief.mean[0], belief.covariance[0], horizon, earliest, line, either_way, flown)

    def _known_from(self, belief: Belief) -> tuple[Carrier, Flown | None]:
        """What a search from a belief may use: the laws of its motion, and what has been flown already."""
        return self._carrier(belief), None

    def _carrier(self, belief: Belief) -> Carrier:
        return Carrier(belief.model, belief.mean, self.surfaces, density_of(self.noise))

    def _mixed(self, belief: Belief, times: Array) -> Iterator[tuple[Course, Array]]:
        """Beliefs at given times (n, k) s, mixed near contacts, a few at a time, with the elapsed time."""
        if times.ndim != 2 or len(times) != len(belief) or times.shape[1] == 0:
            raise ValueError(f"times must have shape ({len(belief)}, k) with k >= 1; got {times.shape}")
        durations = np.diff(times, prepend=belief.time[:, None])
        if not (durations >= 0.0).all():
            raise ValueError("times must not decrease and must not lie before the belief's time. Sort them.")
        flying = belief if belief.struck is None else replace(belief, covariance=belief.covariance - belief.struck)
        carrier = self._carrier(flying)
        for part, elapsed in self._over(carrier, flying, durations):
            found = carrier.mixed(part)
            yield found if belief.struck is None else _with_struck(found, belief.struck, elapsed), elapsed

    def _over(self, carrier: Carrier, belief: Belief, given: Array) -> Iterator[tuple[Course, Array]]:
        """Linear beliefs after some durations (n, k) s, a few at a time, with the elapsed time (n, j) s."""
        if not ((given >= 0.0) & np.isfinite(given)).all():
            raise ValueError(f"dt must be finite and not negative; got {given.min():g} to {given.max():g} s")
        moving = np.minimum(given, LONGEST_MOTION)
        staying, elapsed = given - moving, given.cumsum(axis=1)
        course, first = Course.start(belief.mean, belief.covariance), 0
        for last in sorted({*np.flatnonzero((staying > 0.0).any(0)).tolist(), given.shape[1] - 1}):
            part = moving[:, first : last + 1]
            counts = steps_over_each(part.max(0))
            steps, ends = np.repeat(part / counts, counts, axis=1), counts.cumsum()
            done = 0
            while done < steps.shape[1]:
                flown = self._steps(carrier, belief.model, course, steps[:, done : done + AT_ONCE])
                course = flown.at(slice(-1, None))
                asked = (done < ends) & (ends <= done + len(flown))
                if (staying[:, last] > 0.0).any() and done + len(flown) == steps.shape[1]:
                    covariance = course.covariance[-1].copy()
                    covariance[:, :STATE_DIM, :STATE_DIM] += self.noise.flight(staying[:, last])
                    course = Course.start(course.mean[-1], covariance)
                    flown = Course.joined([flown.at(slice(-1)), course])
                if asked.any():
                    columns = first + asked.nonzero()[0]
                    yield flown.at(ends[asked] - done - 1), elapsed[:, columns]
                done += len(flown)
            first = last + 1

    def _steps(self, carrier: Carrier, model: BallModel, start: Course, h: Array) -> Course:
        """The beliefs after one or more of some steps h (n, k) s of at most `MAX_STEP`."""
        course, hard = carrier.carry(start, h)
        rows, k = hard.nonzero()[0], len(course) - 1
        for r in rows:
            before = course.mean[k - 1, r].copy(), course.covariance[k - 1, r].copy()
            course.mean[k, r], course.covariance[k, r], height = self._touch(model, *before, float(h[r, k - 1]))
            course.level[k, r], course.age[k, r] = height, 0.0 if np.isfinite(height) else np.nan
        return course.at(slice(1, None))

    def _touch(self, model: BallModel, mean: Array, covariance: Array, h: float) -> tuple[Array, Array, float]:
        """Mean (d,) and covariance (d, d) after a step of h s of a ball that reaches a surface's level.

        It also returns the height (m) of the surface of a single bounce, else NaN.
        """
        motion = advance_jacobian(model, mean, h, self.surfaces)
        noise = self._flight_noise(h)
        if motion.contacts:
            noise = self._bounce_noise(model, mean, h, [time for time, _ in motion.contacts], motion.jacobian)
        noise = noise + _edge_doubt(model, mean, covariance, h, self.surfaces)
        height = motion.contacts[0][1] if len(motion.contacts) == 1 else math.nan
        return motion.after, _carried(motion.jacobian, covariance, noise), height

    def in_flight(self, belief: Belief, dt: Array) -> Belief:
        """The belief after dt (n,) s of free flight, without surfaces."""
        after, jacobian = arrays.fly_jacobian(belief.model, belief.mean, dt)
        covariance = _carried(jacobian, belief.covariance, self.noise.flight(dt))
        return Belief(belief.model, belief.time + dt, after, covariance)

    def _bounce_noise(self, model: BallModel, mean: Array, h: float, times: Sequence[float], jacobian: Array) -> Array:
        """(9, 9) covariance gathered in a step of h s with impacts at some times, s.

        The flight's noise before the first impact goes through it; each impact adds its own.
        """
        first = min(max(times[0], 0.0), h)
        _, flight = arrays.fly_jacobian(model, mean[None], np.array([first]))
        onward = np.linalg.solve(flight[0].T, jacobian.T).T[:STATE_DIM, :STATE_DIM]  # from the impact to the end
        noise = onward @ self._flight_noise(first) @ onward.T + self._flight_noise(h - first)
        for time in times:
            noise += self.noise.contact(np.array([h]), np.array([time]))[0]
        return np.asarray(noise)

    def _flight_noise(self, dt: float) -> Array:
        """(9, 9) covariance gathered in dt s of free flight."""
        return self.noise.flight(np.array([dt]))[0]


@dataclass(frozen=True)
class FlownOnce(Propagator):
    """A propagator that flies the way of one ball once, for all searches of events on it.

    Attributes: start: the belief from which that way begins; searches from others fly anew.
    """

    start: Belief

    @cached_property
    def flown(self) -> Flown:
        """The steps of the way that have been flown so far."""
        return Flown.empty(self.start.mean.shape[1], AT_ONCE)

    @cached_property
    def _from_start(self) -> Carrier:
        return self._carrier(self.start)

    def _known_from(self, belief: Belief) -> tuple[Carrier, Flown | None]:
        if belief.mean is self.start.mean and belief.covariance is self.start.covariance:
            return self._from_start, self.flown
        return super()._known_from(belief)


def _beliefs(start: Belief, course: Course, elapsed: Array) -> Iterator[Belief]:
    """The beliefs of a course, each after the time (n, k) s since the start in one column."""
    for k in range(len(course)):
        yield Belief(start.model, start.time + elapsed[:, k], course.mean[k], course.covariance[k])


def _with_struck(course: Course, struck: Array, elapsed: Array) -> Course:
    """The course with the covariance of balls that were hit just before its start.

    Nothing is known of where they fly: their mean through drag and bounces would be no path of a ball. So the mean is
    that of the others, and what is straight of a flight carries the covariance.

    Args: struck: (n, d, d) at the start.  elapsed: (n, k) s since then.
    """
    onward = np.tile(np.eye(struck.shape[-1]), (len(course), len(struck), 1, 1))
    onward[..., range(3), range(3, 6)] = elapsed.T[..., None]  # the position by the velocity
    return replace(course, covariance=course.covariance + onward @ struck @ onward.swapaxes(-1, -2))


def _carried(jacobian: Array, covariance: Array, noise: Array) -> Array:
    after = jacobian @ covariance @ jacobian.swapaxes(-1, -2)
    after[..., :STATE_DIM, :STATE_DIM] += noise
    return np.asarray((after + after.swapaxes(-1, -2)) / 2)  # rounding would add up


def _edge_doubt(model: BallModel, mean: Array, covariance: Array, h: float, surfaces: Surfaces) -> Array | float:
    """Covariance at the end of a step from the balls that take the other way than the mean.

    Near the edge of a table one ball bounces and its neighbour within the uncertainty falls past. The mean takes one of
    the two ways; the covariance gets the second moment, about the mean, of the share that takes the other.

    Args:
        mean: (d,) state at the start of the step.  covariance: (d, d) of it.
        h: s, the step; at most one contact with the table.
    Returns: (9, 9); 0 if the ball does not come down to the table's level in the step, or far from every edge.
    """
    start, dt, height = mean[None], np.array([h]), surfaces.table_height
    if surfaces.extent is None:
        return 0.0
    beside = arrays.fly(model, start, dt)
    if not arrays.gaps(model, start, height)[0] >= 0.0 > arrays.gaps(model, beside, height)[0]:
        return 0.0
    touch = arrays.fly(model, start, arrays.contact_times(model, start, height))[0]
    if not touch[VZ] < 0.0:
        return 0.0
    over = share_over_table(touch, covariance, world_of(surfaces, model.radius))
    other = 1.0 - over if bool(surfaces.over_table(touch)) else over
    if other < NEGLIGIBLE:
        return 0.0
    bounced = arrays.roll_out(model, start, dt[:, None], replace(surfaces, extent=None))[0, 0]
    difference = (bounced - beside[0])[:STATE_DIM]
    return np.asarray(other * np.outer(difference, difference))
