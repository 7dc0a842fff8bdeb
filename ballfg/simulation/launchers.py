"""Defines launchers for typical passes, serves, kicks, throws and chips of each game.

Only orders of magnitude matter: speed, elevation, spin, and the range of the track.
"""

from collections.abc import Mapping
from typing import Final

from ballfg.simulation.launcher import TABLE_LAUNCHER, SimulatedLauncher

_FIELDS: Final = (
    *("height", "speed_slow", "speed_fast", "elevation_slow", "elevation_fast", "topspin_scale", "sidespin_scale"),
    *("position_spread", "x_low", "x_high", "y_far", "duration"),
)
_VALUES: Final = {
    # on a court of 23.77 m, from one baseline
    "tennis": (1.0, 14.0, 26.0, 0.28, 0.10, 50.0, 50.0, 0.01, -3.0, 30.0, 9.0, 2.5),
    # passes and throws, of up to four turns a second
    "basketball": (2.0, 5.0, 9.0, 0.9, 0.5, 5.0, 3.0, 0.01, -2.0, 28.0, 7.5, 2.5),
    # serves, floating to hard
    "volleyball": (2.5, 10.0, 22.0, 0.35, 0.02, 10.0, 6.0, 0.01, -2.0, 30.0, 9.0, 2.5),
    # kicks from the ground, of up to ten turns a second
    "football": (0.3, 12.0, 26.0, 0.5, 0.2, 12.0, 10.0, 0.02, -3.0, 80.0, 34.0, 3.0),
    # pitches, of up to forty turns a second, without a catcher
    "baseball": (1.8, 20.0, 40.0, 0.15, 0.0, 45.0, 30.0, 0.02, -2.0, 60.0, 10.0, 2.0),
    # chips and pitches; backspin is negative topspin
    "golf": (0.1, 15.0, 30.0, 0.7, 0.4, 60.0, 15.0, 0.005, -2.0, 120.0, 20.0, 5.0),
}
"""By the name of the known ball; the fields that differ from the launcher of the table, in its units."""

LAUNCHERS: Final[Mapping[str, SimulatedLauncher]] = {
    "table_tennis": TABLE_LAUNCHER,
    **{name: SimulatedLauncher(**dict(zip(_FIELDS, row, strict=True))) for name, row in _VALUES.items()},
}
"""By the name of the known ball."""
