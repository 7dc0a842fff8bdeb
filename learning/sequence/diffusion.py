"""The conditional diffusion baseline generates the rest of a track from noise, given the observations.

The network predicts the clean path at every noise level. The last level is pure noise, so that training sees nothing of
the answer there. Source: J. Ho, A. Jain, P. Abbeel 2020 (training); J. Song, C. Meng, S. Ermon 2021 (sampling without
noise); S. Lin et al. 2024 (zero terminal signal-to-noise ratio).

The encoder turns observations at uneven stamps into tokens, which attend to each other. The denoiser is a temporal
convolution network over the future grid. It is causal, as motion is: the tail beyond a track's end, which nobody
measured, has no influence on the measured part.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from ballfg.learning.sequence.data import Batch
from ballfg.learning.sequence.model import Draw, Frame, SequenceModel

LEVELS = 1000  # Noise levels; the last is pure noise
DRAWS = 2  # Noise levels per track and epoch; the observations are encoded once for all of them
PURE = 0.2  # Share of the draws at pure noise, where sampling starts and its first step decides most
STEPS = 4  # Steps of the sampling. On simulated tracks ten steps predict no better
SAMPLES = 4  # Paths whose mean is the prediction: 6 % less error than one path on simulated tracks; eight gain no more
START_SEED = 0  # Seed of the noise that sampling starts from, the same for every track
NOISE_STREAM = 1  # Makes the noise differ from the augmentation of the same seed, epoch and track
HEADS = 4  # Number of heads of the attention between tokens and of the final pooling
WAVES = 8  # Periods of the features of a place in time
SHORTEST_PERIOD, PERIOD_RANGE = 4.0, 256.0
"""Grid steps, and the ratio of the longest period to it: from a bounce to several tracks."""
LONG = 100.0  # Grid steps by which a place in time is divided, to be of order one
DILATIONS = (1, 2, 4, 8, 16, 32, 1, 2)  # Dilations of the blocks; together they look back 132 grid steps


PLACE = 2 * WAVES + 1  # Length of `place_features`


def place_features(steps: Tensor) -> Tensor:
    """(..., PLACE) features of places in time (...), in grid steps: the place itself, sines and cosines of it."""
    frequency = (2 * math.pi / SHORTEST_PERIOD) * torch.logspace(0, -math.log10(PERIOD_RANGE), WAVES, dtype=steps.dtype)
    phase = steps[..., None] * frequency
    return torch.cat([steps[..., None] / LONG, phase.sin(), phase.cos()], dim=-1)


class Encoder(nn.Module):
    """Transformer over observations, then attention pooling; tokens and result have the same width."""

    def __init__(self, settings: int, width: int, layers: int) -> None:
        super().__init__()
        self.inward = nn.Linear(3 + PLACE + settings, width)
        layer = nn.TransformerEncoderLayer(
            width, HEADS, 2 * width, dropout=0.0, activation="gelu", batch_first=True, norm_first=True
        )
        self.layers = nn.TransformerEncoder(layer, layers, enable_nested_tensor=False)
        self.score = nn.Linear(width, HEADS)
        self.outward = nn.Linear(HEADS * width, width)

    def forward(self, batch: Batch, frame: Frame) -> Tensor:
        """(b, width) of the observed parts; the padding has no influence."""
        seen, padding = frame.inward(batch.observed, batch), ~batch.seen
        place = place_features(batch.observed_times / frame.step)
        settings = frame.settings(batch)[:, None].expand(-1, seen.shape[1], -1)
        tokens = self.inward(torch.cat([seen, place, settings], dim=-1).float())
        tokens = self.layers(tokens, src_key_padding_mask=padding)
        weights = self.score(tokens).masked_fill(padding[..., None], -torch.inf).softmax(dim=1)
        return self.outward(torch.einsum("bnh,bnw->bhw", weights, tokens).flatten(1))


class Block(nn.Module):
    """A gated causal convolution with a skip, its taps `dilation` steps apart; the condition modulates its input."""

    def __init__(self, width: int, dilation: int, condition: int) -> None:
        super().__init__()
        self.past = 2 * dilation
        self.norm = nn.LayerNorm(width)
        self.modulate = nn.Linear(condition, 2 * width)
        self.mix = nn.Conv1d(width, 2 * width, kernel_size=3, dilation=dilation)
        self.outward = nn.Conv1d(width, width, kernel_size=1)

    def forward(self, hidden: Tensor, condition: Tensor) -> Tensor:
        """(b, width, points) from hidden (b, width, points) and condition (b, condition)."""
        scale, shift = self.modulate(condition)[..., None].chunk(2, dim=1)
        inner = self.norm(hidden.transpose(1, 2)).transpose(1, 2) * (1 + scale) + shift
        gate, value = self.mix(nn.functional.pad(inner, (self.past, 0))).chunk(2, dim=1)
        return hidden + self.outward(nn.functional.silu(gate) * value)


class Denoiser(nn.Module):
    """The clean path from a noisy one, given a vector of length `condition` that describes the observations."""

    def __init__(self, width: int, condition: int) -> None:
        super().__init__()
        self.inward = nn.Conv1d(3 + PLACE, width, kernel_size=1)
        self.level = nn.Sequential(nn.Linear(PLACE, condition), nn.SiLU(), nn.Linear(condition, condition))
        self.blocks = nn.ModuleList(Block(width, dilation, condition) for dilation in DILATIONS)
        self.outward = nn.Conv1d(width, 3, kernel_size=1)

    def forward(self, noisy: Tensor, level: Tensor, condition: Tensor) -> Tensor:
        """(b, points, 3) clean, from noisy (b, points, 3), the noise level's number (b,) and condition (b, c)."""
        place = place_features(torch.arange(1, noisy.shape[1] + 1, dtype=noisy.dtype))
        hidden = self.inward(torch.cat([noisy, place.expand(len(noisy), -1, -1)], dim=-1).transpose(1, 2))
        told = nn.functional.silu(condition + self.level(place_features(level.to(noisy.dtype))))
        for block in self.blocks:
            hidden = block(hidden, told)
        return self.outward(hidden).transpose(1, 2)


