"""What a synthetic recording is: which shots, seen by cameras with which clocks, shutter and noise."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from enum import IntEnum
from typing import Final, Literal

import numpy as np

from ballfg.checks import check_count, check_range
from ballfg.dynamics import AnalyticModel, Effect
from ballfg.simulation.balls import BallKind, table_tennis
from ballfg.simulation.composition import true_model
from ballfg.simulation.config import LARGEST_JITTER, MAX_SEED
from ballfg.simulation.settings import Settings, all_settings

MAX_SHOTS: Final = 10_000
COLOURS: Final = ("white", "orange")
LONGEST_EXPOSURE: Final = 0.95
"""As a share of the frame interval; a sensor needs the rest to be read out."""
_RANGES: Final = {
    "interval": (0.1, 60.0),
    "rate": (5.0, 2000.0),
    "exposure": (1e-5, 0.1),
    "dropout": (0.0, 0.95),
    "jitter": (0.0, 1.0),
    "noise": (0.0, 50.0),
    "flicker": (0.0, 0.5),
}


class SceneStream(IntEnum):
    """What a stream of random numbers is for; they begin where those of `ballfg.simulation.streams` never come."""

    START = 100
    DROPOUT = 101
    JITTER = 102
    NOISE = 103
    TEXTURE = 104
    PHASE = 105


def stream(seed: int, purpose: SceneStream, camera: int = 0) -> np.random.Generator:
    """The generator of one stream; `camera` is the number of the camera it serves."""
    return np.random.default_rng([seed, int(purpose), camera])


@dataclass(frozen=True)
class Clock:
    """When a camera takes its frames, and what it writes about it.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    phase: float = 0.0
    """s, true time of the middle of its first exposure."""

    offset: float = 0.0
    """s by which its stamps are late beyond what the camera's `time_offset` says: nobody declares it."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "phase", check_range("phase", self.phase, 0.0, 1.0))
        object.__setattr__(self, "offset", check_range("offset", self.offset, -1.0, 1.0))


@dataclass(frozen=True)
class SceneConfig:
    """A whole recording. The same config and cameras give the same frames, to the byte.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    shots: int = 6
    """Balls launched one after the other: the first shots of `ballfg simulate` with the same seed and settings."""

    interval: float = 2.0
    """s from one launch to the next, give or take 25 ms. A ball flies for up to 1.32 s: with less, two fly at once."""

    seed: int = 0
    """Of every random choice."""

    settings: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """Levels by launcher setting (topspin, sidespin, speed), for those that are not to run through all levels."""

    undeclared: tuple[Effect, ...] = ()
    """Effects that act on the ball although no model file declares them."""

    rate: float = 120.0
    """Hz, frames per second of every camera."""

    exposure: float = 0.002
    """s, for which the shutter is open; a frame's stamp is its middle."""

    clocks: Mapping[str, Clock] = field(default_factory=dict)
    """By camera; a camera that is not named has `Clock()`: all of those expose at once."""

    dropout: float = 0.0
    """Probability that a frame is missing, for each frame by itself."""

    jitter: float = 0.0
    """s, standard deviation of the written stamp about the true time; cut off at 3 sigma. At most 0.15 frames."""

    colour: Literal["white", "orange"] = "white"
    """Of the ball."""

    noise: float = 2.0
    """Grey levels, standard deviation of a dark pixel; it grows with the light, by sqrt(2) at middle grey."""

    flicker: float = 0.03
    """By how much the lamps' light goes up and down with the mains, relative, at 100 Hz."""

    distractors: bool = True
    """Whether things other than the ball move: people in white shirts who swing an arm, a gliding reflection."""

    def __post_init__(self) -> None:
        check_count("shots", self.shots, 1, MAX_SHOTS)
        check_count("seed", self.seed, 0, MAX_SEED)
        for name, (low, high) in _RANGES.items():
            object.__setattr__(self, name, check_range(name, getattr(self, name), low, high))
        if self.colour not in COLOURS:
            raise ValueError(f"colour must be {' or '.join(COLOURS)}; got {self.colour!r}. Choose one of them.")
        if self.exposure * self.rate > LONGEST_EXPOSURE:
            raise ValueError(
                f"exposure must be at most {LONGEST_EXPOSURE:g} of the frame interval, "
                f"{LONGEST_EXPOSURE / self.rate:.3g} s at {self.rate:g} Hz; got {self.exposure:g} s. Lower one of them."
            )
        if self.jitter * self.rate > LARGEST_JITTER:
            raise ValueError(
                f"jitter must be at most {LARGEST_JITTER:g} frames, {LARGEST_JITTER / self.rate:.3g} s at "
                f"{self.rate:g} Hz, or stamps change places; got {self.jitter:g} s. Lower jitter or rate."
            )
        self.combinations()
        if not self.model().measures_plainly:
            raise ValueError(
                "undeclared effects must act on the ball; one of "
                f"{', '.join(effect.name for effect in self.undeclared)} changes how positions are measured, and here "
                "cameras measure. Leave it out."
            )

    @property
    def ball(self) -> BallKind:
        """The ball that is launched, with its table."""
        return table_tennis()

    def combinations(self) -> Settings:
        """(m, 3) the launcher settings that are shot."""
        return all_settings(self.settings)

    def model(self) -> AnalyticModel:
        """How the ball truly moves: as declared, and with what is undeclared."""
        return true_model(self.ball.model, self.undeclared)
