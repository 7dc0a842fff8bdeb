"""Configures a synthetic recording: shots, clocks of the cameras, shutter, noise."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Final, Literal

from ballfg.checks import check_choice, check_flag
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effect import Effect
from ballfg.simulation.balls import BallKind, table_tennis
from ballfg.simulation.bounded import bounded, check_bounds
from ballfg.simulation.config import MAX_SEED, check_jitter
from ballfg.simulation.motion import true_model
from ballfg.simulation.settings import Settings, all_settings

MAX_SHOTS: Final = 10_000
COLOURS: Final = ("white", "orange")
LONGEST_EXPOSURE: Final = 0.95  # As a share of the frame interval; a sensor needs the rest for its readout


@dataclass(frozen=True)
class Clock:
    """The exposure times of a camera, and the delay of its stamps.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    phase: float = bounded(0.0, 0.0, 1.0)
    """s, true time of the middle of its first exposure."""
    offset: float = bounded(0.0, -1.0, 1.0)
    """s, undeclared delay of its stamps, on top of the camera's `time_offset`."""

    def __post_init__(self) -> None:
        check_bounds(self)


@dataclass(frozen=True)
class SceneConfig:
    """A whole recording. The same config and cameras give the same frames, to the byte.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    shots: int = bounded(6, 1, MAX_SHOTS)
    """Balls launched one after the other: the first shots of `ballfg simulate` with the same seed and settings."""
    interval: float = bounded(2.0, 0.1, 60.0)
    """s from one launch to the next, give or take 25 ms. A ball flies for up to 1.32 s: with less, two fly at once."""
    seed: int = bounded(0, 0, MAX_SEED)
    """Seed of all random numbers."""
    settings: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """Levels by launcher setting (topspin, sidespin, speed), for restricted settings."""
    undeclared: tuple[Effect, ...] = ()
    """Effects that act on the ball although no model file declares them."""
    rate: float = bounded(120.0, 5.0, 2000.0)
    """Hz, frames per second of every camera."""
    exposure: float = bounded(0.002, 1e-5, 0.1)
    """s, duration of the open shutter; a frame's stamp is its middle."""
    clocks: Mapping[str, Clock] = field(default_factory=dict)
    """By camera; all unnamed cameras have `Clock()` and expose at once."""
    dropout: float = bounded(0.0, 0.0, 0.95)
    """Probability that a frame is missing, for each frame by itself."""
    jitter: float = bounded(0.0, 0.0, 1.0)
    """s, standard deviation of the recorded stamp about the true time; cut off at 3 sigma. At most 0.15 frames."""
    colour: Literal["white", "orange"] = "white"
    """Colour of the ball."""
    noise: float = bounded(2.0, 0.0, 50.0)
    """Grey levels, standard deviation of a dark pixel; it grows with the light, by sqrt(2) at middle grey."""
    flicker: float = bounded(0.03, 0.0, 0.5)
    """Relative amplitude of the lamps' flicker at 100 Hz, from the mains."""
    distractors: bool = True
    """True to draw other moving objects: people in white shirts who swing an arm, a gliding reflection."""

    def __post_init__(self) -> None:
        check_bounds(self)
        check_choice("colour", self.colour, COLOURS)
        check_flag("distractors", self.distractors)
        if self.exposure * self.rate > LONGEST_EXPOSURE:
            raise ValueError(
                f"exposure must be at most {LONGEST_EXPOSURE:g} of the frame interval, "
                f"{LONGEST_EXPOSURE / self.rate:.3g} s at {self.rate:g} Hz; got {self.exposure:g} s. Lower one of them."
            )
        check_jitter(self.jitter, self.rate)
        self.combinations()
        if not self.model().measures_plainly:
            raise ValueError(
                "undeclared effects must act on the ball; one of "
                f"{', '.join(effect.name for effect in self.undeclared)} changes how positions are measured, and here "
                "cameras measure. Leave it out."
            )

    @property
    def ball(self) -> BallKind:
        """The launched ball, with its table."""
        return table_tennis()

    def combinations(self) -> Settings:
        """(m, 3) numbers of the levels of all shots."""
        return all_settings(self.settings)

    def model(self) -> AnalyticModel:
        """The true motion of the ball, with declared and undeclared effects."""
        return true_model(self.ball.model, self.undeclared)