def noise_schedule() -> Any:
    """Cosine levels from nearly clean to pure noise. Raises: ValueError: without the package diffusers."""
    try:
        from diffusers import DDIMScheduler
    except ImportError as error:
        raise ValueError(
            f"kind diffusion must have the package diffusers; got {error}. Install it: pip install 'ballfg[diffusion]'."
        ) from error
    return DDIMScheduler(
        num_train_timesteps=LEVELS,
        beta_schedule="squaredcos_cap_v2",
        prediction_type="sample",
        rescale_betas_zero_snr=True,
        timestep_spacing="trailing",
        clip_sample=False,
    )


class DiffusionModel(SequenceModel):
    """Encoder, denoiser of `width` channels, and noise schedule; encoder and condition are wider in proportion."""

    def __init__(self, settings: int, points: int, width: int) -> None:
        super().__init__(settings, points)
        condition = 2 * width
        self.encoder = Encoder(settings, 3 * width // 2, layers=2)
        inward = nn.Linear(3 * width // 2 + settings, condition)
        self.bridge = nn.Sequential(inward, nn.SiLU(), nn.Linear(condition, condition))
        self.denoiser = Denoiser(width, condition)
        self.schedule = noise_schedule()

    def losses(self, batch: Batch, draws: Sequence[Draw]) -> tuple[Tensor, Tensor]:
        """Mean squared error of the denoised paths, over the grid points that were measured and over the draws."""
        points = self.points_asked(batch)
        clean, known = self.frame.on_grid(self.frame.inward(batch.rest, batch), batch, points)
        clean = clean.float()
        levels, noise = self._draw(draws, points)
        noisy = self.schedule.add_noise(clean.repeat_interleave(DRAWS, dim=0), noise, levels)
        denoised = self.denoiser(noisy, levels, self._condition(batch, DRAWS)).unflatten(0, (-1, DRAWS))
        error = (denoised - clean[:, None]).square().sum(-1).mean(dim=1) * known
        losses = error.sum(1) / known.sum(1).clamp(min=1)
        return losses, self.path(denoised.detach().mean(dim=1), batch)

    def predict(self, batch: Batch) -> Tensor:
        """The mean of the paths that sampling gives from fixed starts; see `SequenceModel`."""
        generator = torch.Generator().manual_seed(START_SEED)
        starts = torch.randn(SAMPLES, self.points, 3, generator=generator)[:, : self.points_asked(batch)]
        told, path = self._condition(batch, SAMPLES), starts.repeat(len(batch.times), 1, 1)
        self.schedule.set_timesteps(STEPS)
        for level in self.schedule.timesteps:
            clean = self.denoiser(path, level.expand(len(told)), told)
            path = self.schedule.step(clean, level, path, eta=0.0).prev_sample
        return self.path(path.unflatten(0, (-1, SAMPLES)).mean(dim=1), batch)

    def _condition(self, batch: Batch, times: int) -> Tensor:
        """(b times, c) condition from observations and launcher settings, each so many times."""
        settings = self.frame.settings(batch).float()
        told: Tensor = self.bridge(torch.cat([self.encoder(batch, self.frame), settings], dim=-1))
        return told.repeat_interleave(times, dim=0)

    def _draw(self, draws: Sequence[Draw], points: int) -> tuple[Tensor, Tensor]:
        """Levels (b DRAWS,) and noise (b DRAWS, points, 3), the draws of a track side by side."""
        levels, noise = [], []
        for draw in draws:
            generator = np.random.default_rng([*draw, NOISE_STREAM])
            level = generator.integers(LEVELS, size=DRAWS)
            levels.append(np.where(generator.random(DRAWS) < PURE, LEVELS - 1, level))
            noise.append(generator.standard_normal((DRAWS, self.points, 3), dtype=np.float32)[:, :points])
        return torch.from_numpy(np.concatenate(levels)), torch.from_numpy(np.concatenate(noise))
