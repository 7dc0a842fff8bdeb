"""A dynamics factor compares a state with the model's prediction from the previous one, up to process noise.

Three classes share everything but the motion over the interval: free flight, flight through named contacts, and rest on
a surface. A hit is a flight whose process noise contains the hit.
"""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Hashable
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numba import types

from ballfg.arrays import Array, Index, plain
from ballfg.deferred import torch
from ballfg.dynamics.compiled import motion
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.kept_model import carried
from ballfg.dynamics.compiled.signatures import THREE, TWO
from ballfg.dynamics.motion import arrays
from ballfg.dynamics.motion.limits import step_count, steps_over
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Noise, Values
from ballfg.factors.noise import Kicks, ProcessNoise, along_all_axes, whitening, whitening_tensor
from ballfg.state import STATE_DIM

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.model import BallModel


@machine_code(types.Tuple((TWO, THREE))(THREE, TWO, TWO, THREE))
def whiten(root: Array, target: Array, after: Array, moved: Array) -> tuple[Array, Array]:
    """W (x - F) (m, 9) and -W dF (m, 9, d), whitened, with W lower triangular.

    Args:
        root: (m, 9, 9) W, one over the units of the state.  target: (m, 9) x.
        after: (m, 9 + p) F and what travels with it.  moved: (m, 9 + p, d) its derivatives.
    """
    m, w = target.shape
    d = moved.shape[2]
    residual, slopes = np.zeros((m, w)), np.zeros((m, w, d))
    for r in range(m):
        for i in range(w):
            for k in range(i + 1):
                weight = root[r, i, k]
                if weight != 0.0:
                    residual[r, i] += weight * (target[r, k] - after[r, k])
                    for q in range(d):
                        slopes[r, i, q] -= weight * moved[r, k, q]
    return residual, slopes


def model_width(model: BallModel) -> int:
    """Number of a model's coefficients that travel with the state: those of an `AugmentedModel`."""
    return len(carried(model)[1])


class DynamicsFactors(FactorBatch):
    """r = W (x_{i+1} - F(x_i, dt_i; coefficients)), W the whitening of the process noise.

    Args:
        model: an `AugmentedModel` adds the coefficients as a third variable of every factor. Its own come first; the
            motion does not depend on the others, which are unknowns of observations.
        states: (m,) index i; each factor ties state i to state i + 1.  dt: (m,) s.
        covariance: (m, 9, 9) m, m/s, rad/s and their products, of the process noise over dt; or (m, 3, 3) of position,
            velocity and spin along any axis, if all axes are alike and independent.
        kicks: the contacts and hits in that covariance, for learning it; free flight by default.

    Raises: ValueError: if a dt is not positive.
    """

    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "dt", "whitening", "kick_times", "hit")
    _moving: motion.Moving | None = None

    def __init__(
        self, model: BallModel, states: Index, dt: Array, covariance: Array, kicks: Kicks | None = None
    ) -> None:
        states = np.asarray(states, dtype=np.int64)
        columns = [states, states + 1]
        if carried(model)[1]:
            columns.append(np.full_like(states, COEFFICIENTS))
        super().__init__(np.stack(columns, axis=-1), STATE_DIM)
        if not (dt > 0).all():
            raise ValueError(f"dt must be positive; got {dt.min():g} s. Sort the times and drop repeats.")
        self.model = model
        self.width = model_width(model)
        self.dt = dt
        root = whitening(covariance)
        self.whitening = root if root.shape[-1] == STATE_DIM else along_all_axes(root)
        kicks = kicks or Kicks.none(len(states))
        self.kick_times, self.hit = kicks.times, kicks.hit

    @abstractmethod
    def propagate(self, state: Array, rows: Index | slice) -> tuple[Array, Array]:
        """F and its Jacobian: (k, 9 + p) and (k, 9 + p, 9 + p) from augmented states (k, 9 + p).

        Args: state: (k, 9 + p).  rows: (k,) index of the factors, or a slice.
        """

    @abstractmethod
    def transition(self, state: Tensor) -> Tensor:
        """F of all rows, (m, 9 + p) to (m, 9 + p), differentiable in the states and the model's parameters."""

    @property
    def group(self) -> Hashable:
        """Further entries: the model (one for all `AugmentedModel`s of a base), the number of contacts."""
        inner, names = carried(self.model)
        return (*super().group, id(inner), names, self.kick_times.shape[1])  # type: ignore[misc]

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 9) whitened residuals in torch."""
        start = inputs[0] if len(inputs) == 2 else torch.cat((inputs[0], inputs[2][:, : self.width]), dim=-1)
        offset = inputs[1] - self.transition(start)[:, :STATE_DIM]
        return (torch.from_numpy(self.whitening) @ offset.unsqueeze(-1)).squeeze(-1)

    def noise_scale(self, noise: Noise) -> Tensor | None:
        """(m, 9, 9) the new whitening times the inverse of the old one."""
        if noise.process is None:
            return None
        basis = torch.from_numpy(Kicks(self.kick_times, self.hit).basis(self.dt))
        covariance = torch.tensordot(noise.process.square(), basis, dims=([0], [1]))
        return whitening_tensor(covariance) @ torch.linalg.inv(torch.from_numpy(self.whitening))

    def log_spread(self) -> float:
        """Half the log determinants of all covariances."""
        return -float(np.log(np.diagonal(self.whitening, axis1=1, axis2=2)).sum())

    def prepared(self) -> Self:
        """The same factors with what machine code needs of their model, if they move by machine code."""
        functions, other = motion.functions_of(self.model), copy.copy(self)
        if functions is not None:
            width = STATE_DIM + self.width
            other._moving = motion.Moving(self.model, functions, np.empty((0, width)), width)
        return other

    def _levels(self, rows: Index | slice) -> Array:
        """(k, c) m, the surfaces of c contacts in some of the intervals."""
        return np.empty((len(self.dt[rows]), 0))

    def moved(self, start: Array, rows: Index | slice) -> tuple[Array, Array]:
        """F and its Jacobian, (k, 9 + p) and (k, 9 + p, 9 + p), as of `propagate`; by machine code once `prepared`.

        Args: start: (k, 9 + p) augmented states.  rows: (k,) index of the factors, or a slice.
        """
        if self._moving is None:
            after, jacobian = self.propagate(start, rows)
            return plain(after), plain(jacobian)
        after, jacobian, _ = self._moving.at(start).travel(plain(self.dt[rows]), self._levels(rows))
        return after, jacobian

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 9) and Jacobians (k, 9, 9), (k, 9, 9) and, with coefficients, (k, 9, p)."""
        start = inputs[0] if len(inputs) == 2 else np.concatenate((inputs[0], inputs[2][:, : self.width]), axis=-1)
        after, jacobian = self.moved(plain(start), rows)
        root = self.whitening[rows]
        residual, by_start = whiten(root, plain(inputs[1]), after, jacobian)
        if len(inputs) == 2:
            return residual, (by_start, root)
        by_coefficients = by_start[..., STATE_DIM:]
        others = inputs[2].shape[-1] - self.width
        if others:
            by_coefficients = np.pad(by_coefficients, ((0, 0), (0, 0), (0, others)))
        return residual, (by_start[..., :STATE_DIM], root, by_coefficients)


