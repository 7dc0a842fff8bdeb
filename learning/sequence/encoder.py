"""Reads observations of uneven stamps into one vector: each becomes a token, and tokens attend to each other."""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn

from ballfg.learning.sequence.data import Batch
from ballfg.learning.sequence.frame import Frame

HEADS = 4
"""Of the attention between tokens and of the one that gathers them."""
WAVES = 8
"""Periods by which a place in time is told."""
SHORTEST_PERIOD, PERIOD_RANGE = 4.0, 256.0
"""Grid steps, and the ratio of the longest period to it: from a bounce to several tracks."""
LONG = 100.0
"""Grid steps by which a place in time is divided, to be of order one."""


def place_features(steps: Tensor) -> Tensor:
    """(..., 2 WAVES + 1) features of places in time (...), in grid steps: the place itself, sines and cosines of it."""
    frequency = (2 * math.pi / SHORTEST_PERIOD) * torch.logspace(0, -math.log10(PERIOD_RANGE), WAVES, dtype=steps.dtype)
    phase = steps[..., None] * frequency
    return torch.cat([steps[..., None] / LONG, phase.sin(), phase.cos()], dim=-1)


PLACE = 2 * WAVES + 1
"""Length of `place_features`."""


class Encoder(nn.Module):
    """Transformer over observations, then attention pooling.

    Args:
        settings: length of the launcher's settings.
        width: of tokens and of the result.
        layers: of the transformer.
    """

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
        """(b, width) of the observed parts; what stands in padding plays no part."""
        seen = frame.inward(batch.observed, batch)
        place = place_features(batch.observed_times / frame.step)
        settings = frame.settings(batch)[:, None].expand(-1, seen.shape[1], -1)
        padding = ~batch.seen
        tokens = self.inward(torch.cat([seen, place, settings], dim=-1).float())
        tokens = self.layers(tokens, src_key_padding_mask=padding)
        weights = self.score(tokens).masked_fill(padding[..., None], -torch.inf).softmax(dim=1)
        return self.outward(torch.einsum("bnh,bnw->bhw", weights, tokens).flatten(1))
