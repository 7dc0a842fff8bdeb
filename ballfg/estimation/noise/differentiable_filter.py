"""Runs the compiled filter of linearised tracks as a function that torch can differentiate once."""

from typing import Any

import numpy as np
import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from ballfg.arrays import Array
from ballfg.estimation.noise.filter_code import filter_tracks
from ballfg.estimation.noise.filter_derivative import pull_back
from ballfg.estimation.noise.linear_filter import BIAS_DIM, LinearFilter


class FilterRun(torch.autograd.Function):
    """The compiled filter as a function that torch can differentiate once."""

    @staticmethod
    def forward(ctx: Any, tracks: LinearFilter, *noise: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Means, covariances and densities, as in `Filtered`.

        Raises: torch.linalg.LinAlgError: as `LinearFilter.run`.
        """
        linear, shape = tracks.tracks, (tracks.count, tracks.samples)
        process, decays, memory, prior, measured = (tensor.detach().contiguous().numpy() for tensor in noise)
        sizes = ((tracks.width,), (tracks.width, tracks.width), (tracks.width, 3), (3, 3), (3,), ())
        made = [np.empty(shape + size) for size in sizes]
        nll = np.empty(tracks.count)
        moved = [x.numpy() for x in (linear.transitions, linear.offsets, linear.kicks)]
        seen = linear.errors.numpy(), tracks.seen, tracks.first
        if not filter_tracks(*moved, process, decays, memory, measured, *seen, prior, *made, nll):
            raise torch.linalg.LinAlgError("the covariance of an innovation is not positive definite")
        ctx.tracks, ctx.decays, ctx.memory, ctx.made = tracks, decays, memory, made
        ctx.set_materialize_grads(False)
        return torch.from_numpy(made[0]), torch.from_numpy(made[1]), torch.from_numpy(nll)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, by_mean: Tensor | None, by_covariance: Tensor | None, by_following: Tensor | None) -> Any:
        """Derivatives by the variances and decays, from those by the results."""
        tracks, (means, covariances, *_) = ctx.tracks, ctx.made
        linear, (count, samples, width) = tracks.tracks, means.shape
        if by_mean is None and by_covariance is None:  # of the densities of next samples alone
            by_states = np.empty((count, 0, width)), np.empty((count, 0, width, width))
        else:
            by_states = _dense(by_mean, means), _dense(by_covariance, covariances)
        shapes = (linear.kicks.shape[2],), (samples - 1,), (BIAS_DIM,), (width,), (samples, 3, 3)
        found = [np.empty((count, *shape)) for shape in shapes]
        moved = linear.transitions.numpy(), linear.kicks.numpy(), ctx.decays, ctx.memory, tracks.seen
        pull_back(*moved, *ctx.made, *by_states, _dense(by_following, np.empty(count)), *found)
        return None, *(torch.from_numpy(x) for x in found)


def _dense(derivative: Tensor | None, like: Array) -> Array:
    """A derivative as a dense array for machine code; zeros for None."""
    return np.zeros(like.shape) if derivative is None else np.asarray(derivative.contiguous().numpy())
