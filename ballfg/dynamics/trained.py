"""Holds the noise and the launcher that were learned together with a model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from ballfg.tracks.noise import TrackNoise

if TYPE_CHECKING:
    from ballfg.dynamics.networks.spin_embedding import SpinEmbedding


@dataclass(frozen=True)
class Trained:
    """Learned noise and launcher, for every estimate with the model.

    Attributes:
        process_noise: learned values by name, names as in `ballfg.factors.noise.ProcessNoise`.
        position_scale: standard deviation of a measured position in multiples of the dataset's.
        launcher: spin of a launch from its settings; None: not learned.
        spin_noise: rad/s, standard deviation per axis of the launcher's spin; None: not learned.
        rooms: names of the training datasets; empty: unknown.
        elsewhere: noise of motion, bounces and spins estimated from whole training tracks, for other rooms.

    Raises: ValueError: if a noise is negative or not finite, or zero where that makes an estimate impossible.
    """

    process_noise: Mapping[str, float] = field(default_factory=dict)
    position_scale: float = 1.0
    launcher: SpinEmbedding | None = None
    spin_noise: float | None = None
    rooms: tuple[str, ...] = ()
    elsewhere: TrackNoise | None = None

    def is_foreign(self, room: str) -> bool:
        """True if a room, by the name of its dataset, is not among the known training rooms."""
        return self.elsewhere is not None and room not in self.rooms

    def __post_init__(self) -> None:
        for name, value in self.process_noise.items():
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"process_noise['{name}'] must be finite and not negative; got {value}.")
        for name, sigma in (("position_scale", self.position_scale), ("spin_noise", self.spin_noise)):
            if sigma is not None and not (math.isfinite(sigma) and sigma > 0.0):
                raise ValueError(f"{name} must be positive and finite; got {sigma}.")
