"""Carries a stroke's states to moments beside its samples: events, and hits, where the ball's place is that of both.

Strokes that hits join form a chain, so that their joint posterior follows from messages: what a stroke, with all before
it, says about the place of the hit at its end is a factor of the next stroke, and what the next one, with all after it,
says is a factor of this one. A message holds nothing of the stroke that it goes to, and no measurement counts twice.
The moment of a hit is unknown between the two strokes: it moves the place along the difference of the velocities.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.estimation.rally.hits import HIT_SIGMA
from ballfg.estimation.result import Estimate
from ballfg.estimation.sides.gaussians import GaussianMixture
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.prior import PriorFactors
from ballfg.state import POSITION, STATE_DIM, VELOCITY
from ballfg.tracks.track import Track

STEPS: Final = 81
"""Moments between two strokes at which their paths are compared."""


@dataclass(frozen=True, eq=False)
class Event:
    """What happened to the ball: `kind` is hit, bounce, net, floor, lost or cut.

    Attributes: trajectory: name of the stroke, that after a hit.  t: s.  place: (3,) m.  sigma_t: s.
        sigmas: (3,) m.  probability: of the strokes that the event belongs to.
    """

    trajectory: str
    t: float
    kind: str
    place: Array
    sigma_t: float
    sigmas: Array
    probability: float


@dataclass(frozen=True, eq=False)
class Moment:
    """A state (9,) and its covariance (9, 9) at a time, s."""

    t: float
    state: Array
    covariance: Array


def carried(model: BallModel, estimate: Estimate, sample: int, t: float) -> Moment:
    """A sample's state carried to a time, s, nearby, before or after it, by an even acceleration, without contacts."""
    state, dt = estimate.states[sample], t - float(estimate.times[sample])
    with torch.no_grad():
        rates = model.rates(torch.from_numpy(state[None].copy()))[0]
    accelerated = np.asarray(rates)[0]
    later, carry = state.copy(), np.eye(STATE_DIM)
    later[POSITION] += state[VELOCITY] * dt + 0.5 * accelerated * dt**2
    later[VELOCITY] += accelerated * dt
    carry[POSITION, VELOCITY] = dt * np.eye(3)
    return Moment(t, later, carry @ estimate.covariances[sample] @ carry.T)


def hit_between(model: BallModel, before: Estimate, after: Estimate, step: float) -> Event:
    """The hit at which the path of a stroke meets that of the next one, most likely."""
    times = np.linspace(before.times[-1] - 0.5 * step, after.times[0] + 0.5 * step, STEPS)
    ways = ([carried(model, one, end, float(t)) for t in times] for one, end in ((before, -1), (after, 0)))
    (own, spread), (there, wide) = (
        (np.stack([at.state[POSITION] for at in way]), np.stack([at.covariance[POSITION, POSITION] for at in way]))
        for way in ways
    )
    met = GaussianMixture(np.zeros(len(times)), own, spread)
    met, _ = met.updated(there - own, wide + HIT_SIGMA**2 * np.eye(3), np.eye(3))
    weight = np.exp(met.log_weights - met.log_weight)
    mean = float(weight @ times)
    sigma_t = float(np.sqrt(weight @ (times - mean) ** 2 + (times[1] - times[0]) ** 2 / 12.0))
    whole = met.merged()
    return Event(after.name, mean, "hit", whole.means[0], sigma_t, np.sqrt(np.diag(whole.covariances[0])), 1.0)


@dataclass(frozen=True, eq=False)
class Link:
    """A hit between two strokes, with what its unknown moment does.

    Attributes:
        event: by both strokes alone.  jump: (3,) m/s, change of the velocity.
        late: s, middle of the time in which the hit may be, after the event.  width: s, its standard deviation.
    """

    event: Event
    jump: Array
    late: float
    width: float

    @classmethod
    def between(cls, model: BallModel, before: Estimate, after: Estimate, step: float) -> "Link":
        """The hit at which two strokes meet. Args: step: s between pictures."""
        event = hit_between(model, before, after, step)
        first, last = float(before.times[-1]) - 0.5 * step, float(after.times[0]) + 0.5 * step
        ways = [carried(model, one, end, event.t).state[VELOCITY] for one, end in ((before, -1), (after, 0))]
        return cls(event, ways[1] - ways[0], 0.5 * (first + last) - event.t, (last - first) / np.sqrt(12.0))

    def message(self, smoother: Smoother, source: Estimate, to: Estimate, *, forward: bool) -> PriorFactors:
        """What one stroke says about the last (or, forward, the first) state of the other. Args: to: its estimate."""
        t, model = self.event.t, smoother.model
        says, own = carried(model, source, -1 if forward else 0, t), carried(model, to, 0 if forward else -1, t)
        sample = 0 if forward else len(to) - 1
        since, state = t - float(to.times[sample]), to.states[sample]
        bent = own.state[POSITION] - state[POSITION] - since * state[VELOCITY]
        spread = says.covariance[POSITION, POSITION] + HIT_SIGMA**2 * np.eye(3)
        white = np.linalg.inv(np.linalg.cholesky(spread + self.width**2 * np.outer(self.jump, self.jump)))
        mean, root = np.zeros((1, STATE_DIM)), np.zeros((1, 3, STATE_DIM))
        mean[0, POSITION] = says.state[POSITION] - bent - (1.0 if forward else -1.0) * self.late * self.jump
        root[0, :, POSITION], root[0, :, VELOCITY] = white, since * white
        return PriorFactors(np.array([sample]), mean, root, smoother.settings.sighting_loss)


def joined_estimates(
    smoother: Smoother, tracks: Sequence[Track], alone: Sequence[Estimate], joined: Sequence[bool], step: float
) -> tuple[list[Estimate], list[Event | None]]:
    """The estimates of strokes that meet at hits, and the hit at the begin of each, None where it follows none.

    Args:
        tracks, alone: of each stroke, and its estimate without the others.
        joined: whether a hit joins a stroke to the one before.  step: s between pictures.
    """
    count = len(alone)
    links: list[Link | None] = [None] * (count + 1)
    for j in range(1, count):
        if joined[j] and not (alone[j - 1].status.failed or alone[j].status.failed):
            links[j] = Link.between(smoother.model, alone[j - 1], alone[j], step)
    onward, back = list(alone), list(alone)

    def told(j: int, *, forward: bool) -> list[PriorFactors]:
        """What the stroke before or, not forward, the one after tells stroke j, if a hit joins them."""
        link = links[j if forward else j + 1]
        if link is None:
            return []
        return [link.message(smoother, onward[j - 1] if forward else back[j + 1], alone[j], forward=forward)]

    for j in range(count):
        if links[j] is not None and links[j + 1] is not None:
            onward[j] = smoother.estimate(tracks[j], told(j, forward=True))
    for j in range(count - 1, -1, -1):
        if links[j] is not None and links[j + 1] is not None:
            back[j] = smoother.estimate(tracks[j], told(j, forward=False))
    both = [told(j, forward=True) + told(j, forward=False) for j in range(count)]
    found = [smoother.estimate(tracks[j], more) if more else alone[j] for j, more in enumerate(both)]
    return found, [None if link is None else link.event for link in links[:count]]
