"""What training found out beside a model's own parameters: the noise, and what launcher settings mean."""

import math
from collections.abc import Mapping
from dataclasses import dataclass, field

from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.tracks import TrackNoise


@dataclass(frozen=True)
class Trained:
    """Learned noise and launcher, to be used by whoever estimates with the model.

    Attributes:
        process_noise: values by name, names as in `ballfg.factors.noise.ProcessNoise`; what is not named is not
            learned.
        position_scale: standard deviation of a measured position in multiples of what its dataset says.
        launcher: spin of a launch from its settings; None: not learned.
        spin_noise: rad/s, standard deviation per axis of the launcher's spin; None: not learned.
        rooms: names of the datasets that trained; none: not known.
        elsewhere: noise of motion, bounces and spins that whole tracks showed in training, for use in other rooms.

    Raises: ValueError: if a noise is negative or not finite, or zero where that makes an estimate impossible.
    """

    process_noise: Mapping[str, float] = field(default_factory=dict)
    position_scale: float = 1.0
    launcher: SpinEmbedding | None = None
    spin_noise: float | None = None
    rooms: tuple[str, ...] = ()
    elsewhere: TrackNoise | None = None

    def is_foreign(self, room: str) -> bool:
        """Whether a room, by the name of its dataset, had no part in a training whose rooms are known."""
        return self.elsewhere is not None and room not in self.rooms

    def __post_init__(self) -> None:
        for name, value in self.process_noise.items():
            if not (math.isfinite(value) and value >= 0.0):
                raise ValueError(f"process_noise['{name}'] must be finite and not negative; got {value}.")
        for name, sigma in (("position_scale", self.position_scale), ("spin_noise", self.spin_noise)):
            if sigma is not None and not (math.isfinite(sigma) and sigma > 0.0):
                raise ValueError(f"{name} must be positive and finite; got {sigma}.")
