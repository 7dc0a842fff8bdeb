"""Answers how probable an event ahead is: a contact, an apex, or the crossing of a plane within the horizon.

Each event is a number that falls through zero: the height above a surface, the vertical velocity, the distance from a
plane. Its mean and standard deviation along the path give the probability that it is positive at some time and negative
later. A ball that may miss a plane has an event with a small probability, or none on its mean path.
"""

from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, TypeAlias

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import shown
from ballfg.prediction.belief import Belief
from ballfg.prediction.crossing import Crossing, apex, next_contact, plane_crossing
from ballfg.prediction.plane import AXES, Plane
from ballfg.prediction.propagate import Propagator
from ballfg.state import POSITION, STATE_DIM, VELOCITY, VZ

if TYPE_CHECKING:
    from ballfg.prediction.state import BallState

APEX, CONTACT = "apex", "next-contact"
HALF: Final = 0.5  # Least probability of an event on the mean path
LATER: Final = 1.0
"""s beyond the horizon in which a contact is looked for, which other balls than the mean one may have within it."""
Carried: TypeAlias = tuple[Propagator, Belief]


@dataclass(frozen=True, eq=False)
class EventAhead:
    """An event on the mean path, None without one, and the probability that the ball has one within the horizon."""

    crossing: Crossing | None
    probability: float


def asked_event(text: str) -> Plane | str:
    """The plane of a text, or `apex` or `next-contact` as they are. Raises: ValueError: any other text."""
    if text in (APEX, CONTACT):
        return text
    if "=" not in text:
        raise ValueError(f"event must be {APEX}, {CONTACT} or a plane such as z=3.05,down; got {shown(text)}")
    return Plane.parse(text)


def event_on(path: "Path", asked: Plane | str) -> EventAhead:
    """The first event of a kind on a path; asked: as from `asked_event`."""
    if isinstance(asked, Plane):
        return _crossing(path, asked)
    if asked == APEX:
        return EventAhead(apex(*path.carried, path.horizon), falls(*path.along(np.eye(STATE_DIM)[VZ], 0.0)))
    return path.contact()


def crossing_of(carried: Carried, plane: Plane, horizon: float) -> Crossing | None:
    """The crossing of a plane by the mean path, after its number of bounces; None without one within the horizon."""
    since = -np.inf
    for _ in range(plane.after):
        contact = next_contact(*carried, horizon, after=since)
        if contact is None:
            return None
        since = contact.time
    return _crossed(carried, plane, horizon, since)


def _crossed(carried: Carried, plane: Plane, horizon: float, since: float) -> Crossing | None:
    """The first crossing of a plane after a time, s; bounces before it have been counted."""
    return plane_crossing(*carried, plane.normal, plane.offset, horizon, after=since, direction=plane.direction)


def event_numbers(found: Crossing | None) -> dict[str, float]:
    """Time, place, velocity and speed of an event, their standard deviations and the covariances of the place.

    Returns: by the names of columns, s, m, m/s and m^2; NaN without an event.
    """
    state = np.full(STATE_DIM, np.nan) if found is None else found.state
    spread = np.full((STATE_DIM, STATE_DIM), np.nan) if found is None else found.covariance
    time, late = (np.nan, np.nan) if found is None else (found.time, found.time_sigma)
    velocity, speed = state[VELOCITY], float(np.linalg.norm(state[VELOCITY]))
    along = velocity / max(speed, np.finfo(float).tiny)
    numbers = {"t": time, "sigma_t": late}
    numbers |= dict(zip(("x", "y", "z", "vx", "vy", "vz"), state[:6].tolist(), strict=True))
    sigmas = np.sqrt(np.diagonal(spread)[POSITION])
    numbers |= {"speed": speed, **dict(zip(("sigma_x", "sigma_y", "sigma_z"), sigmas.tolist(), strict=True))}
    numbers |= {"sigma_speed": float(np.sqrt(along @ spread[VELOCITY, VELOCITY] @ along))}
    return numbers | {f"cov_{AXES[i]}{AXES[j]}": float(spread[i, j]) for i, j in ((0, 1), (0, 2), (1, 2))}


def falls(value: Array, sigma: Array) -> float:
    """Probability that a number is positive at some time and negative at a later one.

    Errors last along a path: one that is high by a share of its standard deviation is so at all times. A path at the
    quantile u then falls through zero if u lies between the quantiles that are zero at two times, the later one higher.

    Args: value, sigma: (k,) mean and standard deviation at k times.
    """
    from scipy import special  # it takes a tenth of a second to import

    above = special.ndtr(value / np.maximum(sigma, np.finfo(float).tiny))
    lowest = np.minimum.accumulate(above[::-1])[::-1]  # from each time on
    covered, reached = 0.0, np.inf
    falling = above[:-1] > lowest[1:]
    for high, low in sorted(zip(above[:-1][falling].tolist(), lowest[1:][falling].tolist(), strict=True), reverse=True):
        covered += max(min(high, reached) - low, 0.0)
        reached = min(reached, low)
    return covered


@dataclass(frozen=True)
class Path:
    """Means (k, 9) and covariances (k, 9, 9) of the state at times (k,) s after the start, and what carries it."""

    start: "BallState"
    carried: Carried
    times: Array
    states: Array
    covariances: Array

    @property
    def horizon(self) -> float:
        """Range of the search, s."""
        return float(self.times[-1] - self.start.time)

    def along(self, line: Array, offset: float, since: float = -np.inf) -> tuple[Array, Array]:
        """(j,) mean and standard deviation of line (9,) . state - offset, at the start and after it, from a time on."""
        states = np.concatenate((self.start.state[None], self.states))
        covariances = np.concatenate((self.start.covariance[None], self.covariances))
        later = np.append(self.start.time, self.times) > since
        spread = np.einsum("i,kij,j->k", line, covariances[later], line)
        return states[later] @ line - offset, np.sqrt(np.maximum(spread, 0.0))

    def contact(self, since: float = -np.inf) -> EventAhead:
        """The next contact after a time, s, and the probability that its uncertain time lies within the horizon."""
        from scipy import special

        found = next_contact(*self.carried, self.horizon + LATER, after=since)
        if found is None:
            return EventAhead(None, 0.0)
        left = float(self.times[-1]) - found.time
        sooner = float(special.ndtr(left / max(found.time_sigma, np.finfo(float).tiny)))
        return EventAhead(found if left >= 0.0 else None, sooner)


def _crossing(path: Path, plane: Plane) -> EventAhead:
    """The crossing of a plane, after its number of bounces."""
    since, chance = -np.inf, 1.0
    for _ in range(plane.after):
        contact = path.contact(since)
        chance *= contact.probability
        if contact.crossing is None:
            return EventAhead(None, 0.0)
        since = contact.crossing.time
    normal, offset = plane.line
    line = np.zeros(STATE_DIM)
    line[POSITION] = normal
    value, sigma = path.along(line, offset, since)
    down, up = falls(value, sigma), falls(-value, sigma)
    ways = {"down": down, "up": up, "either": max(down, up)}
    found = _crossed(path.carried, plane, path.horizon, since)
    # the mean path may cross between two of its times, as close to a table it does
    least = 0.0 if found is None else HALF
    return EventAhead(found, chance * max(ways[plane.direction], least))
