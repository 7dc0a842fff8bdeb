"""Propagation of a belief: mean and covariance through flight, contacts and rest, with process noise.

The mean is the rollout of the mean. The covariance goes through the derivative of that rollout, contact times included
(docs/derivations/prediction.md).
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.advance_jacobian import advance_jacobian
from ballfg.dynamics.motion.integrate import fly_jacobian, step_count
from ballfg.dynamics.motion.rollout import LONGEST_MOTION, is_resting
from ballfg.dynamics.surfaces import Surfaces
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.belief import Belief
from ballfg.prediction.edges import edge_doubt
from ballfg.state import STATE_DIM, VZ


@dataclass(frozen=True)
class Prediction:
    """Future states.

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
        states, covariances = [], []
        for later in self.walk(belief, stamps):
            states.append(later.mean[:, :STATE_DIM].detach().numpy())
            covariances.append(later.covariance[:, :STATE_DIM, :STATE_DIM].detach().numpy())
        return Prediction(stamps.numpy().copy(), np.stack(states, axis=1), np.stack(covariances, axis=1))

    def walk(self, belief: Belief, times: Tensor) -> Iterator[Belief]:
        """The beliefs at given times (n, k) s, one after the other.

        Raises: ValueError: as `rollout`.
        """
        if times.dim() != 2 or len(times) != len(belief) or times.shape[1] == 0:
            raise ValueError(f"times must have shape ({len(belief)}, k) with k >= 1; got {tuple(times.shape)}")
        steps = torch.diff(times, dim=-1, prepend=belief.time[:, None])
        if not bool((steps >= 0).all()):
            raise ValueError("times must not decrease and must not lie before the belief's time. Sort them.")
        for dt in steps.unbind(-1):
            belief = self.forward(belief, dt)
            yield belief

    def forward(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s.

        Raises: ValueError: if a dt is negative, infinite or not a number.
        """
        if not bool(((dt >= 0) & dt.isfinite()).all()):
            raise ValueError(f"dt must be finite and not negative; got {float(dt.min()):g} to {float(dt.max()):g} s")
        moving = dt.clamp_max(LONGEST_MOTION)
        count = step_count(moving)
        for _ in range(count):
            belief = self._step(belief, moving / count)
        staying = dt - moving
        if not bool((staying > 0).any()):
            return belief
        noise = torch.from_numpy(self.noise.flight(staying.numpy()))
        return _moved(belief, staying, belief.mean, torch.eye(belief.mean.shape[-1], dtype=dt.dtype), noise)

    def in_flight(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s of free flight; surfaces are not there."""
        after, jacobian = fly_jacobian(belief.model, belief.mean, dt)
        return _moved(belief, dt, after, jacobian, torch.from_numpy(self.noise.flight(dt.numpy())))

    def _step(self, belief: Belief, h: Tensor) -> Belief:
        """One step of at most `MAX_STEP`."""
        model, mean = belief.model, belief.mean
        level = self.surfaces.level_below(mean)
        after, jacobian = fly_jacobian(model, mean, h)
        noise = torch.from_numpy(self.noise.flight(h.numpy()))
        with torch.no_grad():
            touching = is_resting(model, mean, level) | ((model.gap(after, level) < 0) & (after[:, VZ] < 0))
        rows = touching.nonzero()[:, 0]
        if len(rows):
            after[rows], jacobian[rows], noise[rows] = self._touch(model, mean[rows], belief.covariance[rows], h[rows])
        return _moved(belief, h, after, jacobian, noise)

    def _touch(self, model: BallModel, mean: Tensor, covariance: Tensor, h: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, Jacobian and noise of balls that reach a surface's level, or rest, within a step."""
        after, jacobian = torch.empty_like(mean), mean.new_empty((*mean.shape, mean.shape[-1]))
        noise = torch.from_numpy(self.noise.flight(h.numpy()))
        for i in range(len(mean)):
            row = slice(i, i + 1)
            motion = advance_jacobian(model, mean[row], float(h[i]), self.surfaces)
            after[row], jacobian[i] = motion.after, motion.jacobian
            if motion.contacts:
                times = mean.new_tensor([[time for time, _ in motion.contacts]])
                noise[row] = self._bounce_noise(model, mean[row], h[row], times, jacobian[row])
            noise[row] += edge_doubt(model, mean[row], covariance[row], h[row], self.surfaces)
        return after, jacobian, noise

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


def _moved(belief: Belief, h: Tensor, after: Tensor, jacobian: Tensor, noise: Tensor) -> Belief:
    covariance = jacobian @ belief.covariance @ jacobian.transpose(-1, -2)
    covariance[:, :STATE_DIM, :STATE_DIM] += noise
    covariance = (covariance + covariance.transpose(-1, -2)) / 2  # rounding would add up
    return replace(belief, time=belief.time + h, mean=after, covariance=covariance)
