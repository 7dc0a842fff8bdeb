"""Defines sequence models, which predict the rest of tracks from their observed part, and the frame they work in.

In the frame all is of order one, relative to the last observed place. Only shifts and scales: no direction is singled
out and nothing is extrapolated. Height keeps its origin, since the table lies at one height for all tracks.
"""

import math
from abc import ABC, abstractmethod
from collections.abc import Sequence

import torch
from torch import Tensor, nn

from ballfg.learning.sequence.data import Batch, Example, collate

LARGEST_GAP = 2.5  # Steps between two samples beyond which nothing is interpolated, since a bounce may lie between them
ROUND = 1e-6  # Share of a step by which stamps may miss the grid and still count as on it; files round them
Draw = tuple[int, int, int]  # Seed, epoch and track, from which the random numbers of one track's loss derive


class Frame(nn.Module):
    """Scales of a dataset, and the regular grid of times on which its future is predicted.

    All are buffers: they are kept with a model's weights.

    Attributes:
        step: () s between grid times; the grid is step, 2 step ... points * step after the last observed sample.
        horizontal: () m, unit of x and y.
        height: (2,) m, origin and unit of z.
        settings_mean, settings_unit: (k,) of the launcher's settings.
    """

    step: Tensor
    horizontal: Tensor
    height: Tensor
    settings_mean: Tensor
    settings_unit: Tensor

    def __init__(self, settings: int) -> None:
        super().__init__()
        self.register_buffer("step", torch.ones((), dtype=torch.float64))
        self.register_buffer("horizontal", torch.ones((), dtype=torch.float64))
        self.register_buffer("height", torch.tensor([0.0, 1.0], dtype=torch.float64))
        self.register_buffer("settings_mean", torch.zeros(settings, dtype=torch.float64))
        self.register_buffer("settings_unit", torch.ones(settings, dtype=torch.float64))

    def fit(self, examples: Sequence[Example]) -> int:
        """Set the scales from some examples.

        Returns: the number of grid points that reach to the end of the longest.
        Raises: ValueError: if nothing moves, so that there is no scale.
        """
        batch = collate(examples)
        intervals = torch.cat([item.observed_times.diff() for item in examples])
        self.step.copy_(intervals.median())
        away = (batch.rest - batch.last_observed[:, None])[batch.asked]
        self.horizontal.copy_(away[:, :2].square().mean().sqrt())
        z = torch.cat([batch.rest[..., 2][batch.asked], batch.observed[..., 2][batch.seen]])
        self.height.copy_(torch.stack([z.mean(), z.std()]))
        if not (self.units > 0).all():
            raise ValueError(f"tracks must move horizontally and in height; their scales are {self.units.tolist()} m.")
        self.settings_mean.copy_(batch.settings.mean(dim=0))
        spread = (batch.settings - self.settings_mean).square().mean(dim=0).sqrt()
        self.settings_unit.copy_(torch.where(spread > 0, spread, torch.ones_like(spread)))
        return math.ceil(float(batch.times.max() / self.step) - ROUND)

    @property
    def units(self) -> Tensor:
        """(3,) m, units of x, y and z."""
        return torch.stack([self.horizontal, self.horizontal, self.height[1]])

    def origin(self, batch: Batch) -> Tensor:
        """(b, 3) m: x and y of the last observed sample, z of the frame."""
        last = batch.last_observed
        return torch.cat([last[:, :2], self.height[0].expand(len(last), 1)], dim=-1)

    def inward(self, positions: Tensor, batch: Batch) -> Tensor:
        """World positions (b, m, 3) m in the frame."""
        return (positions - self.origin(batch)[:, None]) / self.units

    def outward(self, local: Tensor, batch: Batch) -> Tensor:
        """The inverse of `inward`."""
        return local * self.units + self.origin(batch)[:, None]

    def settings(self, batch: Batch) -> Tensor:
        """(b, k) settings of order one; those that never change are 0."""
        return (batch.settings - self.settings_mean) / self.settings_unit

    def at_times(self, path: Tensor, times: Tensor) -> Tensor:
        """A path on the grid, at any times: linear between its points and beyond the last.

        Args: path: (b, points + 1, 3) at 0, step, 2 step ...  times: (b, m) s, >= 0.
        Returns: (b, m, 3).
        """
        place = times / self.step
        cell = place.floor().long().clamp(max=path.shape[1] - 2)
        return _between(path, cell, (place - cell).to(path.dtype))

    def on_grid(self, local: Tensor, batch: Batch, points: int) -> tuple[Tensor, Tensor]:
        """The measured rest of a batch, local as from `inward` (b, m, 3), on the grid, linear between samples.

        Returns: (values (b, points, 3), known (b, points) bool); a point is unknown beyond the last sample and inside
            a gap of more than LARGEST_GAP steps.
        """
        start = self.inward(batch.last_observed[:, None], batch)
        values = torch.cat([start, local], dim=1)
        knots = torch.cat([torch.zeros_like(batch.times[:, :1]), batch.times], dim=1)
        grid = (torch.arange(1, points + 1, dtype=knots.dtype) * self.step).expand(len(knots), points).contiguous()
        slack = ROUND * self.step
        sorting = torch.where(torch.cat([batch.asked[:, :1], batch.asked], dim=1), knots, torch.inf)
        right = torch.searchsorted(sorting, grid - slack).clamp(1, knots.shape[1] - 1)
        low, high = knots.gather(1, right - 1), knots.gather(1, right)
        known = torch.minimum((grid - low).abs(), (grid - high).abs()) <= slack
        known |= (grid < batch.times[:, -1:]) & (high - low <= LARGEST_GAP * self.step)
        weight = torch.where(known, (grid - low) / (high - low).clamp(min=slack), torch.zeros_like(grid))
        return _between(values, right - 1, weight), known


