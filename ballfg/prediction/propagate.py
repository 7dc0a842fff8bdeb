"""Propagates a belief: mean and covariance through flight, contacts and rest, with process noise.

The mean is the rollout of the mean. The covariance uses the derivative of that rollout, including the contact times.
Near a contact of uncertain time the reported mean and covariance include the balls on both sides of it
(docs/derivations/prediction.md).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from ballfg.arrays import Array
from ballfg.deferred import torch
from ballfg.dynamics.compiled.beliefs.course import Carrier, Course, density_of
from ballfg.dynamics.compiled.beliefs.edges import share_over_table
from ballfg.dynamics.compiled.motion import world_of
from ballfg.dynamics.motion.arrays import advance_jacobian
from ballfg.dynamics.motion.limits import LONGEST_MOTION, NEGLIGIBLE, steps_over_each
from ballfg.dynamics.surfaces import Surfaces
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.belief import Belief
from ballfg.state import POSITION, STATE_DIM, VZ

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    from torch import Tensor

    from ballfg.dynamics.model import BallModel

AT_ONCE = 128
"""Largest number of steps of free flight in one call of machine code: more would waste memory on covariances."""


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

    def rollout(self, belief: Belief, times: ArrayLike | Tensor) -> Prediction:
        """The states at given times.

        Args:
            belief: n balls.
            times: (n, k) s on each ball's clock, or (k,) for all; not decreasing, not before the belief.
        Raises: ValueError: if the shape is another, or a time lies before the one before it.
        """
        stamps = torch.as_tensor(times, dtype=torch.float64)
        if stamps.dim() == 1:
            stamps = stamps.expand(len(belief), -1)
        course = Course.joined([part for part, _ in self._mixed(belief, stamps)])
        states = course.mean[:, :, :STATE_DIM].swapaxes(0, 1).copy()
        covariances = course.covariance[:, :, :STATE_DIM, :STATE_DIM].swapaxes(0, 1).copy()
        return Prediction(stamps.numpy().copy(), states, covariances)

    def walk(self, belief: Belief, times: Tensor) -> Iterator[Belief]:
        """The beliefs at given times (n, k) s, one after the other.

        Near a contact of uncertain time a belief is the mean and covariance of the balls on both sides of it. Start a
        later prediction from `forward` instead: it stays on the mean's side, as the propagation needs.

        Raises: ValueError: as `rollout`.
        """
        for part, elapsed in self._mixed(belief, times):
            yield from _beliefs(belief, part, elapsed)

    def forward(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s, on the mean's side of every contact.

        Raises: ValueError: if a dt is negative, infinite or not a number.
        """
        ((part, elapsed),) = self._over(self._carrier(belief), belief, dt[:, None])
        return next(_beliefs(belief, part, elapsed))

    def search(
        self,
        belief: Belief,
        horizon: float,
        earliest: float,
        line: tuple[Array, float] | None = None,
        *,
        either_way: bool = False,
    ) -> tuple[float, Belief, Array, Array]:
        """Searches for an event on the way of one ball, through flight and plain bounces.

        Args:
            belief: of the ball.
            horizon, earliest: s from the belief's time; only events up to the one and after the other count.
            line: (9,) and an offset: the event is that normal . state falls through it. None: the next contact.
            either_way: count a rise through the offset as well.

        Returns: `events.NONE`, `FOUND`, or `HARD` before a landing, several bounces, or a bounce at a table's edge; the
            belief there, (9 + p,) the event's gradient, and (9 + p,) 1/s, the state's rate of change.
        """
        start = Course.start(belief.mean.detach().numpy(), belief.covariance.detach().numpy())
        carrier = self._carrier(belief)
        end, elapsed, course, rate = carrier.find(start, horizon, earliest, line, either_way=either_way)
        (there,) = _beliefs(belief, course, torch.tensor([[elapsed]], dtype=torch.float64))
        return end, there, carrier.gradient(course.mean[-1, 0], line), rate

    def _carrier(self, belief: Belief) -> Carrier:
        return Carrier(belief.model, belief.mean.detach().numpy(), self.surfaces, density_of(self.noise))

    def _mixed(self, belief: Belief, times: Tensor) -> Iterator[tuple[Course, Tensor]]:
        """Beliefs at given times (n, k) s, mixed near contacts, a few at a time, with the elapsed time."""
        if times.dim() != 2 or len(times) != len(belief) or times.shape[1] == 0:
            raise ValueError(f"times must have shape ({len(belief)}, k) with k >= 1; got {tuple(times.shape)}")
        durations = torch.diff(times, dim=-1, prepend=belief.time[:, None])
        if not bool((durations >= 0).all()):
            raise ValueError("times must not decrease and must not lie before the belief's time. Sort them.")
        carrier = self._carrier(belief)
        for part, elapsed in self._over(carrier, belief, durations):
            yield carrier.mixed(part), elapsed

    def _over(self, carrier: Carrier, belief: Belief, durations: Tensor) -> Iterator[tuple[Course, Tensor]]:
        """Linear beliefs after some durations (n, k) s, a few at a time, with the elapsed time (n, j) s."""
        given = durations.numpy()
        if not ((given >= 0.0) & np.isfinite(given)).all():
            raise ValueError(f"dt must be finite and not negative; got {given.min():g} to {given.max():g} s")
        moving = np.minimum(given, LONGEST_MOTION)
        staying, elapsed = given - moving, durations.cumsum(1)
        course, first = Course.start(belief.mean.detach().numpy(), belief.covariance.detach().numpy()), 0
        for last in sorted({*np.flatnonzero((staying > 0.0).any(0)).tolist(), durations.shape[1] - 1}):
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
            before = (array[k - 1, r : r + 1].copy() for array in (course.mean, course.covariance))
            mean, covariance = map(torch.from_numpy, before)
            touched, height = self._touch(model, mean, covariance, float(h[r, k - 1]))
            course.mean[k, r], course.covariance[k, r] = touched
            course.level[k, r], course.age[k, r] = height, 0.0 if np.isfinite(height) else np.nan
        return course.at(slice(1, None))

    def _touch(self, model: BallModel, mean: Tensor, covariance: Tensor, h: float) -> tuple[tuple[Array, Array], float]:
        """Mean and covariance after a step of h s of a ball (1, d) that reaches a surface's level.

        It also returns the height (m) of the surface of a single bounce, else NaN.
        """
        dt = torch.tensor([h], dtype=torch.float64)
        motion = advance_jacobian(model, mean[0].numpy(), h, self.surfaces)
        jacobian = torch.from_numpy(motion.jacobian)
        noise = torch.from_numpy(self.noise.flight(dt.numpy()))
        if motion.contacts:
            times = mean.new_tensor([[time for time, _ in motion.contacts]])
            noise = self._bounce_noise(model, mean, dt, times, jacobian[None])
        noise = noise + _edge_doubt(model, mean, covariance, dt, self.surfaces)
        spread = _carried(jacobian, covariance, noise)
        height = motion.contacts[0][1] if len(motion.contacts) == 1 else math.nan
        return (motion.after, spread[0].numpy()), height

    def in_flight(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s of free flight, without surfaces."""
        from ballfg.dynamics.motion.integrate import fly_jacobian

        after, jacobian = fly_jacobian(belief.model, belief.mean, dt)
        noise = torch.from_numpy(self.noise.flight(dt.numpy()))
        return replace(
            belief, time=belief.time + dt, mean=after, covariance=_carried(jacobian, belief.covariance, noise)
        )

    def _bounce_noise(self, model: BallModel, mean: Tensor, h: Tensor, times: Tensor, jacobian: Tensor) -> Tensor:
        """(n, 9, 9) covariance gathered in a step with impacts at times (n, k).

        The flight's noise before the first impact goes through it; each impact adds its own.
        """
        from ballfg.dynamics.motion.integrate import fly_jacobian

        first = times[:, 0].clamp(torch.zeros_like(h), h)
        _, flight = fly_jacobian(model, mean, first)
        onward = torch.linalg.solve(flight.mT, jacobian.mT).mT[:, :STATE_DIM, :STATE_DIM]  # from the impact to the end
        before = torch.from_numpy(self.noise.flight(first.numpy()))
        noise = onward @ before @ onward.mT + torch.from_numpy(self.noise.flight((h - first).numpy()))
        for time in times.unbind(-1):
            noise += torch.from_numpy(self.noise.contact(h.numpy(), time.numpy()))
        return noise


def _beliefs(start: Belief, course: Course, elapsed: Tensor) -> Iterator[Belief]:
    """The beliefs of a course, each after the time (n, k) s since the start in one column."""
    for k in range(len(course)):
        mean, covariance = torch.from_numpy(course.mean[k]), torch.from_numpy(course.covariance[k])
        yield Belief(start.model, start.time + elapsed[:, k], mean, covariance)


def _carried(jacobian: Tensor, covariance: Tensor, noise: Tensor) -> Tensor:
    after = jacobian @ covariance @ jacobian.transpose(-1, -2)
    after[:, :STATE_DIM, :STATE_DIM] += noise
    return (after + after.transpose(-1, -2)) / 2  # rounding would add up


def _edge_doubt(model: BallModel, mean: Tensor, covariance: Tensor, h: Tensor, surfaces: Surfaces) -> Tensor | float:
    """Covariance at the end of a step from the balls that take the other way than the mean.

    Near the edge of a table one ball bounces and its neighbour within the uncertainty falls past. The mean takes one of
    the two ways; the covariance gets the second moment, about the mean, of the share that takes the other.

    Args:
        mean: (1, d) state at the start of the step.  covariance: (1, d, d) of it.
        h: (1,) s, the step; at most one contact with the table.
    Returns: (9, 9); 0 if the ball does not come down to the table's level in the step, or far from every edge.
    """
    from ballfg.dynamics.motion.contact import contact_time
    from ballfg.dynamics.motion.integrate import fly
    from ballfg.dynamics.motion.rollout import advance

    with torch.no_grad():
        height = mean.new_tensor([surfaces.table_height])
        beside = fly(model, mean, h)
        if surfaces.extent is None or not float(model.gap(mean, height)) >= 0.0 > float(model.gap(beside, height)):
            return 0.0
        touch = fly(model, mean, contact_time(model, mean, height))
        if not float(touch[0, VZ]) < 0.0:
            return 0.0
        over = share_over_table(touch[0].numpy(), covariance[0].numpy(), world_of(surfaces, model.radius))
        other = 1.0 - over if bool(surfaces.over_table(touch)) else over
        if other < NEGLIGIBLE:
            return 0.0
        difference = (advance(model, mean, h, replace(surfaces, extent=None)) - beside)[0, :STATE_DIM]
        return other * torch.outer(difference, difference)
