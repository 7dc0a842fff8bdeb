"""Dynamics factors: the next state is what the model makes of this one, up to process noise.

Three kinds share everything but the motion over the interval: free flight, flight through named contacts, and rest on
a surface. A hit is a flight whose process noise contains the hit.
"""

from __future__ import annotations

from abc import abstractmethod
from functools import partial

import numpy as np
import torch
from torch import Tensor

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.contact import fly_through_jacobian
from ballfg.dynamics.integrate import batch_jacobian, fly_jacobian
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.rollout import roll
from ballfg.factors.kind import COEFFICIENTS, Array, FactorKind, Index, Values
from ballfg.factors.noise import whitening
from ballfg.state import STATE_DIM


class DynamicsFactors(FactorKind):
    """r = W (x_{i+1} - F(x_i, dt_i; coefficients)), W the whitening of the process noise.

    Args:
        model: an `AugmentedModel` adds its coefficients as a third variable of every factor.
        states: (m,) indices i; each factor ties state i to state i + 1.
        dt: (m,) s.
        covariance: (m, 9, 9) of the process noise gathered over dt.
    """

    def __init__(self, model: BallModel, states: Index, dt: Array, covariance: Array) -> None:
        states = np.asarray(states, dtype=np.int64)
        columns = [states, states + 1]
        if isinstance(model, AugmentedModel):
            columns.append(np.full_like(states, COEFFICIENTS))
        super().__init__(np.stack(columns, axis=-1), STATE_DIM)
        if not (dt > 0).all():
            raise ValueError(f"dt must be positive; got {dt.min():g} s. Sort the times and drop repeats.")
        self.model = model
        self.dt = dt
        self.whitening = whitening(covariance)

    @abstractmethod
    def propagate(self, state: Tensor, rows: Index | slice) -> tuple[Tensor, Tensor]:
        """F and its Jacobian: augmented states (k, 9 + p) to (k, 9 + p) and (k, 9 + p, 9 + p)."""

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 9) and Jacobians (k, 9, 9), (k, 9, 9) and, with coefficients, (k, 9, p)."""
        start = inputs[0] if len(inputs) == 2 else np.concatenate((inputs[0], inputs[2]), axis=-1)
        after, jacobian = self.propagate(torch.from_numpy(np.ascontiguousarray(start)), rows)
        root = self.whitening[rows]
        residual = np.einsum("nij,nj->ni", root, inputs[1] - after.numpy()[:, :STATE_DIM])
        by_start = -(root @ jacobian.numpy()[:, :STATE_DIM])
        if len(inputs) == 2:
            return residual, (by_start, root)
        return residual, (by_start[..., :STATE_DIM], root, by_start[..., STATE_DIM:])


class FlightFactors(DynamicsFactors):
    """Free flight over the interval."""

    def propagate(self, state: Tensor, rows: Index | slice) -> tuple[Tensor, Tensor]:
        """Flight over dt."""
        return fly_jacobian(self.model, state, torch.from_numpy(self.dt[rows]))


class ContactFactors(DynamicsFactors):
    """Flight with contacts in the interval, at surfaces that are named; how many is the same for all rows.

    Args: heights: (m, c) m, the surface of each of c contacts, in order.
    """

    def __init__(self, model: BallModel, states: Index, dt: Array, covariance: Array, heights: Array) -> None:
        super().__init__(model, states, dt, covariance)
        self.heights = heights

    def propagate(self, state: Tensor, rows: Index | slice) -> tuple[Tensor, Tensor]:
        """Flight, impact, flight."""
        after, _, jacobian = self._through(state, rows)
        return after, jacobian

    def _through(self, state: Tensor, rows: Index | slice) -> tuple[Tensor, Tensor, Tensor]:
        heights = tuple(torch.from_numpy(column) for column in self.heights[rows].T.copy())
        return fly_through_jacobian(self.model, state, torch.from_numpy(self.dt[rows]), heights)

    def contact_times(self, values: Values) -> Array:
        """(m, c) s since the start of each interval; NaN where the ball never gets to the surface."""
        start = np.concatenate([values.gather(v) for v in (self.variables[:, 0], *self.variables[:, 2:].T)], axis=-1)
        return self._through(torch.from_numpy(start), slice(None))[1].numpy()


class RestFactors(DynamicsFactors):
    """The ball rests, slides or rolls on a surface over the interval.

    Args: heights: (m,) m of the surfaces.
    """

    def __init__(self, model: BallModel, states: Index, dt: Array, covariance: Array, heights: Array) -> None:
        super().__init__(model, states, dt, covariance)
        self.heights = heights

    def propagate(self, state: Tensor, rows: Index | slice) -> tuple[Tensor, Tensor]:
        """Rolling over dt; the surface holds the ball's height and stops its vertical motion."""
        dt, height = torch.from_numpy(self.dt[rows]), torch.from_numpy(self.heights[rows])
        return batch_jacobian(partial(_rolled, self.model, dt, height), state)


def _rolled(model: BallModel, dt: Tensor, height: Tensor, state: Tensor) -> Tensor:
    return roll(model, state, dt, height)
