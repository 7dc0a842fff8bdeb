"""Holds tracks as padded tensors: observations, launcher settings, and the times to predict."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Self

import numpy as np
import torch
from numpy.typing import ArrayLike
from torch import Tensor
from torch.nn.utils.rnn import pad_sequence

from ballfg.checks import shown
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.learning.augment import apply
from ballfg.tracks import Track

LEAST_OBSERVED = 2  # Fewest observations that show a direction


@dataclass(frozen=True)
class LauncherSettings:
    """The labels of a track that are its launcher's settings; none: a model sees observations only.

    Labels in `categories` are text, one-hot over the values given there; the others are numbers.
    """

    labels: tuple[str, ...] = ()
    categories: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Number of numbers."""
        return 0 if self.reader is None else len(self.reader.names)

    def of(self, track: Track) -> Tensor:
        """(k,) the settings of a track, in the units of their labels.

        Raises: ValueError: if a label is missing, or is not a number or one of the known categories.
        """
        if self.reader is None:
            return torch.zeros(0, dtype=torch.float64)
        settings = self.reader.settings(track.labels)
        if settings is None:
            got = {name: track.labels.get(name) for name in self.labels}
            raise ValueError(
                f"labels of track {shown(track.name)} must be known launcher settings; got {got}. "
                "Complete them or leave the track out."
            )
        return settings

    @cached_property
    def reader(self) -> SpinEmbedding | None:
        """Reads labels by the rules of the dynamics models; its weights are not used."""
        return SpinEmbedding(self.labels, self.categories) if self.labels else None


@dataclass(frozen=True)
class Example:
    """One track, cut where its observed part ends. Times count from the last observed sample."""

    observed_times: Tensor  # (n,) s, increasing to 0
    observed: Tensor  # (n, 3) m, world frame
    settings: Tensor  # (k,) the launcher's settings as numbers
    times: Tensor  # (m,) s, increasing and positive, to predict
    rest: Tensor  # (m, 3) m, measured there; nan without a measurement

    def seen_from(self, angle: Tensor, shift: Tensor) -> Self:
        """The same shot, rotated by () rad and shifted by (2,) m (`augment.apply`); launcher settings stay the same."""
        return replace(self, observed=apply(self.observed, angle, shift), rest=apply(self.rest, angle, shift))


@dataclass(frozen=True)
class Batch:
    """Some examples side by side, padded at their ends: times by the last one, positions by zero.

    Attributes:
        observed_times, observed, settings, times, rest: (b, n) s, (b, n, 3) m, (b, k), (b, m) s, (b, m, 3) m.
        observed_count: (b,) int64, samples that are not padding.
        asked: (b, m) bool, false in the padding.
    """

    observed_times: Tensor
    observed: Tensor
    observed_count: Tensor
    settings: Tensor
    times: Tensor
    rest: Tensor
    asked: Tensor

    @property
    def last_observed(self) -> Tensor:
        """(b, 3) m, the last observed position of each track."""
        rows = torch.arange(len(self.observed))
        return self.observed[rows, self.observed_count - 1]

    @property
    def seen(self) -> Tensor:
        """(b, n) bool, false in the padding of the observed part."""
        return torch.arange(self.observed.shape[1]) < self.observed_count[:, None]


def example(track: Track, observed: int, settings: Tensor, times: ArrayLike | None = None) -> Example:
    """Cut a track after its first `observed` samples, two or more; settings: (k,) of its launcher.

    Args: times: (m,) s in the track's own time; None: the stamps of the rest, with their measurements.
    Raises: ValueError: too few samples, nothing to predict, or times that do not increase from the last observed one.
    """
    if not LEAST_OBSERVED <= observed <= len(track):
        raise ValueError(
            f"observed must lie in {LEAST_OBSERVED} .. {len(track)}, the samples of track {shown(track.name)}; got "
            f"{observed}. Observe fewer samples or leave the track out."
        )
    origin = float(track.times[observed - 1])
    if times is None:
        asked, rest = track.times[observed:], track.positions[observed:]
    else:
        asked = np.asarray(times, dtype=np.float64)
        rest = np.full((*asked.shape, 3), np.nan)
    if asked.ndim != 1 or len(asked) == 0:
        raise ValueError(
            f"times of track {shown(track.name)} must have shape (m,) with m >= 1; got {asked.shape}. "
            "Ask for a time after the observed part, or observe fewer samples."
        )
    late = np.diff(asked, prepend=origin) > 0
    if not late.all():
        at = int(np.argmin(late))
        raise ValueError(
            f"times of track {shown(track.name)} must increase from the last observed stamp {origin:g} s; times[{at}]="
            f"{asked[at]:g}. Sort them and drop what is observed."
        )
    return Example(
        observed_times=torch.from_numpy(track.times[:observed] - origin),
        observed=torch.from_numpy(track.positions[:observed]),
        settings=settings.detach().to(torch.float64),
        times=torch.from_numpy(asked - origin),
        rest=torch.from_numpy(rest),
    )


def collate(examples: Sequence[Example]) -> Batch:
    """Examples as one batch, in their order. At least one; all with settings of the same length."""
    padded = {
        name: pad_sequence([getattr(item, name) for item in examples], batch_first=True)
        for name in ("observed_times", "observed", "times", "rest")
    }
    counts = torch.tensor([len(item.observed_times) for item in examples])
    asked = torch.tensor([len(item.times) for item in examples])[:, None]
    mask = torch.arange(padded["times"].shape[1]) < asked
    padded["times"] = torch.where(mask, padded["times"], padded["times"].gather(1, asked - 1))
    return Batch(
        observed_count=counts, settings=torch.stack([item.settings for item in examples]), asked=mask, **padded
    )
