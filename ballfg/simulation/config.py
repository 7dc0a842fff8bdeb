"""What a simulation is: how many tracks, of which ball, with which noise, and what nobody declares."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from typing import Any

from ballfg.checks import check_count, check_range
from ballfg.dynamics import Effect
from ballfg.simulation.balls import BallKind, table_tennis
from ballfg.simulation.settings import Settings, all_settings

MAX_TRACKS = 10_000_000
MAX_SEED = 2**63 - 1
LARGEST_JITTER = 0.15
"""Largest jitter sigma, as a share of the frame interval: stamps then keep their order (see `measure.py`)."""


@dataclass(frozen=True)
class MeasurementNoise:
    """What happens between the ball and the file. Every value may be zero.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    position: float = 0.003
    """m, standard deviation of each measured coordinate."""

    dropout: float = 0.0
    """Probability that a frame is missing, for each frame by itself. Two frames of a track always remain."""

    jitter: float = 0.0
    """s, standard deviation of the written stamp about the true time; cut off at 3 sigma. At most 0.15 frames."""

    outliers: float = 0.0
    """Probability that a position is an outlier."""

    outlier_size: float = 0.1
    """m, typical distance of an outlier: in any direction, uniform between half and one and a half times this."""

    spin: float = 4.0
    """rad/s, standard deviation of each component of the spin labels."""

    def __post_init__(self) -> None:
        bounds = {
            "position": (0.0, 1.0),
            "dropout": (0.0, 0.95),
            "jitter": (0.0, 1.0),
            "outliers": (0.0, 1.0),
            "outlier_size": (0.0, 10.0),
            "spin": (0.0, 1000.0),
        }
        _check_fields(self, "noise", bounds)


@dataclass(frozen=True)
class ProcessNoise:
    """What the true motion does that no model foresees; continuous-time densities and kicks. Zero: none.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    acceleration: float = 0.0
    """m/s^1.5, white-noise density of the acceleration: over dt the variance of a velocity grows by its square dt."""

    spin: float = 0.0
    """rad/s^1.5, the same for the angular acceleration."""

    contact_velocity: float = 0.0
    """m/s, standard deviation of a kick to each velocity component after a contact; the ball always leaves upwards."""

    contact_spin: float = 0.0
    """rad/s, standard deviation of a kick to each spin component after a contact."""

    def __post_init__(self) -> None:
        bounds = {
            "acceleration": (0.0, 10.0),
            "spin": (0.0, 1000.0),
            "contact_velocity": (0.0, 2.0),
            "contact_spin": (0.0, 1000.0),
        }
        _check_fields(self, "process", bounds)

    @property
    def in_flight(self) -> bool:
        """Whether the free ball is disturbed."""
        return self.acceleration > 0 or self.spin > 0

    @property
    def in_contact(self) -> bool:
        """Whether contacts are disturbed."""
        return self.contact_velocity > 0 or self.contact_spin > 0


@dataclass(frozen=True)
class SimulationConfig:
    """A whole simulation. The same config gives the same tracks, to the byte.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    tracks: int = 717
    """Number of tracks; the paper has 717."""

    rate: float = 100.0
    """Hz, frames per second."""

    seed: int = 0
    """Of every random choice."""

    ball: BallKind = field(default_factory=table_tennis)
    """The ball, the model declared for it, its surface and its launcher."""

    settings: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """Levels by launcher setting (topspin, sidespin, speed), for those that are not to run through all levels."""

    noise: MeasurementNoise = field(default_factory=MeasurementNoise)
    """Of the measurement."""

    process: ProcessNoise = field(default_factory=ProcessNoise)
    """Of the motion."""

    undeclared: tuple[Effect, ...] = ()
    """Effects that act although no model file declares them; applied in this order."""

    spin_labels: bool = True
    """Whether the spin at the first sample is written as a label; the launcher's settings always are."""

    def __post_init__(self) -> None:
        check_count("tracks", self.tracks, 1, MAX_TRACKS)
        check_count("seed", self.seed, 0, MAX_SEED)
        object.__setattr__(self, "rate", check_range("rate", self.rate, 5.0, 10_000.0))
        self.combinations()
        if self.noise.jitter * self.rate > LARGEST_JITTER:
            raise ValueError(
                f"jitter must be at most {LARGEST_JITTER:g} frames, {LARGEST_JITTER / self.rate:g} s at "
                f"{self.rate:g} Hz, or stamps change places; got {self.noise.jitter:g} s. Lower jitter or rate."
            )

    def combinations(self) -> Settings:
        """(m, 3) the launcher settings that are shot."""
        return all_settings(self.settings)


def _check_fields(config: Any, group: str, bounds: Mapping[str, tuple[float, float]]) -> None:
    for spec in fields(config):
        value = check_range(f"{group}.{spec.name}", getattr(config, spec.name), *bounds[spec.name])
        object.__setattr__(config, spec.name, value)
