"""Joins the strokes of a rally at hits, where the ball's place is that of both.

The strokes form a chain, so that their joint posterior follows from messages: what a stroke, with all before it, says
about the place of the hit at its end is a factor of the next stroke, and what the next one, with all after it, says is
a factor of this one. A message holds nothing of the stroke that it goes to, and no measurement counts twice. The moment
of a hit is unknown between the two strokes: it moves the place along the difference of the velocities.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.estimation.rally.hits import HIT_SIGMA
from ballfg.estimation.rally.moments import Event, carried, hit_between
from ballfg.estimation.result import Estimate
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.prior import PriorFactors
from ballfg.state import POSITION, STATE_DIM, VELOCITY
from ballfg.tracks.track import Track


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

    def from_before(j: int) -> list[PriorFactors]:
        link = links[j]
        return [] if link is None else [link.message(smoother, onward[j - 1], alone[j], forward=True)]

    def from_after(j: int) -> list[PriorFactors]:
        link = links[j + 1]
        return [] if link is None else [link.message(smoother, back[j + 1], alone[j], forward=False)]

    for j in range(count):
        if links[j] is not None and links[j + 1] is not None:
            onward[j] = smoother.estimate(tracks[j], from_before(j))
    for j in range(count - 1, -1, -1):
        if links[j] is not None and links[j + 1] is not None:
            back[j] = smoother.estimate(tracks[j], from_after(j))
    found = [
        smoother.estimate(tracks[j], more) if (more := from_before(j) + from_after(j)) else alone[j]
        for j in range(count)
    ]
    return found, [None if link is None else link.event for link in links[:count]]
