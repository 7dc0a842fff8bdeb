"""The launcher's settings as numbers."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import torch
from torch import Tensor

from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.tracks import Track


@dataclass(frozen=True)
class LauncherSettings:
    """The labels of a track that are its launcher's settings; none: a model sees observations only.

    Attributes:
        labels: names; those in `categories` are text, one-hot over their values, the others are numbers.
        categories: the values that each text label takes.
    """

    labels: tuple[str, ...] = ()
    categories: Mapping[str, tuple[str, ...]] = field(default_factory=dict)

    @property
    def size(self) -> int:
        """Number of numbers."""
        return len(self._reader().names) if self.labels else 0

    def of(self, track: Track) -> Tensor:
        """(k,) the settings of a track, in the units of their labels.

        Raises: ValueError: if a label is missing, or is not a number or one of the known categories.
        """
        if not self.labels:
            return torch.zeros(0, dtype=torch.float64)
        settings = self._reader().settings(track.labels)
        if settings is None:
            got = {name: track.labels.get(name) for name in self.labels}
            raise ValueError(
                f"labels of track {track.name!r} must be known launcher settings; got {got}. "
                "Complete them or leave the track out."
            )
        return settings

    def _reader(self) -> SpinEmbedding:
        """Reads labels by the rules of the dynamics models; its weights are not used."""
        return SpinEmbedding(self.labels, self.categories)
