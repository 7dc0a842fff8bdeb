"""The LSTM baseline reads the observations by one recurrent network and predicts step by step by another."""

from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ballfg.learning.sequence.data import Batch
from ballfg.learning.sequence.model import Draw, SequenceModel

STRIDE = 0.05  # Units of the frame per grid step for an output of one, so that outputs are of order one
SHORTEST_STEP = 0.1
"""Least interval between observations, in grid steps, that a displacement is divided by, since stamps jitter."""


class LstmModel(SequenceModel):
    """Encoder and decoder. The decoder feeds on its own positions only, in training as in use, over the frame's grid.

    Observed step i enters as position, displacement per grid step since the one before, interval, and settings. The
    decoder's output is the displacement over the next grid step. Both hidden states have the same width.
    """

    def __init__(self, settings: int, points: int, width: int) -> None:
        super().__init__(settings, points)
        self.encoder = nn.LSTM(7 + settings, width, num_layers=2, batch_first=True)
        self.bridge = nn.Linear(width, 2 * width)
        self.cell = nn.LSTMCell(6 + settings, width)
        self.head = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 3))

    def losses(self, batch: Batch, draws: Sequence[Draw]) -> tuple[Tensor, Tensor]:
        """Mean squared error over the rest of each track; nothing is drawn."""
        positions = self.predict(batch)
        return self.errors(positions, batch), positions.detach()

    def predict(self, batch: Batch) -> Tensor:
        """See `SequenceModel`."""
        settings = self.frame.settings(batch).float()
        state = self._read(batch, settings)
        position = self.frame.inward(batch.last_observed[:, None], batch)[:, 0].float()
        stride = self.head(state[0])
        grid = []
        for _ in range(self.points_asked(batch)):
            state = self.cell(torch.cat([position, stride, settings], dim=-1), state)
            stride = self.head(state[0])
            position = position + STRIDE * stride
            grid.append(position)
        return self.path(torch.stack(grid, dim=1), batch)

    def _read(self, batch: Batch, settings: Tensor) -> tuple[Tensor, Tensor]:
        """The decoder's first state (b, width) twice, from the encoder's output at the last observation."""
        seen = self.frame.inward(batch.observed, batch)
        steps = batch.observed_times.diff(dim=1, prepend=batch.observed_times[:, :1]) / self.frame.step
        strides = seen.diff(dim=1, prepend=seen[:, :1]) / steps.clamp(min=SHORTEST_STEP)[..., None] / STRIDE
        given = settings[:, None].expand(-1, seen.shape[1], -1)
        outputs, _ = self.encoder(torch.cat([torch.cat([seen, strides, steps[..., None]], dim=-1).float(), given], -1))
        last = outputs[torch.arange(len(outputs)), batch.observed_count - 1]
        hidden, cell = self.bridge(last).chunk(2, dim=-1)
        return torch.tanh(hidden), cell
