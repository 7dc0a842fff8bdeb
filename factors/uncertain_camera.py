"""Camera factors of cameras whose turn, place and focal length are known with a covariance only."""

from __future__ import annotations

from collections.abc import Hashable, Sequence
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.deferred import torch
from ballfg.factors.camera import FIXED, CameraFactors
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CHANGES, ZOOM, seen_at, slopes_of

if TYPE_CHECKING:
    from torch import Tensor


class UncertainCameraFactors(CameraFactors):
    """Camera factors with the changes of their cameras among the coefficients.

    A camera's change (`ballfg.vision.projection`) is L z, L L^T its covariance, with seven coefficients z whose
    prior has the standard deviation 1.

    Args: cameras: of the bank.  places: (c,) index of the first of each camera's coefficients, or `FIXED`.
        others: those of `CameraFactors`.
    """

    row_arrays: ClassVar[tuple[str, ...]] = (*CameraFactors.row_arrays, "place")

    def __init__(self, cameras: Sequence[Camera], places: Index, *others: Any) -> None:
        super().__init__(*others)
        self.place = places[self.camera]
        exact = np.zeros((CHANGES, CHANGES))
        roots = [exact if one.covariance is None else np.linalg.cholesky(one.covariance) for one in cameras]
        self.spread = np.stack(roots)
        self.centres = torch.from_numpy(np.stack([one.centre for one in cameras]))
        self.middles = torch.from_numpy(np.stack([one.matrix[:2, 2] for one in cameras]))

    @property
    def group(self) -> Hashable:
        """Further entries of the group: the cameras' spreads."""
        return (*super().group, id(self.spread))  # type: ignore[misc]

    def _columns(self, rows: Index | slice) -> Index:
        """(k, 7) index of each row's coefficients; of an exact camera any."""
        return np.asarray(np.maximum(self.place[rows], 0)[:, None] + np.arange(CHANGES))

    def _seen(self, points: Array, rows: Index | slice, coefficients: tuple[Array, ...]) -> tuple[Array, Array, Array]:
        """As for exact cameras, for the point that they would see; derivatives by the changes (k, r, 7)."""
        camera = self.camera[rows]
        own = np.take_along_axis(coefficients[0], self._columns(rows), axis=1)
        change = (self.spread[camera] @ own[..., None])[..., 0]
        seen, by_point, by_place = slopes_of(points, self.centres.numpy()[camera], change)
        numbers, slope, _ = super()._seen(seen, rows, coefficients)
        zoom = np.exp(change[:, ZOOM])[:, None]
        middle = np.pad(self.middles.numpy()[camera], ((0, 0), (0, self.dim - 2)))
        grown, slope = zoom * (numbers - middle), zoom[..., None] * slope
        by_change = np.concatenate((slope @ by_place, grown[..., None]), axis=2)
        return middle + grown, slope @ by_point, by_change

    def _add(self, by_coefficient: Array, rows: Index | slice, change: Array) -> None:
        """Adds the derivatives by the changes to those by the coefficients."""
        (free,) = np.nonzero(self.place[rows] != FIXED)
        columns = self._columns(rows)[free]
        by_coefficient[free[:, None], :, columns] += (change @ self.spread[self.camera[rows]])[free].swapaxes(1, 2)

    def _projected(self, points: Tensor, coefficients: tuple[Tensor, ...]) -> Tensor:
        """As for exact cameras, for the point that they would see."""
        own = coefficients[0].gather(1, torch.from_numpy(self._columns(slice(None))))
        change = (torch.from_numpy(self.spread[self.camera]) @ own[..., None])[..., 0]
        numbers = super()._projected(seen_at(points, self.centres[self.camera], change), coefficients)
        middle = torch.nn.functional.pad(self.middles[self.camera], (0, self.dim - 2))
        return middle + change[:, ZOOM, None].exp() * (numbers - middle)
