"""Carries a stroke's states to moments beside its samples: events, and the hit at which two strokes meet."""

from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.estimation.rally.hits import HIT_SIGMA
from ballfg.estimation.result import Estimate
from ballfg.state import POSITION, STATE_DIM, VELOCITY

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
    cost, places, spreads = [], [], []
    for t in times:
        one, other = carried(model, before, -1, float(t)), carried(model, after, 0, float(t))
        first, second = (state.covariance[POSITION, POSITION] for state in (one, other))
        off = other.state[POSITION] - one.state[POSITION]
        both = first + second + HIT_SIGMA**2 * np.eye(3)
        cost.append(float(off @ np.linalg.solve(both, off) + np.linalg.slogdet(both)[1]))
        gain = first @ np.linalg.inv(both)
        places.append(one.state[POSITION] + gain @ off)
        spreads.append(first - gain @ first)
    weight = np.exp(-0.5 * (np.array(cost) - min(cost)))
    weight /= weight.sum()
    mean = float(weight @ times)
    sigma_t = float(np.sqrt(weight @ (times - mean) ** 2 + (times[1] - times[0]) ** 2 / 12.0))
    place = weight @ np.array(places)
    spread = np.einsum("n,nij->ij", weight, np.array(spreads))
    apart = np.array(places) - place
    spread += (apart * weight[:, None]).T @ apart
    return Event(after.name, mean, "hit", place, sigma_t, np.sqrt(np.diag(spread)), 1.0)
