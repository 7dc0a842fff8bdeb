"""Ranges in which coefficients of a table-tennis ball, its table and its room are plausible, and where they come from.

A coefficient that must lie outside of its range to explain the tracks stands for something else: it is never a name.
"""

from dataclasses import dataclass
from typing import Final

from ballfg.diagnosis.result import Value
from ballfg.tracks import TABLE_TENNIS

NEAR: Final = 0.15
"""Relative. A ball whose radius is further from a table-tennis ball's has none of these ranges."""
MARGIN: Final = 0.1
"""Share of a range by which a fitted value may lie outside of it."""
SIGMAS: Final = 3.0
"""Standard deviations: coefficients must differ from absent by so many and the halves by no more, and a value may lie
so many outside of its range."""


@dataclass(frozen=True)
class Range:
    """Smallest and largest plausible value, in the coefficient's unit, and the source of both."""

    low: float
    high: float
    source: str

    def holds(self, value: Value) -> bool:
        """Whether a fitted value lies in the range, or so little outside that its uncertainty may be the reason."""
        slack = MARGIN * (self.high - self.low)
        if value.sigma > 0.0:
            slack = min(slack, SIGMAS * value.sigma)
        return self.low - slack <= value.value <= self.high + slack


_ROOM = "ISO 7730 allows up to 0.25 m/s in rooms where people stay; an open window brings 0.5 m/s"
_FAN = "a fan at a few metres: ASHRAE 55 has up to 1.2 m/s at a person, twice that is the fan's own jet"
_LAYERS = "a draught of 0.5 m/s in the lower half metre of a room and still air above it"
_CAMERAS = "larger ones are seen by eye in a picture of the table"

RANGES: Final[dict[str, Range]] = (
    {f"wind.{axis}": Range(-0.5, 0.5, _ROOM) for axis in "xyz"}
    | {f"gust_region.{axis}": Range(-2.0, 2.0, _FAN) for axis in "xyz"}
    | {f"wind_shear.{axis}": Range(-1.0, 1.0, _LAYERS) for axis in "xy"}
    | {f"frame_tilt.{axis}": Range(-0.1, 0.1, _CAMERAS) for axis in "xy"}
    | {f"table_tilt.{axis}": Range(-0.03, 0.03, "a table that leans by more lets a ball roll off") for axis in "xy"}
    | {f"scale.{axis}": Range(-0.1, 0.1, _CAMERAS) for axis in "xyz"}
    | {f"time_offset.{axis}": Range(-0.03, 0.03, "two frames of a camera of 60 Hz") for axis in "xyz"}
    | {
        "drag.k": Range(0.03, 0.25, "fits of measured tracks give 0.08 to 0.16 1/m; Cd of a sphere is 0.1 to 0.8"),
        "magnus.k": Range(0.0005, 0.005, "code of robots and fits of measured tracks give 0.0010 to 0.0046"),
        "spin_decay.rate": Range(0.0, 2.0, "at 2 1/s two thirds of the spin are gone in half a second"),
        "drag_speed.slope": Range(-0.1, 0.1, "Cd of a sphere below the drag crisis changes by half over 5 m/s at most"),
        "drag_spin.gain": Range(-1.0, 3.0, "Cd of a fast spinning ball is up to twice that of one without spin"),
        "magnus_saturation.strength": Range(0.0, 3.0, "Stepanek 1988: Cl = S / (1 + 2 S)"),
        "buoyancy.a": Range(0.0, 0.3, "rho V g / m is 0.146 m/s^2"),
        "gravity.g": Range(9.4, 9.9, "9.76 to 9.83 m/s^2 on the ground, less the buoyancy of 0.15 m/s^2"),
        "restitution.e": Range(0.6, 1.0, "tables of the ITTF: 0.87 to 0.93; a mat or a floor less"),
        "restitution_speed.slope": Range(-0.02, 0.06, "Nakashima 2010: 0.93 falls to 0.85 over 5 m/s"),
        "friction.mu": Range(0.02, 1.0, "tables have 0.25 to 0.3, rubbers up to 1"),
        "tangential_restitution.e_t": Range(0.0, 1.0, "none of the slip is reversed, or all of it; Cross 2002"),
        "table_height.offset": Range(-0.03, 0.03, _CAMERAS),
        "velocity_lag.lag": Range(-0.1, 0.1, "a tracker's filter delays by a few frames"),
        "distortion.k": Range(-0.05, 0.05, _CAMERAS),
        "time_scale.s": Range(-0.8, 0.9, "cameras of 30 to 240 Hz taken for one another"),
        "counted_frames.missing": Range(0.0, 6.0, "of seven frames one is kept"),
        "radial_bias.offset": Range(-0.02, 0.02, "a camera sees the surface, which lies one radius before the centre"),
    }
)
"""By effect and coefficient, in the coefficient's unit."""


def in_table(name: str, radius: float) -> bool:
    """Whether a coefficient has a range, for a ball of some radius in m."""
    return name in RANGES and abs(radius / TABLE_TENNIS.radius - 1.0) <= NEAR


def implausible(name: str, value: Value, radius: float) -> str:
    """Why a fitted value is not plausible, in words; empty if it is, or if nothing is known of it.

    Args: name: of effect and coefficient, `wind.x`.  radius: of the ball, m.
    """
    if not in_table(name, radius) or (known := RANGES[name]).holds(value):
        return ""
    unit = "" if value.unit == "1" else f" {value.unit}"
    return f"{name} = {value.value:.3g}{unit} lies outside of {known.low:g} to {known.high:g}{unit} ({known.source})"
