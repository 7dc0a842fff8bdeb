"""Prior factors tie a state, its spin alone, or the shared coefficients to a mean with standard deviations."""

from __future__ import annotations

from collections.abc import Hashable
from typing import TYPE_CHECKING, ClassVar, cast

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.deferred import torch
from ballfg.dynamics.compiled.kept_model import carried
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Noise
from ballfg.factors.loss import Loss
from ballfg.state import SPIN, STATE_DIM

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.augmented import AugmentedModel
    from ballfg.dynamics.model import BallModel


class PriorFactors(FactorBatch):
    """r = W (x_i - mean_i), W (r, d): rows of W may use a part of the variable only.

    Args:
        variables: (m,) index of each state, or `COEFFICIENTS`.  mean: (m, d) in the variable's own units.
        information_root: (m, r, d) matrices W, one over the variable's own units.
        loss: on the norm of a whitened residual.
    """

    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "mean", "information_root")

    def __init__(self, variables: Index, mean: Array, information_root: Array, loss: Loss | None = None) -> None:
        super().__init__(np.asarray(variables)[:, None], information_root.shape[1], loss)
        self.mean = mean
        self.information_root = information_root

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, r) and Jacobians (k, r, d)."""
        root = self.information_root[rows]
        return (root @ (inputs[0] - self.mean[rows])[..., None])[..., 0], (root,)

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, r) whitened residuals in torch."""
        return self._whitened(inputs[0] - torch.from_numpy(self.mean))

    def _whitened(self, offset: Tensor) -> Tensor:
        return (torch.from_numpy(self.information_root) @ offset.unsqueeze(-1)).squeeze(-1)


class SpinLabelFactors(PriorFactors):
    """Priors on spins from labels; their standard deviation can be learned."""

    def noise_scale(self, noise: Noise) -> Tensor | None:
        """One factor for all axes of all labels."""
        return None if noise.spin is None else 1.0 / noise.spin

    def log_spread(self) -> float:
        """Sum of the logarithms of all standard deviations."""
        return -float(np.log(np.diagonal(self.information_root[:, :, SPIN], axis1=1, axis2=2)).sum())


class CoefficientPriorFactors(PriorFactors):
    """Priors on the coefficients of a track, with the model's own values as means.

    Args:
        model: with the coefficients.  sigma: (p,) standard deviations, in the coefficients' own units.
        others: number of unknowns of observations that follow the model's coefficients; these factors ignore them.

    Raises: ValueError: if a sigma is not positive and finite.
    """

    def __init__(self, model: BallModel, sigma: Array, others: int = 0) -> None:
        _check_sigma(sigma)
        self.model = model
        self.others = others
        inner, names = carried(model)
        mean = np.append([numbers_of(inner).value(name) for name in names], np.zeros(others))
        root = np.pad(np.diag(1.0 / sigma), ((0, 0), (0, others)))
        super().__init__(np.array([COEFFICIENTS]), mean[None], root[None])

    @property
    def group(self) -> Hashable:
        """Further entry of the group: the model."""
        return (*super().group, id(self.model))  # type: ignore[misc]

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, p) whitened residuals in torch, differentiable in the model's own values too."""
        means = cast("AugmentedModel", self.model).means()
        return self._whitened(inputs[0] - torch.cat((means, means.new_zeros(self.others))))


def state_prior(state: int, mean: Array, sigma: Array) -> PriorFactors:
    """A prior on one state.

    Args:
        state: its index.
        mean: (9,) m, m/s, rad/s.
        sigma: (9,) m, m/s, rad/s, standard deviations.
    Raises: ValueError: if a sigma is not positive and finite.
    """
    _check_sigma(sigma)
    return PriorFactors(np.array([state]), mean[None], np.diag(1.0 / sigma)[None])


def spin_prior(
    states: Index, spin: Array, sigma: Array, loss: Loss | None = None, axes: Array | None = None
) -> PriorFactors:
    """Priors on the spin of some states.

    Args:
        states: (m,) index of each.
        spin: (m, 3) rad/s, means.
        sigma: (m, 3) rad/s, standard deviations.
        loss: on the norm of a whitened residual.
        axes: (3, 3), one unit vector a row, along which sigma counts; None: x, y, z.
    Raises: ValueError: if a sigma is not positive and finite.
    """
    return PriorFactors(states, *_about_spin(spin, sigma, axes), loss)


def spin_label(states: Index, spin: Array, sigma: Array, loss: Loss | None = None) -> SpinLabelFactors:
    """Priors on the spin of some states from labels, whose standard deviation can be learned.

    Args: states: (m,) index.  spin: (m, 3) rad/s.  sigma: (m, 3) rad/s.  loss: as for `spin_prior`.
    Raises: ValueError: if a sigma is not positive and finite.
    """
    return SpinLabelFactors(states, *_about_spin(spin, sigma), loss)


def _about_spin(spin: Array, sigma: Array, axes: Array | None = None) -> tuple[Array, Array]:
    """Mean (m, 9) and root information (m, 3, 9) of priors on spins."""
    _check_sigma(sigma)
    mean = np.zeros((len(spin), STATE_DIM))
    mean[:, SPIN] = spin
    root = np.zeros((len(spin), 3, STATE_DIM))
    root[:, :, SPIN] = (np.eye(3) if axes is None else axes) / sigma[:, :, None]
    return mean, root


def coefficient_prior(mean: Array, sigma: Array, before: int = 0) -> PriorFactors:
    """A prior on shared coefficients.

    Args:
        mean: (p,) in the coefficients' own units.  sigma: (p,) standard deviations, in the same units.
        before: number of coefficients before these p, which the prior ignores.
    Raises: ValueError: if a sigma is not positive and finite.
    """
    _check_sigma(sigma)
    root = np.pad(np.diag(1.0 / sigma), ((0, 0), (before, 0)))
    return PriorFactors(np.array([COEFFICIENTS]), np.append(np.zeros(before), mean)[None], root[None])


def _check_sigma(sigma: Array) -> None:
    if not (np.isfinite(sigma).all() and (sigma > 0).all()):
        raise ValueError(
            f"sigma must be positive and finite; got {sigma.min():g}. Leave out a prior that says nothing."
        )
