"""Splits the squared error that predictions of linearised tracks are expected to have by the sources of the error.

The error of a prediction is a linear map of independent sources. With the gains of the filter held, its expected square
is linear in their variances. The gains minimise that square, so its derivative by a variance is the same whether the
gains are held or follow. The share of a source is its variance times that derivative, and the shares add up to the
whole (docs/derivations/budget.md).
"""

from dataclasses import replace
from typing import Final

import torch
from torch import Tensor

from ballfg.estimation.noise.linear_filter import BIAS_DIM, LinearFilter, Noise, Variances
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.factors.noise import PROCESS_NOISE
from ballfg.state import POSITION, SPIN, STATE_DIM

SOURCES: Final = ("observed", "spin", "coefficients", "tracker", "bounces", "motion", "samples")
"""White noise of the observed samples, with the wide priors of the first position and velocity; first spin;
coefficients; memory of the tracker and errors of stamps, of observed and predicted samples alike; impacts and hits;
motion between them; white noise of the predicted samples."""
IN_FLIGHT: Final = [PROCESS_NOISE.index(name) for name in ("acceleration", "spin")]


def squares_by_source(
    tracks: LinearTracks, noise: Noise, velocity_prior: float, observed: Tensor, predicted: Tensor
) -> Tensor:
    """Expected squared distances of predicted from measured positions, by source.

    A prediction is the ball's position, as `predict_tracks` makes it: the tracker's lasting error is not carried on.

    Args:
        tracks: t linearised tracks of n samples.
        noise: all of it, one row for all tracks.
        velocity_prior: m/s, standard deviation per axis at the start of a track.
        observed, predicted: (t, n) bool, samples that a prediction knows, and those it is compared with.
    Returns: (t, 7) m^2, summed over the predicted samples, in the order of `SOURCES`.
    Raises: torch.linalg.LinAlgError: the covariance of an innovation is not positive definite.
    """
    lasting = bool((noise.memory > 0.0).any())
    known = replace(tracks, used=tracks.used & observed)
    linear = LinearFilter(known, velocity_prior, biased=lasting)
    white, measured = linear.white(noise), linear.measured(noise)
    stamps = measured - torch.diag_embed(white)
    given = linear.variances(noise, measured)
    sources = [x.detach().clone().requires_grad_() for x in (given.process, given.memory, given.prior, white, stamps)]
    process, memory, prior, own, jitter = sources
    variances = Variances(process, memory, prior, torch.diag_embed(own) + jitter)
    covariances = linear.run_with(variances, noise.memory_time).covariances
    squares = (_trace(covariances[..., POSITION, POSITION]) * predicted).sum()
    slopes = torch.autograd.grad(squares, sources, allow_unused=True)
    process, memory, prior, own, jitter = (
        source.detach() * (torch.zeros_like(source) if slope is None else slope)
        for source, slope in zip(sources, slopes, strict=True)
    )
    later = _trace(stamps) + given.memory.sum(dim=1)[:, None]
    if lasting:  # an error that lasts through the end of the observed part is in the prediction and in the sample
        bias = slice(linear.own, linear.own + BIAS_DIM)
        later = later + 2.0 * _trace(covariances[..., POSITION, bias].detach())
    in_flight = process[:, IN_FLIGHT].sum(dim=1)
    return torch.stack(
        [
            own.sum(dim=(1, 2)) + prior[:, : SPIN.start].sum(dim=1),
            prior[:, SPIN].sum(dim=1),
            prior[:, STATE_DIM:].sum(dim=1),
            jitter.sum(dim=(1, 2, 3)) + memory.sum(dim=1) + (later * predicted).sum(dim=1),
            process.sum(dim=1) - in_flight,
            in_flight,
            (white.sum(dim=-1) * predicted).sum(dim=1),
        ],
        dim=1,
    )


def _trace(matrices: Tensor) -> Tensor:
    """(...) of matrices (..., 3, 3)."""
    return torch.diagonal(matrices, dim1=-2, dim2=-1).sum(dim=-1)
