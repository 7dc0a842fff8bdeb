"""Moves one hypothesis over a time step of flight or rest: gravity, drag, and a slack acceleration per axis."""

import math
from typing import Final

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, NOTHING, REAL
from ballfg.estimation.segmentation.bank import FLYING, ONE_HYPOTHESIS, SURFACES, Record, Records
from ballfg.estimation.segmentation.scene import SCENE

STRONGEST_DRAG: Final = 0.5
"""Largest share of its velocity that a ball may lose to drag in one step: bounds absurd velocities, such as those from
two outliers 1 ms apart."""
REST_SIGMA: Final = 0.003
"""m. Spread of the measured height of a resting ball about its surface, constant during the rest."""
REST_SLACK: Final = 0.5
"""m/s^2. Slack acceleration of a rolling ball: rolling resistance and friction."""
LANDING_SIGMA: Final = 0.2
"""m/s. Change of the horizontal velocity of a ball that stays down."""


@machine_code(NOTHING(ONE_HYPOTHESIS, REAL, SCENE))
def carry(h: Record, t: float, scene: Record) -> None:
    """A hypothesis t s later, without an event: a flying ball flies, a resting one stays down; changes `h`.

    Drag is linearised at the present speed, equal on the three axes: v' = (1 - k |v| dt) v + (b - g) dt. Negative steps
    go back, and add noise like positive ones.
    """
    step, half = abs(t), 0.5 * t * t
    speed = math.sqrt(h.mean[0, 1] ** 2 + h.mean[1, 1] ** 2 + h.mean[2, 1] ** 2)
    loss = min(max(scene.drag * speed * t, -STRONGEST_DRAG), STRONGEST_DRAG)
    a, b = t * (1.0 - 0.5 * loss), 1.0 - loss
    left = np.empty((3, 3))
    for axis in range(3 if h.surface == FLYING else 2):
        mean, cov = h.mean[axis], h.cov[axis]
        mean[0] = mean[0] + a * mean[1] + half * mean[2]
        mean[1] = b * mean[1] + t * mean[2]
        for k in range(3):
            left[0, k] = cov[0, k] + a * cov[1, k] + half * cov[2, k]
            left[1, k] = b * cov[1, k] + t * cov[2, k]
            left[2, k] = cov[2, k]
        for i in range(3):
            cov[i, 0] = left[i, 0] + a * left[i, 1] + half * left[i, 2]
            cov[i, 1] = b * left[i, 1] + t * left[i, 2]
            cov[i, 2] = left[i, 2]
            for k in range(3):
                cov[i, k] += step * (scene.drift[0, i, k] + step * (scene.drift[1, i, k] + step * scene.drift[2, i, k]))
        if axis == 2:
            mean[0] -= scene.gravity * half
            mean[1] -= scene.gravity * t


@machine_code(NOTHING(ONE_HYPOTHESIS, COUNT, SURFACES))
def put_down(h: Record, surface: int, surfaces: Records) -> None:
    """Makes a hypothesis rest on a surface."""
    h.surface = surface
    h.mean[2, 0] = surfaces[surface].centre + h.shift[2]
    h.mean[2, 1] = h.mean[2, 2] = 0.0
    for i in range(3):
        for k in range(3):
            h.cov[2, i, k] = 0.0
    h.cov[2, 0, 0] = REST_SIGMA**2
    for axis in range(2):
        h.mean[axis, 2] = 0.0
        for k in range(3):
            h.cov[axis, 2, k] = h.cov[axis, k, 2] = 0.0
        h.cov[axis, 2, 2] = REST_SLACK**2
        h.cov[axis, 1, 1] += LANDING_SIGMA**2


@machine_code(NOTHING(ONE_HYPOTHESIS, SCENE))
def lift(h: Record, scene: Record) -> None:
    """Makes a resting hypothesis fly, with a small unknown vertical speed."""
    h.surface = FLYING
    h.cov[2, 1, 1] += scene.leave_speed**2
    for axis in range(3):
        h.cov[axis, 2, 2] += scene.slack**2
