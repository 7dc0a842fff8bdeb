"""Finds contacts and hits in states, since the tables of an estimate do not list them."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.state import POSITION, STANDARD_GRAVITY, VELOCITY, VZ, Z

NEAR = 0.05
"""m. A falling ball that would come this near to a surface before it rises again has met it; states err by less."""
LARGEST_ACCELERATION = 150.0
"""m/s^2. Air and gravity change a velocity less than this: drag of a table-tennis ball at 25 m/s is 80 m/s^2."""
SUDDEN = 1.5
"""m/s. A smaller jump is not taken for a hit: velocities err, and bounces change them at the edge of a step."""
GAP = 0.1  # s. During a longer step the motion is unknown: the ball may have bounced several times.


@dataclass(frozen=True)
class Mark:
    """A contact or a hit. `kind`: "contact" or "hit".  `time`: s.  `place`: (3,) m, approximate place of the ball."""

    kind: str
    time: float
    place: tuple[float, float, float]


def marks(times: Array, states: Array, surfaces: Sequence[float], radius: float) -> Iterator[Mark]:
    """Contacts and hits between the states of a track.

    A contact is a turn of the vertical velocity from down to up near a surface, a hit is a jump of the velocity beyond
    air, gravity or a contact. Steps of more than `GAP` have none.

    Args: times: (m,) s.  states: (m, 9).  surfaces: m, heights of table and floor.  radius: m, of the ball.
    """
    for i, step in enumerate(np.diff(times)):
        if step > GAP:
            continue
        before, after = states[i], states[i + 1]
        contact = _contact(before, after, float(step), surfaces, radius)
        if contact is not None:
            yield _mark("contact", float(times[i]), before, contact)
            continue
        jump = float(np.linalg.norm(after[VELOCITY] - before[VELOCITY]))
        if jump > SUDDEN + LARGEST_ACCELERATION * step:
            yield _mark("hit", float(times[i]), before, 0.5 * float(step))


def _contact(before: Array, after: Array, step: float, surfaces: Sequence[float], radius: float) -> float | None:
    """Seconds from the first of two states to a contact with a surface; None without a contact."""
    if not before[VZ] < 0.0 < after[VZ]:
        return None
    for surface in surfaces:
        level = surface + radius
        fall = float(before[Z]) - level
        reached = fall + float(before[VZ]) * step - 0.5 * STANDARD_GRAVITY * step**2
        if abs(fall) < NEAR or (fall > 0.0 and reached < NEAR):
            falling = math.sqrt(float(before[VZ]) ** 2 + 2.0 * STANDARD_GRAVITY * max(fall, 0.0))
            return min((falling + float(before[VZ])) / STANDARD_GRAVITY, step)
    return None


def _mark(kind: str, time: float, before: Array, later: float) -> Mark:
    x, y, z = (before[POSITION] + later * before[VELOCITY]).tolist()
    return Mark(kind, time + later, (x, y, z - 0.5 * STANDARD_GRAVITY * later**2))
