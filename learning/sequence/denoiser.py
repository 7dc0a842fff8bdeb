"""The denoiser: a causal temporal convolution network over the future grid, told what was observed.

Causal, as motion is: a point of the path depends on earlier points only. So the tail beyond a track's end, which nobody
measured, has no influence on the part that was.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn

from ballfg.learning.sequence.encoder import PLACE, place_features

DILATIONS = (1, 2, 4, 8, 16, 32, 1, 2)
"""Of the blocks: together they look back 132 grid steps."""


class Block(nn.Module):
    """One gated causal convolution with a skip; the condition scales and shifts its normalised input.

    Args:
        width: channels.
        dilation: grid steps between its three taps.
        condition: length of the condition.
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
    """The clean path from a noisy one.

    Args:
        width: channels.
        condition: length of the vector that tells what was observed.
    """

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
