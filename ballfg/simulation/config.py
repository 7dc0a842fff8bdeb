"""Configures a simulation: number of tracks, ball, noise, and undeclared effects."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from ballfg.checks import check_flag, check_instance
from ballfg.dynamics.effect import Effect
from ballfg.simulation.balls import BallKind, table_tennis
from ballfg.simulation.bounded import bounded, check_bounds
from ballfg.simulation.settings import Settings, all_settings

MAX_TRACKS = 10_000_000
MAX_SEED = 2**63 - 1
LARGEST_JITTER = 0.15
"""Largest jitter sigma, as a share of the frame interval: stamps then keep their order (see `measure.py`)."""


@dataclass(frozen=True)
class MeasurementNoise:
    """Noise and gaps of the measurement. Every value may be zero.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    position: float = bounded(0.003, 0.0, 1.0)
    """m, standard deviation of each measured coordinate."""
    dropout: float = bounded(0.0, 0.0, 0.95)
    """Probability that a frame is missing, for each frame by itself. Two frames of a track always remain."""
    jitter: float = bounded(0.0, 0.0, 1.0)
    """s, standard deviation of the recorded stamp about the true time; cut off at 3 sigma. At most 0.15 frames."""
    outliers: float = bounded(0.0, 0.0, 1.0)
    """Probability that a position is an outlier."""
    outlier_size: float = bounded(0.1, 0.0, 10.0)
    """m, typical distance of an outlier: in any direction, uniform between half and one and a half times this."""
    spin: float = bounded(4.0, 0.0, 1000.0)
    """rad/s, standard deviation of each component of the spin labels."""
    memory: float = bounded(0.0, 0.0, 1.0)
    """m, standard deviation of an error of each coordinate that lasts from frame to frame; files do not state it."""
    memory_time: float = bounded(0.015, 1e-4, 10.0)
    """s, over which the correlation of that error falls to 1 / e."""

    def __post_init__(self) -> None:
        check_bounds(self, "noise.")


@dataclass(frozen=True)
class MotionNoise:
    """Random disturbances of the true motion: continuous-time densities and kicks; zero for none.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    acceleration: float = bounded(0.0, 0.0, 10.0)
    """m/s^1.5, white-noise density of the acceleration: over dt the variance of a velocity grows by its square dt."""
    spin: float = bounded(0.0, 0.0, 1000.0)
    """rad/s^1.5, the same for the angular acceleration."""
    contact_velocity: float = bounded(0.0, 0.0, 2.0)
    """m/s, standard deviation of a kick to each velocity component after a contact; the ball always leaves upwards."""
    contact_spin: float = bounded(0.0, 0.0, 1000.0)
    """rad/s, standard deviation of a kick to each spin component after a contact."""

    def __post_init__(self) -> None:
        check_bounds(self, "process.")

    @property
    def in_flight(self) -> bool:
        """True if the free ball is disturbed."""
        return self.acceleration > 0 or self.spin > 0

    @property
    def in_contact(self) -> bool:
        """True if contacts are disturbed."""
        return self.contact_velocity > 0 or self.contact_spin > 0


@dataclass(frozen=True)
class SimulationConfig:
    """A whole simulation. The same config gives the same tracks, to the byte.

    Raises: ValueError, TypeError: a value out of its bounds; the message names it.
    """

    tracks: int = bounded(717, 1, MAX_TRACKS)
    """Number of tracks; the paper has 717."""
    rate: float = bounded(100.0, 5.0, 10_000.0)
    """Hz, frames per second."""
    seed: int = bounded(0, 0, MAX_SEED)
    """Seed of all random numbers."""
    ball: BallKind = field(default_factory=table_tennis)
    """The ball, the model declared for it, its surface and its launcher."""
    settings: Mapping[str, Sequence[int]] = field(default_factory=dict)
    """Levels by launcher setting (topspin, sidespin, speed), for restricted settings."""
    noise: MeasurementNoise = field(default_factory=MeasurementNoise)
    """Noise of the measurement."""
    process: MotionNoise = field(default_factory=MotionNoise)
    """Noise of the motion."""
    undeclared: tuple[Effect, ...] = ()
    """Effects that act although no model file declares them; applied in this order."""
    spin_labels: bool = True
    """True to write the spin at the first sample as a label; the launcher's settings always are."""
    block: int = bounded(256, 1, MAX_TRACKS)
    """Number of tracks computed at once; 256 take 4 MB of states. Another number gives another dataset for one seed."""

    def __post_init__(self) -> None:
        check_bounds(self)
        check_instance("noise", self.noise, MeasurementNoise, "Give MeasurementNoise(position=0.003).")
        check_instance("process", self.process, MotionNoise, "Give MotionNoise(acceleration=0.1).")
        check_instance("ball", self.ball, BallKind, "Give table_tennis() or another one.")
        check_flag("spin_labels", self.spin_labels)
        check_jitter(self.noise.jitter, self.rate)
        self.combinations()

    def combinations(self) -> Settings:
        """(m, 3) numbers of the levels of all shots."""
        return all_settings(self.settings)


def check_jitter(jitter: float, rate: float) -> None:
    """Refuses jitter (s) so large at a rate (Hz) that stamps could change their order.

    Raises: ValueError: the jitter is above `LARGEST_JITTER` of the frame interval.
    """
    if jitter * rate > LARGEST_JITTER:
        raise ValueError(
            f"jitter must be at most {LARGEST_JITTER:g} frames, {LARGEST_JITTER / rate:.3g} s at {rate:g} Hz, or "
            f"stamps change places; got {jitter:g} s. Lower jitter or rate."
        )
