"""Flight and rest of all hypotheses over a time step: gravity, drag, and a slack acceleration per axis."""

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.segmentation.bank import FLYING, Bank, IntArray
from ballfg.estimation.segmentation.scene import Scene

STRONGEST_DRAG = 0.5
"""Largest share of its velocity that a ball may lose to drag in one step: keeps absurd velocities, as two outliers
1 ms apart give them, from growing without bound."""
REST_SIGMA = 0.003
"""m. Spread of the measured height of a resting ball about its surface, constant during the rest."""
REST_SLACK = 0.5
"""m/s^2. Slack acceleration of a rolling ball: rolling resistance and friction."""
LANDING_SIGMA = 0.2
"""m/s. Change of the horizontal velocity of a ball that stays down."""


def fly(mean: Array, cov: Array, dt: Array, scene: Scene) -> tuple[Array, Array]:
    """Free flight; negative steps go back, and add noise like positive ones.

    Drag is linearised at the present speed, the same on the three axes: v' = (1 - k |v| dt) v + (b - g) dt.

    Args: mean: (h, 3, 3).  cov: (h, 3, 3, 3).  dt: (h,) s.  scene: the ball.
    Returns: mean and covariance after the step.
    """
    velocity = mean[:, :, 1]
    loss = scene.physics.drag * np.sqrt(np.einsum("ha,ha->h", velocity, velocity)) * dt
    loss = np.minimum(np.maximum(loss, -STRONGEST_DRAG), STRONGEST_DRAG)
    half = 0.5 * dt * dt
    F = np.zeros((len(dt), 1, 3, 3))
    flat = F.reshape(-1, 9)
    flat[:, 0] = flat[:, 8] = 1.0
    flat[:, 1] = dt * (1.0 - 0.5 * loss)
    flat[:, 2] = half
    flat[:, 4] = 1.0 - loss
    flat[:, 5] = dt
    Ft = F.swapaxes(2, 3)
    after = mean @ Ft[:, 0]
    after[:, 2, 0] -= scene.physics.gravity * half
    after[:, 2, 1] -= scene.physics.gravity * dt
    return after, F @ cov @ Ft + process_noise(dt, scene)[:, None]


def process_noise(dt: Array, scene: Scene) -> Array:
    """(h, 3, 3) random walks of velocity and slack over steps of dt (h,) s, the same on each axis."""
    step = np.abs(dt)[:, None, None]
    first, second, third = scene.drift
    return step * (first + step * (second + step * third))


def carry(bank: Bank, dt: float, scene: Scene) -> Bank:
    """All hypotheses after dt s without an event: the flying fly, the resting stay down."""
    mean, cov = fly(bank.mean, bank.cov, np.array([dt] * len(bank)), scene)
    if not bank.all_flying:
        down = bank.resting
        mean[down, 2] = bank.mean[down, 2]
        cov[down, 2] = bank.cov[down, 2]
    return Bank(mean, cov, bank.surface, bank.score, bank.age, bank.shift, bank.tips)


def put_down(bank: Bank, surfaces: IntArray, scene: Scene) -> None:
    """Makes every hypothesis of a bank one that rests on a surface (h,); changes the bank."""
    bank.surface = surfaces
    bank.mean[:, 2] = 0.0
    bank.mean[:, 2, 0] = scene.centres[surfaces] + bank.shift[:, 2]
    bank.mean[:, :2, 2] = 0.0
    bank.cov[:, 2] = 0.0
    bank.cov[:, 2, 0, 0] = REST_SIGMA**2
    bank.cov[:, :2, 2, :] = bank.cov[:, :2, :, 2] = 0.0
    bank.cov[:, :2, 2, 2] = REST_SLACK**2
    bank.cov[:, :2, 1, 1] += LANDING_SIGMA**2


def lift(bank: Bank, scene: Scene) -> None:
    """Makes every resting hypothesis of a bank a flying one, with a small unknown vertical speed; changes the bank."""
    settings = scene.settings
    bank.surface = np.full(len(bank), FLYING)
    bank.cov[:, 2, 1, 1] += settings.leave_speed**2
    bank.cov[:, :, 2, 2] += settings.slack**2
