"""Beliefs near a contact of uncertain time: some balls have bounced by then, the others have not.

The linear propagation takes all balls to be on the mean's side of the contact. Near the contact a belief is therefore
reported as a mixture of both sides, by its mean and covariance (docs/derivations/prediction.md). The linear belief is
carried on unchanged.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import torch
from torch import Tensor

from ballfg.dynamics.motion.contact import BEYOND, fly_through_jacobian
from ballfg.dynamics.motion.integrate import batch_jacobian
from ballfg.dynamics.surfaces import Surfaces
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction.belief import Belief
from ballfg.state import STATE_DIM, VZ

FAR = 4.5
"""Standard deviations of the gap beyond which all balls are on one side of a contact. One in 300,000 is on the other
then; with a jump of 5 m/s it adds 9 mm/s to a velocity's sigma. At 4 it would add 28 mm/s, as much as a usual sigma."""

LEAST_SIGMA = 1e-12
"""m. A gap known better than this has a sigma of this."""


@dataclass(frozen=True)
class Unbounced:
    """Balls on their way through a surface as if it were not there.

    Those whose mean has bounced a short while ago fly on below it; those that fall towards it are still above.

    Attributes:
        rows: (m,) their places in a batch of balls.
        heights: (m,) m of the surfaces.
        since: (m,) s, from when on they are followed; for a ball that bounced about the time of that.
        belief: of these m balls.
    """

    rows: Tensor
    heights: Tensor
    since: Tensor
    belief: Belief

    @classmethod
    def just_now(cls, belief: Belief, rows: Tensor, heights: Tensor) -> "Unbounced":
        """Some balls of a batch in free flight, on their way through surfaces of some heights (m,)."""
        chosen = belief.take(rows)
        return cls(rows, heights, chosen.time, chosen)

    @classmethod
    def joined(cls, parts: Sequence["Unbounced"]) -> "Unbounced":
        """All balls of some parts."""
        rows, heights, since = (torch.cat([getattr(p, name) for p in parts]) for name in ("rows", "heights", "since"))
        return cls(rows, heights, since, Belief.joined([p.belief for p in parts]))

    def take(self, chosen: Tensor) -> "Unbounced":
        """Some of the balls, by a mask (m,)."""
        return Unbounced(self.rows[chosen], self.heights[chosen], self.since[chosen], self.belief.take(chosen))

    def recent(self) -> "Unbounced":
        """Those that are followed any further: a contact is looked for no longer ago."""
        return self.take(self.belief.time - self.since < BEYOND)

    def followed_by(self, later: "Unbounced") -> "Unbounced":
        """With the balls of a later contact, which counts instead of an earlier one."""
        return Unbounced.joined([self.take(~torch.isin(self.rows, later.rows)), later])


def spread_over_contacts(belief: Belief, unbounced: Unbounced, surfaces: Surfaces, noise: ProcessNoise) -> Belief:
    """The belief with the mean and covariance of the mixture where a ball may or may not have bounced.

    Args:
        belief: linear, of n balls.
        unbounced: those whose mean bounced a short while ago.
        surfaces: what they may bounce on.
        noise: of an impact.
    """
    balls = Unbounced.joined([unbounced, _approaching(belief, surfaces)])
    if not len(balls.rows):
        return belief
    c, k = _below(balls)
    nearest = torch.full_like(belief.time, FAR).scatter_reduce(0, balls.rows, c.abs(), "amin")
    chosen = (c.abs() < FAR) & (c.abs() <= nearest[balls.rows])  # of two contacts of a ball the nearer one
    balls, c, k = balls.take(chosen), c[chosen], k[chosen]
    if not len(balls.rows):
        return belief
    mean, covariance = _mixture(balls, c, k, noise)
    known = covariance.isfinite().all(-1).all(-1)
    rows = (balls.rows[known],)
    return replace(
        belief,
        mean=belief.mean.index_put(rows, mean[known]),
        covariance=belief.covariance.index_put(rows, covariance[known]),
    )


def _approaching(belief: Belief, surfaces: Surfaces) -> Unbounced:
    """The balls that fall towards a surface."""
    heights = surfaces.level_below(belief.mean)
    falling = (belief.mean[:, VZ] < 0) & heights.isfinite()
    falling &= (heights != surfaces.table_height) | surfaces.over_table(belief.mean)
    rows = falling.nonzero()[:, 0]
    return Unbounced.just_now(belief, rows, heights[rows])


def _below(balls: Unbounced) -> tuple[Tensor, Tensor]:
    """(m,) c and (m, d) k: with a standard normal u, a ball is k u off its mean and below the surface where u < c."""
    model, heights = balls.belief.model, balls.heights
    gap, gradient = batch_jacobian(lambda at: model.gap(at, heights).unsqueeze(-1), balls.belief.mean, outputs=1)
    along = (balls.belief.covariance @ gradient.mT).squeeze(-1)  # (m, d)
    sigma = (gradient.squeeze(-2) * along).sum(-1).clamp_min(LEAST_SIGMA**2).sqrt()  # (m,) m
    return -gap.squeeze(-1) / sigma, along / sigma[:, None]


def _mixture(balls: Unbounced, c: Tensor, k: Tensor, noise: ProcessNoise) -> tuple[Tensor, Tensor]:
    """Mean (m, d) and covariance (m, d, d) of balls of which those below the surface have bounced.

    NaN where the two sides do not describe the ball: it would have bounced a second time, or never came down.
    """
    share = torch.special.ndtr(c)
    density = torch.exp(-c.square() / 2) / math.sqrt(2 * math.pi)
    above, above_covariance = _truncated(balls.belief, c, k, density / (1 - share))
    below, below_covariance = _truncated(balls.belief, c, k, -density / share)
    bounced, bounced_covariance = _bounced(balls, below, below_covariance, noise)
    p, jump = share[:, None], bounced - above
    outer = jump[:, :, None] * jump[:, None]
    p_matrix = p[:, :, None]
    covariance = p_matrix * bounced_covariance + (1 - p_matrix) * (above_covariance + p_matrix * outer)
    return above + p * jump, (covariance + covariance.mT) / 2


def _truncated(belief: Belief, c: Tensor, k: Tensor, u: Tensor) -> tuple[Tensor, Tensor]:
    """Mean and covariance of the balls on one side of the surface, where the standard normal of `_below` has mean u.

    A normal cut at c whose mean is u has the variance 1 + u (c - u), on either side.
    """
    shrink = (u * (c - u))[:, None, None] * k[:, :, None] * k[:, None]
    return belief.mean + u[:, None] * k, belief.covariance + shrink


def _bounced(balls: Unbounced, mean: Tensor, covariance: Tensor, noise: ProcessNoise) -> tuple[Tensor, Tensor]:
    """The balls below the surface after the bounce that they have gone through, linear about their mean."""
    model = balls.belief.model
    now = torch.zeros(len(mean), dtype=mean.dtype)
    after, times, jacobian = fly_through_jacobian(model, mean, now, (balls.heights,))
    with torch.no_grad():
        sensible = (times[:, 0] <= 0) & (model.gap(after, balls.heights) >= 0)
    elapsed = torch.where(sensible, -times[:, 0], now)
    covariance = jacobian @ covariance @ jacobian.mT
    covariance[:, :STATE_DIM, :STATE_DIM] += torch.from_numpy(noise.contact(elapsed.numpy(), now.numpy()))
    return after, torch.where(sensible[:, None, None], covariance, torch.nan)
