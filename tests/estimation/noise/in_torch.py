"""The Kalman filter over linearised tracks once more, in torch's own operations, which torch differentiates."""

import torch
from torch import Tensor

from ballfg.estimation.noise.filter_code import NEXT_FROM, NEXT_TAIL
from ballfg.estimation.noise.linear_filter import LinearFilter, Noise
from ballfg.state import POSITION, STATE_DIM


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
    transitions[..., : tracks.own, : tracks.own] = tracks.tracks.transitions
    process = noise.process.square().expand(tracks.count, -1)
    gathered[..., :STATE_DIM, :STATE_DIM] = torch.einsum("tk,tnkij->tnij", process, tracks.tracks.kicks)
    if tracks.biases:
        decay = torch.exp(-torch.diff(tracks.tracks.times, dim=1) / noise.memory_time[:, None])
        axes = torch.arange(tracks.own, tracks.width)
        transitions[..., axes, axes] = decay[..., None]
        gathered[..., axes, axes] = noise.memory[:, None, :] * (1.0 - decay.square())[..., None]
    return transitions, gathered


def run(tracks: LinearFilter, noise: Noise) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Means (t, n, w) and covariances (t, n, w, w) after each sample, (t,) the densities of next samples, and (t, n)
    squared whitened innovations.
    """
    linear, observe, measured = tracks.tracks, measure(tracks), tracks.measured(noise)
    transitions, gathered = motion(tracks, noise)
    prior = linear.prior_variances(noise.spin_prior, noise.spin_label, noise.coefficients, tracks.velocity_prior)
    biases = noise.memory.expand(tracks.count, -1)[:, : tracks.biases]
    covariance = torch.diag_embed(torch.cat((prior, biases), dim=1))
    mean = torch.nn.functional.pad(linear.starts, (0, tracks.biases))
    means, covariances, nis, nll = [], [], [], torch.zeros(tracks.count, dtype=torch.float64)
    for k in range(tracks.samples):
        if k:
            step = transitions[:, k - 1]
            mean = (step @ mean[..., None])[..., 0]
            mean = mean + torch.nn.functional.pad(linear.offsets[:, k - 1], (0, tracks.biases))
            covariance = step @ covariance @ step.mT + gathered[:, k - 1]
        innovation = (linear.errors[:, k] - mean @ observe.T)[..., None]
        spread = observe @ covariance @ observe.T + measured[:, k]
        square = (innovation.mT @ torch.linalg.solve(spread, innovation))[:, 0, 0]
        if k >= NEXT_FROM:
            loss = torch.where(square < NEXT_TAIL**2, square / 2, NEXT_TAIL * square.sqrt() - NEXT_TAIL**2 / 2)
            nll = nll + linear.used[:, k] * (loss + torch.logdet(spread) / 2)
        gain = torch.linalg.solve(spread, observe @ covariance).mT * linear.used[:, k][:, None, None]
        mean = mean + (gain @ innovation)[..., 0]
        kept = torch.eye(tracks.width, dtype=torch.float64) - gain @ observe
        covariance = kept @ covariance @ kept.mT + gain @ measured[:, k] @ gain.mT
        means.append(mean)
        nis.append(square)
        covariances.append(covariance)
    return torch.stack(means, dim=1), torch.stack(covariances, dim=1), nll, torch.stack(nis, dim=1)
