"""Answers how probable an event ahead is: a contact, an apex, or the crossing of a plane within the horizon.

An event is a number that goes through zero: the vertical velocity, the distance from a plane. Where all balls have it
as the mean's neighbours do, only its time is in doubt. Elsewhere, as for a plane that a ball may miss, possible balls
are moved through bounces and past edges, and those that have the event are counted.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.dynamics.motion.arrays import bounced
from ballfg.prediction.crossing import Crossing
from ballfg.prediction.path import LATER, Path, may_pass_an_end, spread_over
from ballfg.prediction.plane import AXES, CONTACT, Line, Plane
from ballfg.state import POSITION, STATE_DIM, VELOCITY, VZ, Z

MOST: Final = 0.5  # Largest share of balls on the less probable side of a bounce


@dataclass(frozen=True, eq=False)
class EventAhead:
    """An event on the mean path, None without one, and the probability that the ball has one within the horizon."""

    crossing: Crossing | None
    probability: float


def event_on(path: Path, asked: Plane | str) -> EventAhead:
    """The first event of a kind on a path; asked: as from `asked_event`."""
    if asked == CONTACT:
        return EventAhead(*contact_ahead(path))
    line = Line.of(asked)
    found, alike = path.event(line)
    torn = line.after > 0 and path.start.other_side is not None  # balls have bounced just now, or have not
    if torn or not alike:
        return EventAhead(found, _chance_of(path, line))
    return EventAhead(found, 0.0 if found is None else _sooner(found, path.start.time + path.horizon - found.time))


def contact_ahead(path: Path) -> tuple[Crossing | None, float]:
    """The next contact within the horizon, and the probability that there is one.

    While the state is in doubt whether the ball has bounced just now, a ball on the other side has another contact: the
    bounce itself, or the one after it. So has one that passes an end of the table on the other side than the mean. The
    numbers of the mean's contact then spread to those too.
    """
    found, end = path.contact(), path.start.time + path.horizon
    chance = 0.0 if found is None else _sooner(found, end - found.time)
    if may_pass_an_end(path, found):
        found, chance = _past_or_not(path, found, chance)
    share, other = _other_contact(path, found)
    if other is not None:
        chance += share * (_sooner(other, end - other.time) - chance)
        if found is not None:
            off, late = other.state - found.state, other.time - found.time
            time_sigma = math.hypot(found.time_sigma, math.sqrt(share) * late)
            found = replace(found, time_sigma=time_sigma, covariance=found.covariance + share * np.outer(off, off))
    return (None if found is None or found.time > end else found), chance


def _past_or_not(path: Path, found: Crossing | None, chance: float) -> tuple[Crossing | None, float]:
    """The mean's contact and its probability; from possible balls if these differ in the surface that they meet."""
    heights = path.carried[0].surfaces.heights()
    balls = Path(path.start, path.carried, path.horizon + LATER).possible
    bounces = np.diff(balls.met, axis=1) > 0.0
    rows, at = np.flatnonzero(bounces.any(axis=1)), bounces.argmax(axis=1)
    states, times = balls.states[rows, at[rows]], balls.times[rows, at[rows]]
    upper = int((states[:, Z] > sum(heights) / len(heights)).sum())
    if len(rows) == len(bounces) and upper in (0, len(rows)):
        return found, chance
    chance = float((times <= path.horizon).sum() / len(bounces))
    if found is not None and len(rows):
        found = spread_over(found, states, times - (found.time - path.start.time))
    return found, chance


def _sooner(found: Crossing, left: float) -> float:
    """Probability that an event is less than some s later than it is expected."""
    return 0.5 * math.erfc(-left / (math.sqrt(2.0) * max(found.time_sigma, np.finfo(float).tiny)))


def _other_contact(path: Path, found: Crossing | None) -> tuple[float, Crossing | None]:
    """The share of balls on the other side of a present bounce, and their next contact; None without any doubt.

    The share follows from the variance of the vertical speed that the doubt gives and the jump of that speed.
    """
    start, (_, belief) = path.start, path.carried
    variance = 0.0 if start.other_side is None else float(start.other_side[VZ, VZ])
    rises, before = float(start.state[VZ]) > 0.0, belief.mean.copy()
    if variance <= 0.0 or (found is None and not rises):
        return 0.0, None
    if found is not None and not rises:
        before[0, :STATE_DIM] = found.state
        other = path.contact(found.time)
    else:
        before[0, VZ] *= -1.0  # had it come down as fast as it rises, it would rise more slowly, by the restitution
        before[0, VZ] = -(before[0, VZ] ** 2) / bounced(belief.model, before)[0, VZ]
        other = Crossing(start.time, 0.0, before[0, :STATE_DIM].copy(), start.covariance)
    jump = float(bounced(belief.model, before)[0, VZ] - before[0, VZ])
    return min(variance / jump**2, MOST), other


def _chance_of(path: Path, line: Line) -> float:
    """Share of balls with an event; on the other side of a present bounce a ball has one bounce more or less ahead."""
    chance = path.probability(line)
    if not line.after or path.start.other_side is None:
        return chance
    share, _ = _other_contact(path, path.contact())
    other = path.probability(replace(line, after=line.after + (-1 if path.start.state[VZ] > 0.0 else 1)))
    return chance + share * (other - chance)


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
