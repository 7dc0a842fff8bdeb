"""Runs a made-up ball through an estimator, so that a real one waits for no compiler and pushes keep a budget."""

import warnings
from dataclasses import replace
from time import perf_counter
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import OnlineState
from ballfg.prediction.crossing import Crossing

if TYPE_CHECKING:
    from ballfg.estimation.online.online import Online

SAMPLES = 40
PERIOD = 0.01
"""s between samples."""
DROP = 0.2
"""m, from which the ball falls."""
LOOKED_AHEAD = (15, SAMPLES - 1)
"""Samples at which the path is predicted: before the bounce, and after it."""
HORIZON = 0.5
"""s, long enough for the next bounce."""
FAR_REACH = 32
"""States moved by the dearer of the two kinds of timed pushes."""
REPEATED = 3
"""Times that a ball is timed: what interrupts a push once does not count."""
FULL = 256
"""States of a window before which balls are timed, unless it is cut at fewer."""
PAUSE = 2.0
"""s between two balls, or their beginnings."""


def warmed_up(online: "Online") -> list[OnlineState]:
    """The states before the bounce and at the end of a falling ball, estimated by a copy of an estimator."""
    trial, states = online.copy(), []
    trial.reset()
    stamps, positions = falling_ball(online)
    lying = positions[0] - [0.0, 0.0, DROP]  # its hops may be lower than the noise
    for time in stamps:
        trial.push(time, lying)
    trial.reset()
    for k, (time, position) in enumerate(zip(stamps, positions, strict=True)):
        state = trial.push(time, position)
        if k in LOOKED_AHEAD:
            bounce = _looked_ahead(state)
            states.append(state)
            end = (online.surfaces.extent or (0.0, np.inf))[1]
            if bounce is not None and np.isfinite(end):  # the same ball as it comes down at the table's end
                shift = end - bounce.state[0]
                moved = replace(state, mean=state.mean + shift * np.eye(len(state.mean))[0])
                _looked_ahead(moved)
                states.append(moved)
    trial.copy()
    return states


def reach_within(online: "Online", budget_ms: float) -> int:
    """How many of its newest states a push may linearise anew for the slowest through a bounce to take `budget_ms`.

    Warns if even a push that moves a single state takes longer.
    """
    full = _with_full_window(online)
    least, most = (_slowest_push(full, reach) for reach in (1, FAR_REACH))
    if least > budget_ms:
        remedy = "Pushes get shorter with a smaller lag"
        remedy += "." if online.settings.solver == "ballfg" else " and with Settings(solver='ballfg')."
        warnings.warn(
            f"budget_ms is {budget_ms:.3g}, but on this machine a push through a bounce takes {least:.2g} ms. {remedy}",
            stacklevel=4,
        )
    return 1 + max(int((budget_ms - least) * (FAR_REACH - 1) / max(most - least, 1e-9)), 0)


def _with_full_window(online: "Online") -> "Online":
    """A copy that holds several falling balls, and moves every state at every push."""
    full = online.copy()
    full.reach = 1
    full.reset()
    stamps, positions = falling_ball(online)
    for ball in range(max(min(FULL, 2 * online.lag) // SAMPLES - 1, 1)):
        for stamp, position in zip(ball * PAUSE + stamps, positions, strict=True):
            full.push(stamp, position)
    assert full.window is not None
    full.window.threshold[:] = 0.0
    full.window.start_anew(list(full.window.samples))
    return full


def _slowest_push(full: "Online", reach: int) -> float:
    """ms, of the slowest push of one more ball."""
    stamps, positions = falling_ball(full)
    spent = np.empty((REPEATED, SAMPLES))
    for row in spent:
        trial = full.copy()
        assert trial.window is not None
        trial.window.reach = reach
        after = trial.window.samples[-1].time + PAUSE
        for k, (stamp, position) in enumerate(zip(after + stamps, positions, strict=True)):
            begin = perf_counter()
            trial.push(stamp, position)
            row[k] = 1e3 * (perf_counter() - begin)
    return float(spent.min(axis=0).max())


def falling_ball(online: "Online") -> tuple[Array, Array]:
    """Stamps (40,) s and positions (40, 3) m of a ball that falls onto the table of an estimator, and bounces."""
    table = (*online.surfaces.heights(), 0.0)[0]
    gravity, rise = online.physics.gravity, table + online.physics.radius
    t: Array = PERIOD * np.arange(SAMPLES, dtype=np.float64)
    after = np.maximum(t - np.sqrt(2.0 * DROP / gravity), 0.0)
    falling = DROP - 0.5 * gravity * t**2
    rising = 0.9 * np.sqrt(2.0 * DROP * gravity) * after - 0.5 * gravity * after**2
    height = np.where(after > 0.0, rising, falling)
    return t, np.stack((3.0 * t, np.zeros(SAMPLES), rise + height), axis=1)


def _looked_ahead(state: OnlineState) -> Crossing | None:
    """The next contact; all other predictions are computed too."""
    ahead = state.predict(HORIZON)
    _ = ahead.apex, ahead.crossing(x=2.0)
    return ahead.next_contact
