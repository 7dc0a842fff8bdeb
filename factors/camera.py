"""A camera factor compares the pixel of a sighting, and the ball's radius, with the projection of the state."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.deferred import torch
from ballfg.factors.batch import COEFFICIENTS, FactorBatch
from ballfg.factors.loss import Loss
from ballfg.state import POSITION, STATE_DIM, VELOCITY
from ballfg.vision.projection import CameraBank

if TYPE_CHECKING:
    from torch import Tensor

FIXED = -1
"""The column of a camera whose time offset is not estimated."""


class CameraFactors(FactorBatch):
    """r = W (project(p_i + tau v_i) - z), tau = delay - d: time from the state to the camera's exposure.

    W whitens the pixel noise, W^T W = R^-1. The delay is known. d is a coefficient, the error of the camera's time
    offset: positive if its stamps are later than assumed. Over the milliseconds of tau the path is straight to some
    micrometres, unless the ball bounces meanwhile. Where the ball's radius in the picture is known, a third number
    compares it with that at the depth.

    Args:
        states: (m,) indices of the observed states.  camera: (m,) numbers of the cameras in the bank.
        pixels: (m, 2) px.  covariances: (m, 2, 2) px^2.  bank: the cameras.
        delay: (m,) s, true time of each sighting minus that of its state; None: zeros.
        columns: (c,) index of the coefficient that is each camera's d, or `FIXED`. None: the factors do not depend on
            coefficients.
        loss: a robust one if the sightings contain wrong candidates.
        radii: (m, 2) px, radius in the picture, 0 where unknown, and its sigma; None: residuals have two numbers.
        ball: m, radius of the ball.
        shifts: (m, 3) m, where the camera stood from its place in the bank; None: there.

    Raises: ValueError: if the shapes of the arrays do not agree.
    """

    row_arrays: ClassVar[tuple[str, ...]] = (
        "variables",
        "camera",
        "pixels",
        "root",
        "delay",
        "column",
        "radii",
        "shifts",
    )

    def __init__(
        self,
        states: Index,
        camera: Index,
        pixels: Array,
        covariances: Array,
        bank: CameraBank,
        delay: Array | None = None,
        columns: Index | None = None,
        loss: Loss | None = None,
        radii: Array | None = None,
        ball: float = 0.0,
        shifts: Array | None = None,
    ) -> None:
        variables = np.asarray(states)[:, None]
        if columns is not None:
            variables = np.concatenate((variables, np.full_like(variables, COEFFICIENTS)), axis=1)
        super().__init__(variables, 2 if radii is None else 3, loss)
        m = len(self)
        if pixels.shape != (m, 2) or covariances.shape != (m, 2, 2) or np.shape(camera) != (m,):
            raise ValueError(
                f"camera, pixels and covariances must have shapes ({m},), ({m}, 2) and ({m}, 2, 2); "
                f"got {np.shape(camera)}, {pixels.shape} and {covariances.shape}"
            )
        self.camera = np.asarray(camera, dtype=np.int64)
        self.pixels = pixels
        self.root = np.linalg.inv(np.linalg.cholesky(covariances))
        self.delay = np.zeros(m) if delay is None else delay
        self.column = np.full(m, FIXED) if columns is None else np.asarray(columns)[self.camera]
        self.bank = bank
        self.ball = ball
        self.shifts = np.zeros((m, 3)) if shifts is None else shifts
        given = np.zeros((m, 2)) if radii is None else radii
        known = given[:, 0] > 0.0
        self.radii = np.stack((given[:, 0], np.divide(1.0, given[:, 1], out=np.zeros(m), where=known)), axis=1)

    @property
    def group(self) -> Hashable:
        """Further entries of the group: the cameras, the ball's radius."""
        return (*super().group, id(self.bank), self.ball)  # type: ignore[misc]

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, r) and Jacobians (k, r, 9), with time offsets also (k, r, p); r is 2, or 3 with radii.

        A residual is NaN if the ball is not in front of its camera.
        """
        state, root, column = inputs[0], self.root[rows], self.column[rows]
        tau = self.delay[rows] - _own(inputs[1:], column)
        velocity = state[:, VELOCITY]
        points = state[:, POSITION] - self.shifts[rows] + tau[:, None] * velocity
        numbers, by_point, by_change = self._seen(points, rows, inputs[1:])
        residual = (root @ (numbers[:, :2] - self.pixels[rows])[..., None])[..., 0]
        slope, change = root @ by_point[:, :2], root @ by_change[:, :2]
        if self.dim == 3:
            radius, sharp = self.radii[rows].T
            residual = np.concatenate((residual, (sharp * (numbers[:, 2] - radius))[:, None]), axis=1)
            slope = np.concatenate((slope, sharp[:, None, None] * by_point[:, 2:]), axis=1)
            change = np.concatenate((change, sharp[:, None, None] * by_change[:, 2:]), axis=1)
        by_state = np.zeros((len(state), self.dim, STATE_DIM))
        by_state[..., POSITION], by_state[..., VELOCITY] = slope, slope * tau[:, None, None]
        if len(inputs) == 1:
            return residual, (by_state,)
        by_coefficient = np.zeros((len(state), self.dim, inputs[1].shape[-1]))
        (free,) = np.nonzero(column != FIXED)
        by_coefficient[free, :, column[free]] = -(slope[free] @ velocity[free, :, None])[..., 0]
        self._add(by_coefficient, rows, change)
        return residual, (by_state, by_coefficient)

    def _seen(self, points: Array, rows: Index | slice, coefficients: tuple[Array, ...]) -> tuple[Array, Array, Array]:
        """Pixels and radius (k, r) of points (k, 3) m, derivatives (k, r, 3), and those by changes of the camera."""
        camera = self.camera[rows]
        numbers, slope = self.bank.jacobian(points, camera)
        if self.dim == 3:
            both = torch.from_numpy(points), torch.from_numpy(camera)
            seen, by_place = (t.numpy() for t in self.bank.radius(*both, self.ball))
            numbers = np.concatenate((numbers, seen[:, None]), axis=1)
            slope = np.concatenate((slope, by_place[:, None]), axis=1)
        return numbers, slope, np.zeros((len(points), self.dim, 0))

    def _add(self, by_coefficient: Array, rows: Index | slice, change: Array) -> None:
        """Adds derivatives by changes of the cameras to those by coefficients (k, r, p): exact cameras have none."""

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, r) whitened residuals in torch."""
        tau = torch.from_numpy(self.delay)
        if len(inputs) > 1:
            column = torch.from_numpy(self.column)
            own = inputs[1].gather(1, column.clamp(min=0)[:, None])[:, 0]
            tau = tau - torch.where(column != FIXED, own, 0.0)
        points = inputs[0][:, POSITION] - torch.from_numpy(self.shifts) + tau[:, None] * inputs[0][:, VELOCITY]
        numbers = self._projected(points, inputs[1:])
        off = numbers[:, :2] - torch.from_numpy(self.pixels)
        residual = (torch.from_numpy(self.root) @ off[..., None])[..., 0]
        if self.dim == 2:
            return residual
        radius, sharp = torch.from_numpy(self.radii).unbind(-1)
        return torch.cat((residual, (sharp * (numbers[:, 2] - radius))[:, None]), dim=-1)

    def _projected(self, points: Tensor, coefficients: tuple[Tensor, ...]) -> Tensor:
        """Pixels and radius (m, r) of points (m, 3) m."""
        camera = torch.from_numpy(self.camera)
        pixels = self.bank.project(points, camera)
        if self.dim == 2:
            return pixels
        return torch.cat((pixels, self.bank.radius(points, camera, self.ball)[0][:, None]), dim=-1)


def _own(coefficients: tuple[Array, ...], column: Index) -> Array:
    """(k,) s, each row's own d; zero for cameras whose offset is fixed."""
    if not coefficients:
        return np.zeros(len(column))
    found = np.take_along_axis(coefficients[0], np.maximum(column, 0)[:, None], axis=1)[:, 0]
    return np.where(column != FIXED, found, 0.0)