class FlightFactors(DynamicsFactors):
    """Free flight over the interval."""

    def with_hits(self, rows: Index, noise: ProcessNoise) -> Self:
        """The same factors, with a hit at an unknown moment in some of the intervals.

        Args: rows: (k,) index of the factors.  noise: their process noise.
        """
        other, dt = copy.copy(self), self.dt[rows]
        other.whitening, other.hit = self.whitening.copy(), self.hit.copy()
        other.whitening[rows], other.hit[rows] = whitening(noise.flight(dt) + noise.hit(dt)), True
        return other

    def propagate(self, state: Array, rows: Index | slice) -> tuple[Array, Array]:
        """Flight over dt."""
        return arrays.fly_jacobian(self.model, state, self.dt[rows])

    def transition(self, state: Tensor) -> Tensor:
        """Flight over dt."""
        from ballfg.dynamics.motion.step_twice import flight_step

        dt = torch.from_numpy(self.dt)
        steps = step_count(dt)
        h = (dt / steps).unsqueeze(-1)
        for _ in range(steps):
            state = flight_step(self.model, state, h)
        return state

    @property
    def group(self) -> Hashable:
        """Further entry of the group: the number of integration steps."""
        return (*super().group, steps_over(float(self.dt.max())))  # type: ignore[misc]


class SurfaceFactors(DynamicsFactors):
    """Motion in contact with surfaces.

    Args:
        model: as for `DynamicsFactors`, like the others except for the heights.  states: (m,) index i.  dt: (m,) s.
        covariance: (m, 9, 9) m, m/s, rad/s and their products.  heights: (m, ...) m, of the surfaces.
        kicks: the contacts and hits in the covariance.
    """

    row_arrays: ClassVar[tuple[str, ...]] = (*DynamicsFactors.row_arrays, "heights")

    def __init__(
        self, model: BallModel, states: Index, dt: Array, covariance: Array, heights: Array, kicks: Kicks | None = None
    ) -> None:
        super().__init__(model, states, dt, covariance, kicks)
        self.heights = heights


class ContactFactors(SurfaceFactors):
    """Flight with contacts in the interval, at given surfaces; all rows have the same number of contacts.

    Args: heights: (m, c) m, the surface of each of c contacts, in order.
    """

    def propagate(self, state: Array, rows: Index | slice) -> tuple[Array, Array]:
        """Flight, impact, flight."""
        after, _, jacobian = arrays.fly_through_jacobian(self.model, state, self.dt[rows], tuple(self.heights[rows].T))
        return after, jacobian

    def transition(self, state: Tensor) -> Tensor:
        """Flight, impact, flight."""
        from ballfg.dynamics.motion.contact import fly_through

        heights = tuple(torch.from_numpy(plain(column)) for column in self.heights.T)
        return fly_through(self.model, state, torch.from_numpy(self.dt), heights)[0]

    def _levels(self, rows: Index | slice) -> Array:
        """(k, c) m, the surfaces in some of the intervals."""
        return plain(self.heights[rows])

    def contact_times(self, values: Values) -> Array:
        """(m, c) s since the start of each interval; NaN if the ball never reaches the surface."""
        start = values.states[self.variables[:, 0]]
        if self.width:
            own = np.broadcast_to(values.coefficients[: self.width], (len(self), self.width))
            start = np.concatenate((start, own), axis=-1)
        return arrays.fly_through(self.model, start, self.dt, tuple(self.heights.T))[1]


class RestFactors(SurfaceFactors):
    """The ball rests, slides or rolls on a surface over the interval.

    Args: heights: (m,) m of the surfaces.
    """

    def prepared(self) -> Self:
        """The same factors: their rows are computed one by one."""
        return self

    def propagate(self, state: Array, rows: Index | slice) -> tuple[Array, Array]:
        """Rolling over dt; the surface holds the ball's height and stops its vertical motion."""
        return arrays.roll_jacobian(self.model, state, self.dt[rows], self.heights[rows])

    def transition(self, state: Tensor) -> Tensor:
        """Rolling over dt."""
        from ballfg.dynamics.motion.rollout import roll

        return roll(self.model, state, torch.from_numpy(self.dt), torch.from_numpy(self.heights))
