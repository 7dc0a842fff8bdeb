"""A camera factor compares the pixel of a sighting with the projection of the state's position."""

from collections.abc import Hashable
from typing import ClassVar

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array, Index
from ballfg.factors.batch import COEFFICIENTS, FactorBatch
from ballfg.factors.loss import Loss
from ballfg.state import POSITION, STATE_DIM, VELOCITY
from ballfg.vision.projection import CameraBank

FIXED = -1
"""The column of a camera whose time offset is not estimated."""


class CameraFactors(FactorBatch):
    """r = W (project(p_i + tau v_i) - z), tau = delay - d: time from the state to the camera's exposure.

    W whitens the pixel noise, W^T W = R^-1. The delay is known. d is a coefficient, the error of the camera's time
    offset: positive if its stamps are later than assumed. Over the milliseconds of tau the path is straight to some
    micrometres, unless the ball bounces meanwhile.

    Args:
        states: (m,) indices of the observed states.  camera: (m,) numbers of the cameras in the bank.
        pixels: (m, 2) px.  covariances: (m, 2, 2) px^2.  bank: the cameras.
        delay: (m,) s, true time of each sighting minus that of its state; None: zeros.
        columns: (c,) index of the coefficient that is each camera's d, or `FIXED`. None: the factors do not depend on
            coefficients.
        loss: a robust one if the sightings contain wrong candidates.

    Raises: ValueError: if the shapes of the arrays do not agree.
    """

    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "camera", "pixels", "root", "delay", "column")

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
    ) -> None:
        variables = np.asarray(states)[:, None]
        if columns is not None:
            variables = np.concatenate((variables, np.full_like(variables, COEFFICIENTS)), axis=1)
        super().__init__(variables, 2, loss)
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

    @property
    def group(self) -> Hashable:
        """Further entries of the group: the cameras."""
        return (*super().group, id(self.bank))  # type: ignore[misc]

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, 2) and Jacobians (k, 2, 9), with time offsets also (k, 2, p).

        A residual is NaN if the ball is not in front of its camera.
        """
        state, root, column = inputs[0], self.root[rows], self.column[rows]
        tau = self.delay[rows] - _own(inputs[1:], column)
        velocity = state[:, VELOCITY]
        points = torch.from_numpy(state[:, POSITION] + tau[:, None] * velocity)
        pixels, by_point = self.bank.jacobian(points, torch.from_numpy(self.camera[rows]))
        residual = (root @ (pixels.numpy() - self.pixels[rows])[..., None])[..., 0]
        slope = root @ by_point.numpy()
        by_state = np.zeros((len(state), 2, STATE_DIM))
        by_state[..., POSITION], by_state[..., VELOCITY] = slope, slope * tau[:, None, None]
        if len(inputs) == 1:
            return residual, (by_state,)
        by_offset = np.zeros((len(state), 2, inputs[1].shape[-1]))
        (free,) = np.nonzero(column != FIXED)
        by_offset[free, :, column[free]] = -(slope[free] @ velocity[free, :, None])[..., 0]
        return residual, (by_state, by_offset)

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, 2) whitened residuals in torch."""
        tau = torch.from_numpy(self.delay)
        if len(inputs) > 1:
            column = torch.from_numpy(self.column)
            own = inputs[1].gather(1, column.clamp(min=0)[:, None])[:, 0]
            tau = tau - torch.where(column != FIXED, own, 0.0)
        points = inputs[0][:, POSITION] + tau[:, None] * inputs[0][:, VELOCITY]
        pixels = self.bank.project(points, torch.from_numpy(self.camera))
        return (torch.from_numpy(self.root) @ (pixels - torch.from_numpy(self.pixels))[..., None])[..., 0]


def _own(coefficients: tuple[Array, ...], column: Index) -> Array:
    """(k,) s, each row's own d; zero for cameras whose offset is fixed."""
    if not coefficients:
        return np.zeros(len(column))
    found = np.take_along_axis(coefficients[0], np.maximum(column, 0)[:, None], axis=1)[:, 0]
    return np.where(column != FIXED, found, 0.0)
