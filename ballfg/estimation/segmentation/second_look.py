"""Finds hits in the interval of a contact (a bat, a net, a frame) by a jump larger than friction allows.

The forward pass takes such an event for a contact, whose unknown friction costs less than a hit.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.segmentation.settings import SegmentationSettings

SIDE = 8
"""Number of samples on each side: at 180 Hz and 1.5 mm they give the velocity to 0.1 m/s."""
LEAST_SIDE = 4
"""Least number of samples on each side for a decision."""
LONGEST_INTERVAL = 0.02
"""s. Over longer intervals, drag and the unknown moment of the touch blur the jump."""
LEEWAY = 0.3
"""m/s, of tangential jump that noise and the Magnus force over these samples may feign."""


def hits_at_contacts(
    times: Array,
    positions: Array,
    usable: NDArray[np.bool_],
    contacts: Sequence[Contact],
    hits: Sequence[int],
    physics: SegmentationPhysics,
    settings: SegmentationSettings,
) -> list[int]:
    """Intervals of contacts with a tangential jump beyond Coulomb friction: mu (1 + e) v_n.

    Args:
        times: (n,) s.
        positions: (n, 3) m.
        usable: (n,) samples that measure the ball.
        contacts: of the forward pass, in order.
        hits: intervals; they bound the used samples, as neighbouring contacts do.
        physics: of the ball.
        settings: with the tolerated excess.
    """
    ends = sorted({-1, len(times) - 1, *hits, *(contact.interval for contact in contacts)})
    found = []
    for contact in contacts:
        i = contact.interval
        if i in hits or not 0 <= i < len(times) - 1 or times[i + 1] - times[i] > LONGEST_INTERVAL:
            continue
        place = ends.index(i)
        before = _velocity(times, positions, usable, max(ends[place - 1] + 1, i + 1 - SIDE), i, contact.time, physics)
        stop = min(ends[place + 1], i + SIDE) if place + 1 < len(ends) else i
        after = _velocity(times, positions, usable, i + 1, stop, contact.time, physics)
        if before is None or after is None:
            continue
        jump = np.hypot(*(after[:2] - before[:2]))
        if jump > settings.friction_excess * physics.friction * (1.0 + physics.restitution) * abs(before[2]) + LEEWAY:
            found.append(i)
    return found


def _velocity(
    times: Array,
    positions: Array,
    usable: NDArray[np.bool_],
    first: int,
    last: int,
    at: float,
    physics: SegmentationPhysics,
) -> Array | None:
    """(3,) m/s at time `at`: least squares of flight under gravity and drag through the usable samples first..last."""
    rows = first + np.flatnonzero(usable[first : last + 1])
    if len(rows) < LEAST_SIDE:
        return None
    since = times[rows] - at
    chord = (positions[rows[-1]] - positions[rows[0]]) / (times[rows[-1]] - times[rows[0]])
    pull = -physics.drag * np.linalg.norm(chord) * chord - np.array([0.0, 0.0, physics.gravity])
    straight = positions[rows] - 0.5 * pull * since[:, None] ** 2
    centred = since - since.mean()
    slope: Array = centred @ (straight - straight.mean(axis=0)) / (centred @ centred)
    return slope
