"""Propagation of a belief: mean and covariance through flight, contacts and rest, with process noise.

The mean is the rollout of the mean. The covariance goes through the derivative of that rollout, contact times included.
Near a contact of uncertain time the reported mean and covariance are those of the balls on both sides of it
(docs/derivations/prediction.md).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.compiled.motion import fly_beliefs, functions_of
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.advance_jacobian import advance_jacobian
from ballfg.dynamics.motion.integrate import fly_jacobian
from ballfg.dynamics.motion.limits import BEYOND, MAX_STEP
from ballfg.dynamics.motion.rollout import LONGEST_MOTION, is_resting
from ballfg.dynamics.surfaces import Surfaces
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.belief import Belief
from ballfg.prediction.edges import edge_doubt
from ballfg.prediction.near_contact import Unbounced, spread_over_contacts
from ballfg.state import STATE_DIM, VZ

AT_ONCE = 64
"""Steps of free flight that machine code does before anyone looks: more would keep covariances that nobody needs."""


@dataclass(frozen=True)
class Prediction:
    """Future states. Near a contact, means and covariances of the balls that have bounced and of those that have not.

    Attributes:
        times: (n, k) s, on each track's clock.
        states: (n, k, 9) position m, velocity m/s, spin rad/s.
        covariances: (n, k, 9, 9) of the states, in the products of those units; without measurement noise.
    """

    times: Array
    states: Array
    covariances: Array


@dataclass(frozen=True)
class Propagator:
    """Carries beliefs forward in time.

    Attributes:
        surfaces: what the ball may bounce on.
        noise: how far it strays from its model.
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
        carried, unbounced = zip(*self._carried(belief, stamps), strict=True)
        # one batch over all stamps: what a call costs hardly depends on its number of balls
        late = [replace(u, rows=u.rows + len(belief) * k) for k, u in enumerate(unbounced)]
        spread = spread_over_contacts(Belief.joined(carried), Unbounced.joined(late), self.surfaces, self.noise)
        shape = (stamps.shape[1], len(belief))
        states = spread.mean[:, :STATE_DIM].unflatten(0, shape).transpose(0, 1)
        covariances = spread.covariance[:, :STATE_DIM, :STATE_DIM].unflatten(0, shape).transpose(0, 1)
        return Prediction(stamps.numpy().copy(), states.detach().numpy().copy(), covariances.detach().numpy().copy())

    def walk(self, belief: Belief, times: Tensor) -> Iterator[Belief]:
        """The beliefs at given times (n, k) s, one after the other.

        Near a contact of uncertain time a belief is the mean and covariance of the balls on both sides of it. Start a
        later prediction from `forward` instead: it keeps to the mean's side, as the propagation needs it.

        Raises: ValueError: as `rollout`.
        """
        for carried, unbounced in self._carried(belief, times):
            yield spread_over_contacts(carried, unbounced, self.surfaces, self.noise)

    def _carried(self, belief: Belief, times: Tensor) -> Iterator[tuple[Belief, Unbounced]]:
        """Linear beliefs at given times (n, k) s, and the balls of which some may not have bounced by then."""
        if times.dim() != 2 or len(times) != len(belief) or times.shape[1] == 0:
            raise ValueError(f"times must have shape ({len(belief)}, k) with k >= 1; got {tuple(times.shape)}")
        steps = torch.diff(times, dim=-1, prepend=belief.time[:, None])
        if not bool((steps >= 0).all()):
            raise ValueError("times must not decrease and must not lie before the belief's time. Sort them.")
        return self._over(belief, steps)

    def forward(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s, on the mean's side of every contact.

        Raises: ValueError: if a dt is negative, infinite or not a number.
        """
        ((after, _),) = self._over(belief, dt[:, None])
        return after

    def _over(self, belief: Belief, durations: Tensor) -> Iterator[tuple[Belief, Unbounced]]:
        """Linear beliefs after each of some durations (n, k) s, and the balls of which some may not have bounced."""
        if not bool(((durations >= 0) & durations.isfinite()).all()):
            low, high = float(durations.min()), float(durations.max())
            raise ValueError(f"dt must be finite and not negative; got {low:g} to {high:g} s")
        moving = durations.clamp_max(LONGEST_MOTION)
        staying = durations - moving
        unbounced, first = _no_ball_of(belief), 0
        for last in (*(staying > 0).any(0).nonzero()[:, 0].tolist(), durations.shape[1] - 1):
            counts = (moving[:, first : last + 1].amax(0) / MAX_STEP - 1e-9).ceil().clamp_min(1).long()
            steps = (moving[:, first : last + 1] / counts).repeat_interleave(counts, dim=1)
            wanted = {0, *counts.cumsum(0).tolist()}
            for number, moved in enumerate(self._steps(belief, unbounced, steps), 1):
                belief, unbounced = moved
                if number == steps.shape[1] and bool((staying[:, last] > 0).any()):
                    belief, unbounced = self._stay(belief, staying[:, last]), _no_ball_of(belief)
                if number in wanted:
                    yield belief, unbounced
            first = last + 1

    def _stay(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s in which nothing moves."""
        eye = torch.eye(belief.mean.shape[-1], dtype=dt.dtype)
        return _moved(belief, dt, belief.mean, eye, torch.from_numpy(self.noise.flight(dt.numpy())))

    def _steps(self, belief: Belief, unbounced: Unbounced, h: Tensor) -> Iterator[tuple[Belief, Unbounced]]:
        """Linear beliefs and unbounced balls after each of some steps h (n, k) s of at most `MAX_STEP`."""
        done = 0
        while done < h.shape[1]:
            flown = self._flights(belief, unbounced, h[:, done:]) or [self._step(belief, h[:, done], unbounced)]
            yield from flown
            (belief, unbounced), done = flown[-1], done + len(flown)

    def flights(self, belief: Belief, h: Tensor) -> list[Belief]:
        """The beliefs after each step of free flight, as far as no ball comes down on a surface or rests.

        Args: belief: of n balls.  h: (n, k) s, steps of at most `MAX_STEP`.
        Returns: none at all where the model has no machine code.
        """
        return [after for after, _ in self._flights(belief, _no_ball_of(belief), h)]

    def _flights(self, belief: Belief, unbounced: Unbounced, h: Tensor) -> list[tuple[Belief, Unbounced]]:
        """As `flights`, as long as the same unbounced balls are followed too; at most `AT_ONCE` steps."""
        if functions_of(belief.model) is None:
            return []
        n, h = len(belief), h[:, :AT_ONCE]
        if len(unbounced.rows):
            later = unbounced.belief.time + h[unbounced.rows, 0] - unbounced.since
            unbounced = unbounced.take(later < BEYOND)
        everyone = Belief.joined([belief, unbounced.belief])
        steps = torch.cat((h, h[unbounced.rows]))
        times = everyone.time[:, None] + steps.cumsum(1)
        recent = (times[n:] - unbounced.since[:, None] < BEYOND).all(0)
        steps = steps[:, : int(recent.long().cumprod(0).sum())]
        levels = (self.surfaces.table_height, self.surfaces.lowest())
        densities = (self.noise.acceleration, self.noise.spin)
        given = (everyone.mean.numpy(), everyone.covariance.numpy(), steps.numpy())
        flown = []
        for k, (mean, covariance) in enumerate(
            zip(*fly_beliefs(belief.model, *given, n, levels, densities), strict=True)
        ):
            after = Belief(belief.model, times[:n, k], mean[:n], covariance[:n])
            beside = Belief(belief.model, times[n:, k], mean[n:], covariance[n:])
            flown.append((after, replace(unbounced, belief=beside)))
        return flown

    def in_flight(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s of free flight; surfaces are not there."""
        after, jacobian = fly_jacobian(belief.model, belief.mean, dt)
        return _moved(belief, dt, after, jacobian, torch.from_numpy(self.noise.flight(dt.numpy())))

    def _step(self, belief: Belief, h: Tensor, unbounced: Unbounced) -> tuple[Belief, Unbounced]:
        """One step of at most `MAX_STEP`; the unbounced balls fly on along with it."""
        model, mean, n = belief.model, belief.mean, len(belief)
        level = self.surfaces.level_below(mean)
        everyone = Belief.joined([belief, unbounced.belief]) if len(unbounced.rows) else belief
        flown = self.in_flight(everyone, torch.cat((h, h[unbounced.rows])))
        after, unbounced = flown.take(slice(n)), replace(unbounced, belief=flown.take(slice(n, None))).recent()
        with torch.no_grad():
            falls_below = (model.gap(after.mean, level) < 0) & (after.mean[:, VZ] < 0)
            touching = is_resting(model, mean, level) | falls_below
        rows = touching.nonzero()[:, 0]
        if not len(rows):
            return after, unbounced
        touched, heights = self._touch(belief.take(rows), h[rows])
        bounced = heights.isfinite()
        unbounced = unbounced.followed_by(Unbounced.just_now(after, rows[bounced], heights[bounced]))
        mean, covariance = after.mean.clone(), after.covariance.clone()
        mean[rows], covariance[rows] = touched.mean, touched.covariance
        return replace(after, mean=mean, covariance=covariance), unbounced

    def _touch(self, belief: Belief, h: Tensor) -> tuple[Belief, Tensor]:
        """Balls that reach a surface's level, or rest, within a step; and (n,) m the surface that a ball bounced on.

        NaN for a ball that did not bounce, or more than once.
        """
        model, mean = belief.model, belief.mean
        after, jacobian = torch.empty_like(mean), mean.new_empty((*mean.shape, mean.shape[-1]))
        noise, heights = torch.from_numpy(self.noise.flight(h.numpy())), torch.full_like(h, torch.nan)
        for i in range(len(mean)):
            row = slice(i, i + 1)
            motion = advance_jacobian(model, mean[row], float(h[i]), self.surfaces)
            after[row], jacobian[i] = motion.after, motion.jacobian
            if motion.contacts:
                times = mean.new_tensor([[time for time, _ in motion.contacts]])
                noise[row] = self._bounce_noise(model, mean[row], h[row], times, jacobian[row])
            noise[row] += edge_doubt(model, mean[row], belief.covariance[row], h[row], self.surfaces)
            if len(motion.contacts) == 1:
                heights[row] = motion.contacts[0][1]
        return _moved(belief, h, after, jacobian, noise), heights

    def _bounce_noise(self, model: BallModel, mean: Tensor, h: Tensor, times: Tensor, jacobian: Tensor) -> Tensor:
        """(n, 9, 9) covariance gathered in a step with impacts at times (n, k).

        What the flight gathers before the first impact goes through it; each impact adds its own.
        """
        first = times[:, 0].clamp(torch.zeros_like(h), h)
        _, flight = fly_jacobian(model, mean, first)
        onward = torch.linalg.solve(flight.mT, jacobian.mT).mT[:, :STATE_DIM, :STATE_DIM]  # from the impact to the end
        before = torch.from_numpy(self.noise.flight(first.numpy()))
        noise = onward @ before @ onward.mT + torch.from_numpy(self.noise.flight((h - first).numpy()))
        for time in times.unbind(-1):
            noise += torch.from_numpy(self.noise.contact(h.numpy(), time.numpy()))
        return noise


def _no_ball_of(belief: Belief) -> Unbounced:
    nothing = torch.zeros(0, dtype=torch.long)
    return Unbounced.just_now(belief, nothing, belief.time[nothing])


def _moved(belief: Belief, h: Tensor, after: Tensor, jacobian: Tensor, noise: Tensor) -> Belief:
    covariance = jacobian @ belief.covariance @ jacobian.transpose(-1, -2)
    covariance[:, :STATE_DIM, :STATE_DIM] += noise
    covariance = (covariance + covariance.transpose(-1, -2)) / 2  # rounding would add up
    return replace(belief, time=belief.time + h, mean=after, covariance=covariance)
