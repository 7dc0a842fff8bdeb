"""The Kalman filter over linearised tracks once more, in torch's own operations, which torch differentiates."""

from dataclasses import fields

import torch
from torch import Tensor

from ballfg.estimation.noise.filter_code import NEXT_FROM, NEXT_TAIL
from ballfg.estimation.noise.linear_filter import LinearFilter, Noise
from ballfg.estimation.settings import LEAST_NOISE
from ballfg.estimation.smoother.problem import START_POSITION_SIGMA
from ballfg.state import POSITION, STATE_DIM


def leaves(noise: Noise) -> Noise:
    """The noise as tensors that derivatives are taken by."""
    return Noise(**{f.name: torch.tensor(getattr(noise, f.name), requires_grad=True) for f in fields(noise)})


def measured(tracks: LinearFilter, noise: Noise) -> Tensor:
    """(t, n, 3, 3) m^2, covariance of the white error of a measured position."""
    way = torch.from_numpy(tracks.tracks.velocities)
    along = noise.stamp_jitter[:, None, None, None] * way[..., :, None] * way[..., None, :]
    white = noise.position[:, None, :] * torch.from_numpy(tracks.tracks.white)
    return along + torch.diag_embed(white.clamp_min(LEAST_NOISE).square())


def prior(tracks: LinearFilter, noise: Noise) -> Tensor:
    """(t, d) variances of the first state and the coefficients."""
    linear, count = tracks.tracks, tracks.count
    labelled, spreads = torch.from_numpy(linear.labelled), torch.from_numpy(linear.label_spreads)
    spins = torch.where(labelled, spreads * noise.spin_label, noise.spin_prior)[:, None].expand(count, 3)
    grouped = torch.from_numpy(linear.group_sigmas)
    spins = torch.where(grouped.isnan(), spins, grouped).square()
    fixed = torch.tensor([START_POSITION_SIGMA**2] * 3 + [tracks.velocity_prior**2] * 3, dtype=torch.float64)
    own = (noise.coefficients * torch.from_numpy(linear.coefficient_sigmas)).square()
    return torch.cat((fixed.expand(count, 6), spins, own.expand(count, -1)), dim=1)


def measure(tracks: LinearFilter) -> Tensor:
    """(3, w) what is measured of state, coefficients and biases."""
    result = torch.zeros((3, tracks.width), dtype=torch.float64)
    result[:, POSITION] = torch.eye(3, dtype=torch.float64)
    result[:, tracks.own :] = torch.eye(3, dtype=torch.float64)[:, : tracks.biases]
    return result


def motion(tracks: LinearFilter, noise: Noise) -> tuple[Tensor, Tensor]:
    """(t, n - 1, w, w) transitions and covariances gathered, of state, coefficients and biases."""
    shape = (tracks.count, tracks.samples - 1, tracks.width, tracks.width)
    transitions, gathered = (torch.zeros(shape, dtype=torch.float64) for _ in range(2))
    transitions[..., : tracks.own, : tracks.own] = torch.from_numpy(tracks.tracks.transitions)
    process = noise.process.square().expand(tracks.count, -1)
    kicks = torch.from_numpy(tracks.tracks.kicks)
    gathered[..., :STATE_DIM, :STATE_DIM] = torch.einsum("tk,tnkij->tnij", process, kicks)
    if tracks.biases:
        decay = torch.exp(-torch.diff(torch.from_numpy(tracks.tracks.times), dim=1) / noise.memory_time[:, None])
        axes = torch.arange(tracks.own, tracks.width)
        transitions[..., axes, axes] = decay[..., None]
        gathered[..., axes, axes] = noise.memory[:, None, :] * (1.0 - decay.square())[..., None]
    return transitions, gathered


def run(tracks: LinearFilter, noise: Noise) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means (t, n, w) and covariances (t, n, w, w) after each sample, (t,) the densities of next samples, and (t, n)
    squared whitened innovations.
    """
    observe, white = measure(tracks), measured(tracks, noise)
    offsets, errors, used, starts = (
        torch.from_numpy(getattr(tracks.tracks, name)) for name in ("offsets", "errors", "used", "starts")
    )
    transitions, gathered = motion(tracks, noise)
    biases = noise.memory.expand(tracks.count, -1)[:, : tracks.biases]
    covariance = torch.diag_embed(torch.cat((prior(tracks, noise), biases), dim=1))
    mean = torch.nn.functional.pad(starts, (0, tracks.biases))
    means, covariances, nis, nll = [], [], [], torch.zeros(tracks.count, dtype=torch.float64)
    for k in range(tracks.samples):
        if k:
            step = transitions[:, k - 1]
            mean = (step @ mean[..., None])[..., 0]
            mean = mean + torch.nn.functional.pad(offsets[:, k - 1], (0, tracks.biases))
            covariance = step @ covariance @ step.mT + gathered[:, k - 1]
        innovation = (errors[:, k] - mean @ observe.T)[..., None]
        spread = observe @ covariance @ observe.T + white[:, k]
        square = (innovation.mT @ torch.linalg.solve(spread, innovation))[:, 0, 0]
        if k >= NEXT_FROM:
            loss = torch.where(square < NEXT_TAIL**2, square / 2, NEXT_TAIL * square.sqrt() - NEXT_TAIL**2 / 2)
            nll = nll + used[:, k] * (loss + torch.logdet(spread) / 2)
        gain = torch.linalg.solve(spread, observe @ covariance).mT * used[:, k][:, None, None]
        mean = mean + (gain @ innovation)[..., 0]
        kept = torch.eye(tracks.width, dtype=torch.float64) - gain @ observe
        covariance = kept @ covariance @ kept.mT + gain @ white[:, k] @ gain.mT
        means.append(mean)
        nis.append(square)
        covariances.append(covariance)
    return torch.stack(means, dim=1), torch.stack(covariances, dim=1), nll, torch.stack(nis, dim=1)
