"""Positions are the usual observation of a track."""

from typing import TYPE_CHECKING, ClassVar

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.estimation.observations.innovation import leave_one_out, leave_position_out
from ballfg.estimation.observations.observation import Context, Observation
from ballfg.estimation.settings import stamp_covariance
from ballfg.factors.batch import Rows, Values
from ballfg.factors.correlated_noise import BiasedPositionFactors
from ballfg.factors.linear.covariance import Covariances
from ballfg.factors.position import PositionFactors
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    from ballfg.estimation.result import Estimate


class Positions(Observation):
    """The measured positions (n, 3) m of a track, one at each sample."""

    name: ClassVar[str] = "position"
    locates: ClassVar[bool] = True

    def __init__(self, positions: Array) -> None:
        self.positions = positions
        self.state = np.arange(len(positions))

    def batch(self, context: Context) -> PositionFactors | BiasedPositionFactors:
        """Position factors with the noise and the loss of the context."""
        settings = context.settings
        if not settings.has_memory and context.velocities is None:
            return PositionFactors(self.state, self.positions, context.sigma, settings.loss)
        stamps = None if context.velocities is None else stamp_covariance(settings, context.velocities)
        return BiasedPositionFactors(
            self.state, self.positions, context.sigma, stamps, settings.loss, settings.has_memory
        )

    def select(self, samples: NDArray[np.bool_]) -> "Positions":
        """The positions of some samples."""
        return Positions(self.positions[samples])

    def innovations(self, context: Context, rows: Rows, values: Values, covariances: Covariances) -> Array:
        """(n, 3) whitened: each position against its prediction from all others."""
        if rows.jacobians[0].shape[-1] > STATE_DIM or context.velocities is not None:
            return leave_one_out(rows, covariances)
        noise = context.sigma[:, :, None] ** 2 * np.eye(3)
        return leave_position_out(values.states, covariances.states, self.positions, noise, rows)

    def judged(self, estimate: "Estimate") -> "Estimate":
        """The estimate: `noise_doubts` has looked at the positions themselves, beside any motion."""
        return estimate
