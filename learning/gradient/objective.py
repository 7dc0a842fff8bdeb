"""Evaluates the objective of many tracks' graphs as one torch function of states, model, noise and priors.

The estimator minimises it in numpy, track by track. A gradient through the estimate needs it again in torch, for a
batch of tracks at once. Factors of the same sort are merged, so that a batch costs few torch calls.

The scale of the noise is learned beside it: scaling all standard deviations does not move the most probable states, so
that an error of states cannot determine the scale. The likelihood of the observations with all states integrated out
does. In Laplace's approximation, exact for a linear model with Gaussian noise, its negative logarithm is the objective
at the minimum + log det(R) + the factors' log spreads, R^T R the Gauss-Newton matrix. Its derivative by the noise is
that of sum_k tr(T S T^T) / 2 - log det(T) (R. A. Fisher's identity), where T rewhitens factor k and S = r r^T + J C J^T
is the mean square of its whitened residual under the posterior covariance C of its variables.
"""

import copy
from collections import defaultdict
from collections.abc import Hashable, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ballfg.factors.batch import COEFFICIENTS, FactorBatch, Noise, Rows, Values, merge
from ballfg.factors.graph import BallGraph
from ballfg.factors.linear.covariance import NeighbourCovariances
from ballfg.factors.linear.step import weighted
from ballfg.learning.gradient.conjugate_gradients import GaussNewtonFactors
from ballfg.state import STATE_DIM


@dataclass(frozen=True)
class Layout:
    """The order of the values of several tracks in one vector: all states of all tracks, then all coefficients."""

    lengths: tuple[int, ...]  # number of states of each of t tracks
    coefficients: int  # number p of coefficients of each track
    width: int = STATE_DIM  # numbers w of a state: 9, or 12 where the tracker's bias stands behind it

    @property
    def states(self) -> int:
        """Number of states of all tracks."""
        return sum(self.lengths)

    @property
    def starts(self) -> tuple[int, ...]:
        """Index of each track's first state."""
        return tuple(np.concatenate(([0], np.cumsum(self.lengths[:-1]))).astype(int).tolist())

    def pack(self, values: Sequence[Values]) -> Tensor:
        """One vector from the values of each track."""
        states = [v.gather(np.arange(len(v.states)), with_biases=True).reshape(-1) for v in values]
        return torch.from_numpy(np.concatenate(states + [v.coefficients for v in values]))

    def unpack(self, point: Tensor) -> tuple[Tensor, Tensor]:
        """States with their biases (n, w) and coefficients (t, p) of a vector."""
        states = point[: self.states * self.width].view(-1, self.width)
        return states, point[self.states * self.width :].view(len(self.lengths), self.coefficients)

    def owners(self) -> Tensor:
        """Track number of each entry of the vector."""
        track = torch.arange(len(self.lengths))
        of_states = track.repeat_interleave(torch.tensor(self.lengths) * self.width)
        return torch.cat((of_states, track.repeat_interleave(self.coefficients)))


@dataclass(frozen=True)
class _Block:
    """Merged kinds: the rows of states or coefficients that their variables are, and the track of each factor."""

    kind: FactorBatch
    places: tuple[tuple[bool, Tensor], ...]
    tracks: Tensor


class BatchObjective:
    """Sum over factors of the losses, for each track of a batch.

    Args:
        values: of each track, for the number of states and coefficients.

    Raises: ValueError: if some tracks have a tracker's biases and others none.
    """

    def __init__(self, graphs: Sequence[BallGraph], values: Sequence[Values]) -> None:
        width = values[0].width
        if any(v.width != width for v in values):
            raise ValueError(
                "tracks of a batch must all have measured positions where errors last (memory in the settings); some "
                "were made from sightings. Train on one sort of tracks, or without memory."
            )
        self.layout = Layout(tuple(len(v.states) for v in values), len(values[0].coefficients), width)
        groups: defaultdict[Hashable, list[tuple[int, FactorBatch]]] = defaultdict(list)
        for track, graph in enumerate(graphs):
            for kind in graph.batches:
                if len(kind):
                    groups[kind.group].append((track, kind))
        starts = self.layout.starts
        self._blocks = [_block(members, starts) for members in groups.values()]

    def __call__(self, point: Tensor, noise: Noise) -> Tensor:
        """(t,) the objective of each track, dimensionless.

        Args: point: (n,) vector of `layout.pack`, SI units.  noise: learned noise.
        """
        whole, coefficients = self.layout.unpack(point)
        states = whole[:, :STATE_DIM]
        total = point.new_zeros(len(self.layout.lengths))
        for block in self._blocks:
            seen = whole if block.kind.sees_biases else states
            inputs = tuple((coefficients if shared else seen)[index] for shared, index in block.places)
            residual = rewhitened(block.kind.residual(inputs), block.kind.noise_scale(noise))
            total = total.index_add(0, block.tracks, block.kind.loss.of_square(residual.square().sum(-1)))
        return total

    def gradient(self, point: Tensor, noise: Noise) -> Tensor:
        """(n,) derivative of the sum over tracks by the point (n,), SI units, differentiable again."""
        with torch.enable_grad():
            (gradient,) = torch.autograd.grad(self(point, noise).sum(), point, create_graph=True)
        return gradient


def rewhitened(residual: Tensor, change: Tensor | None) -> Tensor:
    """Whitened residuals (m, r) for changed noise; `change` as `FactorBatch.noise_scale` gives it."""
    if change is None:
        return residual
    return (change @ residual.unsqueeze(-1)).squeeze(-1) if change.dim() else change * residual


def _block(members: Sequence[tuple[int, FactorBatch]], starts: Sequence[int]) -> _Block:
    """The kinds of one group as one kind, its variables numbered through all tracks."""
    moved = [copy.copy(kind) for _, kind in members]
    for (track, kind), shifted in zip(members, moved, strict=True):
        shifted.variables = np.where(kind.variables == COEFFICIENTS, track, kind.variables + starts[track])
    whole = merge(moved)
    is_shared = (members[0][1].variables == COEFFICIENTS).all(axis=0)
    columns = [torch.from_numpy(column.copy()) for column in whole.variables.T]
    places = tuple(zip(is_shared.tolist(), columns, strict=True))
    tracks = torch.tensor([track for track, _ in members])
    return _Block(whole, places, tracks.repeat_interleave(torch.tensor([len(kind) for _, kind in members])))


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
