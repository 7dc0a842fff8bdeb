"""Launchers of the larger balls: typical passes, serves, kicks, throws and chips of each game, from the same settings.

Only orders of magnitude matter: how fast, how steep, with how much spin, and how far the ball is followed.
"""

from collections.abc import Mapping
from typing import Final

from ballfg.simulation.launcher import TABLE_LAUNCHER, TENNIS_LAUNCHER, SimulatedLauncher

BASKETBALL_LAUNCHER: Final = SimulatedLauncher(
    height=2.0,
    speed_slow=5.0,
    speed_fast=9.0,
    elevation_slow=0.9,
    elevation_fast=0.5,
    topspin_scale=5.0,
    sidespin_scale=3.0,
    position_spread=0.01,
    x_low=-2.0,
    x_high=28.0,
    y_far=7.5,
    duration=2.5,
)
"""Passes and throws, of up to four turns a second."""

VOLLEYBALL_LAUNCHER: Final = SimulatedLauncher(
    height=2.5,
    speed_slow=10.0,
    speed_fast=22.0,
    elevation_slow=0.35,
    elevation_fast=0.02,
    topspin_scale=10.0,
    sidespin_scale=6.0,
    position_spread=0.01,
    x_low=-2.0,
    x_high=30.0,
    y_far=9.0,
    duration=2.5,
)
"""Serves, floating to hard."""

FOOTBALL_LAUNCHER: Final = SimulatedLauncher(
    height=0.3,
    speed_slow=12.0,
    speed_fast=26.0,
    elevation_slow=0.5,
    elevation_fast=0.2,
    topspin_scale=12.0,
    sidespin_scale=10.0,
    position_spread=0.02,
    x_low=-3.0,
    x_high=80.0,
    y_far=34.0,
    duration=3.0,
)
"""Kicks from the ground, of up to ten turns a second."""

BASEBALL_LAUNCHER: Final = SimulatedLauncher(
    height=1.8,
    speed_slow=20.0,
    speed_fast=40.0,
    elevation_slow=0.15,
    elevation_fast=0.0,
    topspin_scale=45.0,
    sidespin_scale=30.0,
    position_spread=0.02,
    x_low=-2.0,
    x_high=60.0,
    y_far=10.0,
    duration=2.0,
)
"""Pitches, of up to forty turns a second, that nobody catches."""

GOLF_LAUNCHER: Final = SimulatedLauncher(
    height=0.1,
    speed_slow=15.0,
    speed_fast=30.0,
    elevation_slow=0.7,
    elevation_fast=0.4,
    topspin_scale=60.0,
    sidespin_scale=15.0,
    position_spread=0.005,
    x_low=-2.0,
    x_high=120.0,
    y_far=20.0,
    duration=5.0,
)
"""Chips and pitches; backspin is negative topspin."""

LAUNCHERS: Final[Mapping[str, SimulatedLauncher]] = {
    "table_tennis": TABLE_LAUNCHER,
    "tennis": TENNIS_LAUNCHER,
    "basketball": BASKETBALL_LAUNCHER,
    "volleyball": VOLLEYBALL_LAUNCHER,
    "football": FOOTBALL_LAUNCHER,
    "baseball": BASEBALL_LAUNCHER,
    "golf": GOLF_LAUNCHER,
}
"""By the name of the known ball."""
