"""Flight and rest of all hypotheses over a time step: gravity, drag, and a slack acceleration per axis."""

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.segmentation.bank import FLYING, Bank, IntArray
from ballfg.estimation.segmentation.kernels import fly_all
from ballfg.estimation.segmentation.scene import Scene

REST_SIGMA = 0.003
"""m. Spread of the measured height of a resting ball about its surface, constant during the rest."""
REST_SLACK = 0.5
"""m/s^2. Slack acceleration of a rolling ball: rolling resistance and friction."""
LANDING_SIGMA = 0.2
"""m/s. Change of the horizontal velocity of a ball that stays down."""


def fly(mean: Array, cov: Array, dt: Array, scene: Scene) -> tuple[Array, Array]:
    """Free flight; negative steps go back, and add noise like positive ones.

    Args: mean: (h, 3, 3).  cov: (h, 3, 3, 3).  dt: (h,) s.  scene: the ball.
    Returns: mean and covariance after the step.
    """
    after = np.empty_like(mean), np.empty_like(cov)
    fly_all(mean, cov, dt, scene.numbers, scene.drift, *after)
    return after


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
