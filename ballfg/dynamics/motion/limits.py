"""Defines the limits of integrations and contact searches, for torch and machine code alike."""

import math
from typing import TYPE_CHECKING, Final

import numpy as np
from numba.extending import register_jitable

from ballfg.arrays import Array, Index

if TYPE_CHECKING:
    from torch import Tensor

STAGES: Final = ((0.5, 2.0), (0.5, 2.0), (1.0, 1.0))
"""Of the classic Runge-Kutta scheme of order four, for the second stage to the last: how far along the step it lies, by
the slope of the stage before, and how often its own slope counts; that of the first stage counts once, all six times.
Source: E. Hairer, S. P. Norsett, G. Wanner, "Solving Ordinary Differential Equations I", 1993, table II.1.2."""
MAX_STEP: Final = 0.02
"""s. Longer intervals are cut into equal steps. The error of a step of 0.02 s is 2e-9 m at 6 m/s, 2e-7 m at
20 m/s."""
SEARCH_STEPS: Final = 12
"""Upper bound on the search for a contact from a guess; one or two are enough for a contact within 20 ms."""
TIME_TOLERANCE: Final = 1e-13  # s. The search stops when the error bound of every contact time is below
GAP_TOLERANCE: Final = 1e-10  # m. A grazing ball whose search stalled this close to the surface has touched it
TYPICAL_JERK: Final = 60.0  # m/s^3, in the bound on the search's error
DEEPEST: Final = 0.25
"""m. A ball whose centre is further below the lowest surface meets nothing. Floors are known to some centimetres."""
LEAST_FALL: Final = 1.0  # m/s^2. The search takes a ball to fall at least as fast as this
LONGEST_FALL: Final = 20.0  # s. A contact further away counts as none
BEYOND: Final = 0.3
"""s. A contact time further outside of its interval than this, and than the interval's length, is set to NaN."""
MIN_SPEED: Final = 1e-6
"""m/s. Least normal speed that a Newton step divides by; a ball that grazes more gently is at its apex."""
REST_SPEED: Final = 0.05
"""m/s. A ball that leaves a surface more slowly would be back within 10 ms, 0.13 mm high: it rests."""
REST_GAP: Final = 1e-5
"""m. A ball this close to a surface and slower than half of `REST_SPEED` rests on it. A ball that left at `REST_SPEED`
or faster is never both, so that a hop is the same motion however its time is cut."""
NEGLIGIBLE: Final = 1e-4
"""Share of balls that pass a table's edge on the other side than the mean, below which they are neglected; they would
add 0.05 m/s to a velocity."""
LEAST_SIGMA: Final = 1e-12  # m. Least standard deviation of a place
LONGEST_MOTION: Final = 20.0  # s. An untouched ball lies still by then; over a longer interval it stays in place
OVER_AN_END: Final = 1e-4
"""m. A rolling ball's centre this far beyond an end of the table falls: the search for a later contact, which is
accurate to a microsecond where the ball has only just left, then finds it beside the table."""
END_STEPS: Final = 20
"""Upper bound on Newton's search for the time at which a rolling ball passes an end; three or four are enough."""
MAX_CONTACTS: Final = 32
"""In one step of 20 ms a ball that leaves at `REST_SPEED` under its weight alone bounces at most twice."""


@register_jitable
def steps_over(duration: float) -> int:
    """Number of equal steps, each at most `MAX_STEP` to rounding, that a duration (s) needs; at least one."""
    return max(1, math.ceil(duration / MAX_STEP - 1e-9))


def steps_over_each(durations: Array) -> Index:
    """`steps_over` of each of some durations (n,) s."""
    return np.maximum(1, np.ceil(durations / MAX_STEP - 1e-9)).astype(np.int64)


def step_count(dt: "Tensor | Array") -> int:
    """Number of equal steps, each at most `MAX_STEP`, that the longest of some intervals (s) needs.

    An interval that is NaN (a contact that never comes) needs none.

    Raises: ValueError: if an interval is infinite.
    """
    durations = np.abs(dt) if isinstance(dt, np.ndarray) else dt.detach().abs()
    longest = float(durations.max()) if 0 not in durations.shape else 0.0
    if math.isnan(longest):
        longest = max((float(d) for d in durations.reshape(-1) if not math.isnan(d)), default=0.0)
    if math.isinf(longest):
        raise ValueError("dt must be finite; got inf. Check the times.")
    return steps_over(longest)
