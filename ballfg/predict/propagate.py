"""Propagation of a belief: mean and covariance through flight, contacts and rest, with process noise."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

import torch
from torch import Tensor

from ballfg.dynamics.contact import fly_through_jacobian
from ballfg.dynamics.integrate import MAX_STEP, batch_jacobian, fly_jacobian
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.rollout import REST_SPEED, advance, is_resting
from ballfg.dynamics.surfaces import Surfaces
from ballfg.factors.noise import ProcessNoise
from ballfg.predict.belief import Belief
from ballfg.state import STATE_DIM, VZ


@dataclass(frozen=True)
class Prediction:
    """Future states.

    Attributes:
        times: (n, k) s, on each track's clock.
        states: (n, k, 9).
        covariances: (n, k, 9, 9) of the states; no measurement noise in it.
    """

    times: Tensor
    states: Tensor
    covariances: Tensor


@dataclass(frozen=True)
class Propagator:
    """Carries beliefs forward in time.

    Attributes:
        surfaces: what the ball may bounce on.
        noise: how far it strays from its model.
    """

    surfaces: Surfaces
    noise: ProcessNoise

    def rollout(self, belief: Belief, times: Tensor) -> Prediction:
        """The states at given times.

        Args:
            belief: n balls.
            times: (n, k) s on each ball's clock, not decreasing, not before the belief.
        Raises: ValueError: if a time lies before the one before it.
        """
        steps = torch.diff(times, dim=-1, prepend=belief.time[:, None])
        if bool((steps < 0).any()):
            raise ValueError("times must not decrease and must not lie before the belief's time. Sort them.")
        states, covariances = [], []
        for dt in steps.unbind(-1):
            belief = self.forward(belief, dt)
            states.append(belief.mean[:, :STATE_DIM])
            covariances.append(belief.covariance[:, :STATE_DIM, :STATE_DIM])
        return Prediction(times, torch.stack(states, dim=1), torch.stack(covariances, dim=1))

    def forward(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s."""
        longest = float(dt.max()) if len(dt) else 0.0
        count = max(1, int(-(-longest // MAX_STEP)))
        for _ in range(count):
            belief = self._step(belief, dt / count)
        return belief

    def in_flight(self, belief: Belief, dt: Tensor) -> Belief:
        """The belief after dt (n,) s of free flight; surfaces are not there."""
        after, jacobian = fly_jacobian(belief.model, belief.mean, dt)
        return self._moved(belief, dt, after, jacobian, torch.from_numpy(self.noise.flight(dt.numpy())))

    def _step(self, belief: Belief, h: Tensor) -> Belief:
        model, mean = belief.model, belief.mean
        height = self.surfaces.height_below(mean)
        after, jacobian = fly_jacobian(model, mean, h)
        touching = is_resting(model, mean, height) | ((model.gap(after, height) < 0) & (after[:, VZ] < 0))
        noise = torch.from_numpy(self.noise.flight(h.numpy()))
        rows = touching.nonzero()[:, 0]
        if len(rows):
            after[rows], jacobian[rows], kick = self._touch(model, mean[rows], h[rows], height[rows])
            noise[rows] += kick
        return self._moved(belief, h, after, jacobian, noise)

    @staticmethod
    def _moved(belief: Belief, h: Tensor, after: Tensor, jacobian: Tensor, noise: Tensor) -> Belief:
        covariance = jacobian @ belief.covariance @ jacobian.transpose(-1, -2)
        covariance[:, :STATE_DIM, :STATE_DIM] += noise
        return replace(belief, time=belief.time + h, mean=after, covariance=covariance)

    def _touch(self, model: BallModel, mean: Tensor, h: Tensor, height: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Mean, Jacobian and the impacts' noise of balls that meet a surface, or rest on it, within a step.

        One plain bounce has its Jacobian composed; what is rarer (several bounces in a step, a table's edge, coming to
        rest) goes through autograd.
        """
        after, times, jacobian = fly_through_jacobian(model, mean, h, (height,))
        expected = advance(model, mean, h, self.surfaces).detach()
        plain = (after - expected).abs().amax(-1) < 1e-6
        other = (~plain).nonzero()[:, 0]
        if len(other):
            after[other], jacobian[other] = batch_jacobian(
                partial(_advanced, model, h[other], self.surfaces), mean[other]
            )
        bounced = after[:, VZ].abs() > REST_SPEED
        time = torch.where(plain, times[:, 0], h / 2)
        kick = torch.from_numpy(self.noise.contact(h.numpy(), time.numpy()))
        return after, jacobian, kick * bounced[:, None, None]


def _advanced(model: BallModel, h: Tensor, surfaces: Surfaces, mean: Tensor) -> Tensor:
    """`advance` on a batch with further leading dimensions, for `batch_jacobian`."""
    flat = mean.reshape(-1, mean.shape[-1])
    return advance(model, flat, h.expand(mean.shape[:-1]).reshape(-1), surfaces).reshape(mean.shape)
