"""Robust losses reduce the weight of large whitened residuals; they equal GTSAM's m-estimators."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Final, Literal

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_choice, check_number
from ballfg.deferred import torch
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, REAL

if TYPE_CHECKING:
    import gtsam
    from torch import Tensor

LEAST_STRETCH = 0.05
"""Least curvature along the residual, for a finite step where the loss is straight or concave."""


NAMES: Final = ("squared", "huber", "cauchy")
SQUARED, HUBER, CAUCHY = range(len(NAMES))  # Their numbers in machine code


@machine_code(REAL(COUNT, REAL, REAL))
def weight_of(kind: int, scale: float, square: float) -> float:
    """`Loss.weight` for machine code, of a squared whitened norm; the loss by its number in `NAMES`."""
    if kind == HUBER:
        return scale / max(math.sqrt(square), scale)
    return 1.0 / (1.0 + square / (scale * scale)) if kind == CAUCHY else 1.0


@dataclass(frozen=True)
class Loss:
    """rho(d) of the norm d of a whitened residual; `squared` is d^2/2.

    Attributes:
        name: `squared`, `huber` (linear beyond `scale`) or `cauchy` (logarithmic: a far outlier pulls less and less).
        scale: in standard deviations.

    Raises: ValueError: another name, or a scale that is not positive and finite. TypeError: a scale that is no number.
    """

    name: Literal["squared", "huber", "cauchy"] = "squared"
    scale: float = 3.0

    def __post_init__(self) -> None:
        check_choice("loss", self.name, NAMES)
        check_number("scale", self.scale, "standard deviations", above=0.0)

    @property
    def kind(self) -> int:
        """The number of the loss in `NAMES`."""
        return NAMES.index(self.name)

    @property
    def convex(self) -> Loss:
        """The loss itself if it is convex; Huber's in place of Cauchy's."""
        return Loss("huber", self.scale) if self.name == "cauchy" else self

    def value(self, norm: Array) -> Array:
        """(n,) rho, dimensionless, of whitened norms (n,)."""
        if self.name == "huber":
            return np.where(norm <= self.scale, 0.5 * norm**2, self.scale * (norm - 0.5 * self.scale))
        if self.name == "cauchy":
            return np.asarray(0.5 * self.scale**2 * np.log1p((norm / self.scale) ** 2))
        return np.asarray(0.5 * norm**2)

    def of_square(self, square: Tensor) -> Tensor:
        """Values rho in torch of squared norms, twice differentiable at zero too.

        Args: square: (...) whitened, squared norms.
        Returns: (...) dimensionless.
        """
        if self.name == "huber":
            far = square > self.scale**2
            norm = torch.where(far, square, self.scale**2).sqrt()
            return torch.where(far, self.scale * (norm - 0.5 * self.scale), 0.5 * square)
        if self.name == "cauchy":
            return 0.5 * self.scale**2 * torch.log1p(square / self.scale**2)
        return 0.5 * square

    def weight(self, norm: Array) -> Array:
        """(n,) weights rho'(d) / d of squared residuals whose whitened norms are d (n,); dimensionless."""
        if self.name == "huber":
            return np.asarray(self.scale / np.maximum(norm, self.scale))
        if self.name == "cauchy":
            return np.asarray(1.0 / (1.0 + (norm / self.scale) ** 2))
        return np.ones_like(norm)

    def stretch(self, norm: Array) -> Array:
        """(n,) curvature along the residual over that across it, rho''(d) d / rho'(d), at least `LEAST_STRETCH`.

        Reweighting alone assumes 1 and creeps up to a minimum with residuals in the loss's tail.

        Args: norm: (n,) whitened norms d.
        Returns: (n,) dimensionless.
        """
        if self.name == "huber":
            ratio = (norm <= self.scale).astype(np.float64)
        elif self.name == "cauchy":
            ratio = (1.0 - (norm / self.scale) ** 2) / (1.0 + (norm / self.scale) ** 2)
        else:
            ratio = np.ones_like(norm)
        return np.maximum(ratio, LEAST_STRETCH)

    def noise_model(self, dim: int) -> gtsam.noiseModel.Base:
        """GTSAM's model of this loss on a whitened residual of `dim` numbers."""
        import gtsam  # it takes a tenth of a second to import, and the own solver needs none of it

        unit = gtsam.noiseModel.Unit.Create(dim)
        if self.name == "squared":
            return unit
        estimators = gtsam.noiseModel.mEstimator
        huber = self.name == "huber"
        estimator = estimators.Huber.Create(self.scale) if huber else estimators.Cauchy.Create(self.scale)
        return gtsam.noiseModel.Robust.Create(estimator, unit)