def _between(values: Tensor, row: Tensor, weight: Tensor) -> Tensor:
    """(b, m, 3) at a weight (b, m) of the way from one row (b, m) of values (b, n, 3) to the next."""
    index, weight = row[..., None].expand(-1, -1, values.shape[-1]), weight[..., None]
    return (1 - weight) * values.gather(1, index) + weight * values.gather(1, index + 1)


class SequenceModel(nn.Module, ABC):
    """A network with the frame it works in. Networks compute in float32, positions outside are float64.

    No track's result depends on the others in its batch, beyond rounding. Subclasses take the width of their hidden
    states as a third argument.

    Args: settings: number of the launcher's settings.  points: number of grid points that are predicted.
    """

    def __init__(self, settings: int, points: int) -> None:
        super().__init__()
        self.points, self.frame = points, Frame(settings)

    @abstractmethod
    def losses(self, batch: Batch, draws: Sequence[Draw]) -> tuple[Tensor, Tensor]:
        """The losses of a batch.

        Returns: (losses, positions): (b,) differentiable, in squared units of the frame; (b, m, 3) m, the rest as
            predicted in training, without gradient.
        """

    @abstractmethod
    def predict(self, batch: Batch) -> Tensor:
        """(b, m, 3) m, world positions at the batch's times. The same batch gives the same bytes."""

    def errors(self, positions: Tensor, batch: Batch) -> Tensor:
        """(b,) mean squared error of predicted positions (b, m, 3) m, in squared units of the frame."""
        error = ((positions - batch.rest) / self.frame.units).square().sum(-1) * batch.asked
        return error.sum(1) / batch.asked.sum(1)

    def points_asked(self, batch: Batch) -> int:
        """Number of grid points up to the last requested time, `points` at most."""
        return max(1, min(self.points, math.ceil(float(batch.times.max() / self.frame.step) - ROUND)))

    def path(self, grid: Tensor, batch: Batch) -> Tensor:
        """World positions (b, m, 3) m at the times asked, from local positions (b, p, 3) on the grid's first points."""
        start = self.frame.inward(batch.last_observed[:, None], batch)
        return self.frame.outward(self.frame.at_times(torch.cat([start, grid.double()], dim=1), batch.times), batch)


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
