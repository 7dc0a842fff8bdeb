"""Estimates and predicts a made-up ball through a bounce, so that a real one waits for no compiler."""

from dataclasses import replace
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


def warmed_up(online: "Online") -> list[OnlineState]:
    """The states before the bounce and at the end of a falling ball, estimated by a copy of an estimator."""
    trial, states = online.copy(), []
    trial.reset()
    for k, (time, position) in enumerate(zip(*falling_ball(online), strict=True)):
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
