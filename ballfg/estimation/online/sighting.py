"""One sighting in the window of iSAM2: its camera factor, and the last answer that its torch batch gave."""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np
from numpy.typing import NDArray

from ballfg.factors.batch import merge
from ballfg.factors.bridge import Bridge, checked
from ballfg.factors.camera import CameraFactors
from ballfg.factors.loss import Loss
from ballfg.vision.projection import CameraBank

Array = NDArray[np.float64]


class Sighting:
    """One sighting of a ball by one camera.

    Args:
        bank: the cameras.  camera: number in it.
        pixel: (2,) px.  covariance: (2, 2) px^2.
        delay: s, its true time minus that of its state.
        loss: on the whitened residual.

    Attributes:
        innovation: (2,) whitened, against the prediction at the moment it came in; NaN where there was none.
    """

    def __init__(
        self, bank: CameraBank, camera: int, pixel: Array, covariance: Array, delay: float, loss: Loss
    ) -> None:
        where = np.zeros(1, dtype=np.int64)
        self.kind = CameraFactors(
            where, where + camera, pixel[None], covariance[None], bank, np.array([delay]), loss=loss
        )
        self.bridge = Bridge(self.kind, on_miss="row")
        self.innovation = np.full(2, np.nan)

    def factor(self, state: int) -> gtsam.CustomFactor:
        """The factor on a state of the stream."""
        return self.bridge.factor(0, [state])

    def corrected(self, state: Array, covariance: Array) -> tuple[Array, Array]:
        """State (9,) and its covariance (9, 9), moved by the sighting as an extended Kalman filter would.

        A robust loss gets the weight that the innovation gives it. The innovation is kept the first time.
        """
        (residual,), (rows,) = self.kind.compute(slice(None), (state[None],))
        slope = rows[0]
        spread = slope @ covariance @ slope.T
        whitened = np.linalg.solve(np.linalg.cholesky(spread + np.eye(2)), -residual)
        if np.isnan(self.innovation).any():
            self.innovation = whitened
        (weight,) = self.kind.loss.weight(np.array([np.linalg.norm(whitened)]))
        gain = np.linalg.solve(spread + np.eye(2) / weight, slope @ covariance).T
        return state - gain @ residual, covariance - gain @ slope @ covariance


def prepare(sightings: Sequence[Sighting], states: Array) -> None:
    """Evaluate sightings at their states (k, 9) in one torch call and keep the answers for iSAM2's questions.

    Raises: ValueError: if a ball is not in front of its camera.
    """
    if not sightings:
        return
    batch = merge([sighting.kind for sighting in sightings])
    inputs = (np.ascontiguousarray(states),)
    residual, (jacobian,) = checked(batch, slice(None), inputs, *batch.compute(slice(None), inputs))
    for k, sighting in enumerate(sightings):
        sighting.bridge.keep(0, (inputs[0][k],), residual[k], (jacobian[k],))
