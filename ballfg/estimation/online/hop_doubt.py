"""Tells the vertical motion of a ball that hops too low for distinguishing single bounces, sample by sample.

The window of a stream holds one arrangement of bounces. Where hops are as low as the noise, many arrangements explain
the samples as well, and the ball may be on either side of any bounce. A grid of hops follows all of them, forwards.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import OnlineState, Sample
from ballfg.estimation.sides.struck import beside
from ballfg.estimation.smoother.second_look.hop_grid import MILLIONTH, HopBelief, HopMoments
from ballfg.estimation.smoother.second_look.hopping_ball import HoppingBall, hop_time, most_height
from ballfg.estimation.smoother.second_look.low_hops import VERTICAL, as_white, bounce_jumps, levels_within
from ballfg.state import STATE_DIM, VZ

if TYPE_CHECKING:
    from ballfg.estimation.online.online import Online

LEAST_NOISE: Final = 1.5e-3
"""m. Heights of the surface are no closer than for samples with this noise: a push takes time for each."""


@dataclass(frozen=True)
class _Low:
    """A low sample: stamp (s), declared height of the surface (m), height above it (m), noise of that (m)."""

    time: float
    surface: float
    gap: float
    noise: float


class HopDoubt:
    """Follows a ball that is low over one surface for longer than a hop as high takes; nothing is changed in place.

    Args: owner: the estimator.
    """

    def __init__(self, owner: Online) -> None:
        self.model, self.settings = owner.model, owner.settings
        self.surfaces, self.physics = owner.surfaces, owner.physics
        self.reset()

    def reset(self) -> None:
        """Begins anew, with a ball that is not low."""
        self._low: tuple[_Low, ...] = ()  # all until the grid begins, then the last one
        self._belief: HopBelief | None = None
        self._apart = 0.0  # m, between heights of the surface

    def after(self, state: OnlineState, sample: Sample) -> OnlineState:
        """The state after a sample; in low hops, its height and vertical velocity over all arrangements of bounces."""
        if not sample.measured or not sample.motion.linked or sample.motion.hit:
            self.reset()
            return state
        self._follow(sample)
        if self._belief is None:
            return state
        rests = self._belief.resting
        if rests > 1.0 - MILLIONTH:
            return state
        own = state.mean[VERTICAL], state.joint[np.ix_(VERTICAL, VERTICAL)]
        lies = sample.motion.rest is not None  # then the window has the ball that lies still
        known = (self._belief.moving() if lies else self._belief).moments()
        spread = known.spread(known.mean)[0]
        spread[0, 0] += self._apart**2 / 12.0
        told = known.mean[0] + [sample.position[2] - self._low[-1].gap, 0.0], spread
        if lies:
            near, spread = beside(own, told, 1.0 - rests)
            told = near[0], spread
        return _with_vertical(state, *told, self._jump(state, known))

    def _jump(self, state: OnlineState, known: HopMoments) -> Array:
        """(d,) change of the other parts of a state per m/s of vertical velocity, where a bounce is in doubt."""
        jump = np.zeros(len(state.mean))
        jump[:STATE_DIM] = bounce_jumps(state.mean[None, :STATE_DIM], known.speed, self.model)[0]
        jump[VERTICAL] = 0.0
        return jump

    def _follow(self, sample: Sample) -> None:
        """Takes in a sample, and begins or ends the grid."""
        last = self._low[-1] if self._low else None
        low = self._seen(sample, None if last is None else sample.time - last.time)
        if low is None:
            self.reset()
            return
        most = most_height(low.noise)
        hop = hop_time(most, self.physics.gravity)
        if last is not None and (low.surface != last.surface or low.time - last.time > hop):
            self.reset()
        if self._belief is not None:
            assert last is not None
            self._belief, self._low = _after(self._belief, last, low), (low,)
            return
        self._low = (*self._low, low)
        if low.time - self._low[0].time > hop:
            self._begin(sample, most)

    def _seen(self, sample: Sample, dt: float | None) -> _Low | None:
        """A sample above the surface that it is near; None if there is none. Args: dt: s since the last low one."""
        noise = float(sample.stated[2])
        if dt is not None:
            noise = float(as_white(sample.stated[2], dt, self.settings))
        x, y, z = sample.position.tolist()
        for number, surface in enumerate(self.surfaces.heights()):
            gap = z - surface - self.physics.rise(x, y) - self.physics.radius
            if abs(gap) < most_height(noise) and (number or self.surfaces.over_table(sample.position)):
                return _Low(sample.time, surface, gap, noise)
        return None

    def _begin(self, sample: Sample, most: float) -> None:
        """Begins the grid with the low samples so far, the last of which is given."""
        ball, surface = HoppingBall(self.model, self.settings), self._low[0].surface
        grid = ball.grid(sample.position, most, np.array([low.noise for low in self._low]))
        spread = ball.level_spread(sample.position, surface)
        levels = levels_within(spread, max(sample.stated[2], LEAST_NOISE))
        self._apart = float(levels[1] - levels[0])
        belief = replace(grid.unknown(levels), said=-0.5 * (levels / spread) ** 2)
        belief = belief.weighed(self._low[0].gap, self._low[0].noise)
        for last, low in pairwise(self._low):
            belief = _after(belief, last, low)
        self._belief, self._low = belief, self._low[-1:]


def _with_vertical(state: OnlineState, mean: Array, spread: Array, jump: Array) -> OnlineState:
    """A state with another height and vertical velocity (2,), their covariance (2, 2), and a doubt about a bounce."""
    means, joint = state.mean.copy(), state.joint.copy()
    joint += max(spread[1, 1] - joint[VZ, VZ], 0.0) * np.outer(jump, jump)
    joint[VERTICAL] = joint[:, VERTICAL] = 0.0
    joint[np.ix_(VERTICAL, VERTICAL)] = spread
    means[VERTICAL] = mean
    return replace(state, mean=means, joint=joint, struck=None, other_side=None)


def _after(belief: HopBelief, last: _Low, low: _Low) -> HopBelief:
    """What is known after one more low sample."""
    ticks = max(round((low.time - last.time) / belief.grid.tick), 1)
    return belief.moved(ticks).weighed(low.gap, low.noise)
