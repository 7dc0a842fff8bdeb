"""The two networks of the diffusion model: an encoder of the observations and a denoiser of the rest of the track.

The encoder turns observations at uneven stamps into tokens, which attend to each other. The denoiser is a temporal
convolution network over the future grid. It is causal, as motion is: the tail beyond a track's end, which nobody
measured, has no influence on the measured part.
"""

import math

import torch
from torch import Tensor, nn

from ballfg.learning.sequence.data import Batch
from ballfg.learning.sequence.frame import Frame

HEADS = 4
"""Of the attention between tokens and of the final pooling."""
WAVES = 8
"""Periods of the features of a place in time."""
SHORTEST_PERIOD, PERIOD_RANGE = 4.0, 256.0
"""Grid steps, and the ratio of the longest period to it: from a bounce to several tracks."""
LONG = 100.0
"""Grid steps by which a place in time is divided, to be of order one."""
DILATIONS = (1, 2, 4, 8, 16, 32, 1, 2)
"""Of the blocks; together they look back 132 grid steps."""


def place_features(steps: Tensor) -> Tensor:
    """(..., 2 WAVES + 1) features of places in time (...), in grid steps: the place itself, sines and cosines of it."""
    frequency = (2 * math.pi / SHORTEST_PERIOD) * torch.logspace(0, -math.log10(PERIOD_RANGE), WAVES, dtype=steps.dtype)
    phase = steps[..., None] * frequency
    return torch.cat([steps[..., None] / LONG, phase.sin(), phase.cos()], dim=-1)


PLACE = 2 * WAVES + 1
"""Length of `place_features`."""


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
        seen = frame.inward(batch.observed, batch)
        place = place_features(batch.observed_times / frame.step)
        settings = frame.settings(batch)[:, None].expand(-1, seen.shape[1], -1)
        padding = ~batch.seen
        tokens = self.inward(torch.cat([seen, place, settings], dim=-1).float())
        tokens = self.layers(tokens, src_key_padding_mask=padding)
        weights = self.score(tokens).masked_fill(padding[..., None], -torch.inf).softmax(dim=1)
        return self.outward(torch.einsum("bnh,bnw->bhw", weights, tokens).flatten(1))


class Block(nn.Module):
    """One gated causal convolution with a skip; the condition scales and shifts its normalised input.

    Its three taps lie `dilation` grid steps apart.
    """

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
