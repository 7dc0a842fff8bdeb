"""Computes the likelihood of the observations as a function of the noise, for learning its scale.

Scaling all standard deviations does not move the most probable states, so that an error of states cannot determine the
scale. The likelihood of the observations with all states integrated out does. In Laplace's approximation, exact for a
linear model with Gaussian noise, its negative logarithm is the objective at the minimum + log det(R) + the factors' log
spreads, R^T R the Gauss-Newton matrix. Its derivative by the noise is that of sum_k tr(T S T^T) / 2 - log det(T) (R. A.
Fisher's identity), where T rewhitens factor k and S = r r^T + J C J^T is the mean square of its whitened residual under
the posterior covariance C of its variables.
"""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ballfg.factors.batch import FactorBatch, Noise, Rows, Values
from ballfg.factors.graph import BallGraph
from ballfg.factors.linear.covariance import NeighbourCovariances
from ballfg.factors.linear.step import weighted
from ballfg.learning.gradient.conjugate_gradients import GaussNewtonFactors


def negative_log_likelihood(
    graphs: Sequence[BallGraph], minima: Sequence[Values], factors: GaussNewtonFactors, noise: Noise
) -> Tensor:
    """(t,) of each track's observations, up to a constant; differentiable in the noise alone.

    Robust losses count as Gaussians with each residual's weight at the minimum.

    Args:
        factors: their Gauss-Newton factorisations there.
        noise: relative to that of the graphs, to which its value must be equal.
    """
    totals = []
    for root, graph, minimum in zip(factors.roots, graphs, minima, strict=True):
        posterior = NeighbourCovariances.of(root)
        rows = graph.linearize(minimum)
        kinds = [kind for kind in graph.batches if len(kind)]
        value = root.log_determinant + sum(r.error() for r in rows) + sum(kind.log_spread() for kind in kinds)
        expected = torch.zeros((), dtype=torch.float64)
        for kind, linearized in zip(kinds, rows, strict=True):
            change = kind.noise_scale(noise)
            if change is not None:
                expected = expected + _expected(kind, linearized, posterior, change)
        totals.append(float(value) + expected - expected.detach())
    return torch.stack(totals)


def _expected(kind: FactorBatch, rows: Rows, posterior: NeighbourCovariances, change: Tensor) -> Tensor:
    """Expected negative log density of a kind's factors, as a function of the change that rewhitens them."""
    # (m, r, r) r r^T + J C J^T of each factor; residuals and Jacobians weighted as those of C
    weight = rows.loss.weight(np.linalg.norm(rows.residual, axis=-1))
    total = weight[:, None, None] * rows.residual[:, :, None] * rows.residual[:, None, :]
    _, jacobians = weighted(rows)
    for a, left in enumerate(jacobians):
        for b, right in enumerate(jacobians):
            total += left @ posterior.joint(rows.variables[:, a], rows.variables[:, b]) @ right.swapaxes(-1, -2)
    square = torch.from_numpy(total)
    if change.dim():
        spread = -change.diagonal(dim1=-2, dim2=-1).log().sum()
        return 0.5 * (change * (change @ square)).sum() + spread
    return 0.5 * change.square() * torch.einsum("nii->", square) - len(kind) * kind.dim * change.log()
