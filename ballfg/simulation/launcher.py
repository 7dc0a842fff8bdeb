"""A simulated launcher turns integer settings into the first state of a shot, and ends its track.

Topspin, sidespin and velocity level (`settings.py`) become a place at the muzzle, a velocity in the x-z plane, and a
spin of `topspin` about the horizontal axis across the launch (y) and of `sidespin` about the vertical. The paper does
not give the rad/s and m/s of a level; docs/simulate.md derives the chosen scales.
"""

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any, Final, Self

import numpy as np
import torch
from torch import Tensor

from ballfg.checks import shown
from ballfg.dynamics import BallModel, Surfaces
from ballfg.simulation.bounded import bounded, check_bounds
from ballfg.simulation.settings import SETTING_LEVELS, Settings
from ballfg.state import STATE_DIM

_SPEED_LEVELS: Final = SETTING_LEVELS["speed"]


@dataclass(frozen=True)
class SimulatedLauncher:
    """Geometry, scales and shot-to-shot spread of a launcher. It stands at x, y = 0 and shoots along +x.

    Raises: ValueError, TypeError: a field that is not a number within its bounds; the message names it.
    """

    x: float = bounded(0.0, -100.0, 100.0)  # m, muzzle; x = 0 is the launcher's end of the table
    height: float = bounded(0.56, 0.05, 10.0)  # m, muzzle above the surface
    speed_slow: float = bounded(3.4, 0.5, 100.0)  # m/s at velocity level 8; levels between are linear
    speed_fast: float = bounded(4.1, 0.5, 100.0)  # m/s at velocity level 14
    elevation_slow: float = bounded(1.24, -1.5, 1.5)
    """rad above the horizontal at velocity level 8; the head is lowered as the speed goes up."""
    elevation_fast: float = bounded(-0.18, -1.5, 1.5)  # rad above the horizontal at velocity level 14
    topspin_scale: float = bounded(58.0, 0.0, 1000.0)  # rad/s per level of topspin
    sidespin_scale: float = bounded(48.0, 0.0, 1000.0)  # rad/s per level of sidespin
    position_spread: float = bounded(0.003, 0.0, 0.5)
    """m, standard deviation of each coordinate of the muzzle from shot to shot."""
    speed_spread: float = bounded(0.005, 0.0, 0.2)  # Standard deviation of the speed from shot to shot, relative
    aim_spread: float = bounded(0.005, 0.0, 0.5)  # rad, standard deviation of azimuth and elevation from shot to shot
    spin_spread: float = bounded(3.0, 0.0, 500.0)
    """rad/s, standard deviation of each component of the spin from shot to shot."""
    x_low: float = bounded(-0.4, -200.0, 200.0)  # m, a track ends where the ball comes back behind this
    x_high: float = bounded(3.2, -200.0, 200.0)  # m, a track ends where the ball goes beyond this
    y_far: float = bounded(1.2, 0.01, 200.0)  # m, a track ends where the ball is farther than this from the x axis
    duration: float = bounded(1.32, 0.05, 20.0)  # s, longest track

    def __post_init__(self) -> None:
        check_bounds(self)
        if not self.x_low < self.x < self.x_high:
            raise ValueError(
                f"x must lie between x_low and x_high; got {self.x_low:g}, {self.x:g}, {self.x_high:g} m. Correct them."
            )

    def with_fields(self, changes: Mapping[str, Any]) -> Self:
        """This launcher with some fields changed.

        Raises: ValueError, TypeError: changes that are not a mapping, an unknown field or a bad value.
        """
        if not isinstance(changes, Mapping):
            raise TypeError(
                f"launcher must map fields to numbers; got {shown(changes)}. Write launcher: {{height: 0.4}}."
            )
        known = [field.name for field in fields(self)]
        for key in changes:
            if key not in known:
                raise ValueError(f"launcher has no field '{key}'; it has {', '.join(known)}. Rename it.")
        return replace(self, **changes)

    def launch(self, settings: Settings, table_height: float, rng: np.random.Generator) -> Tensor:
        """The first states of some shots.

        Args:
            settings: (n, 3) numbers of the levels of topspin, sidespin and velocity.
            table_height: m, z of the surface.  rng: for the shot-to-shot spread.
        Returns: (n, 9) states at the muzzle.
        """
        n = len(settings)
        share = (settings[:, 2] - _SPEED_LEVELS[0]) / (_SPEED_LEVELS[-1] - _SPEED_LEVELS[0])
        speed = self.speed_slow + share * (self.speed_fast - self.speed_slow)
        speed = speed * (1 + self.speed_spread * rng.standard_normal(n))
        elevation = self.elevation_slow + share * (self.elevation_fast - self.elevation_slow)
        elevation = elevation + self.aim_spread * rng.standard_normal(n)
        azimuth = self.aim_spread * rng.standard_normal(n)
        states = np.zeros((n, STATE_DIM))
        states[:, :3] = (self.x, 0.0, table_height + self.height)
        states[:, :3] += self.position_spread * rng.standard_normal((n, 3))
        states[:, 3] = speed * np.cos(elevation) * np.cos(azimuth)
        states[:, 4] = speed * np.cos(elevation) * np.sin(azimuth)
        states[:, 5] = speed * np.sin(elevation)
        states[:, 6:] = self.spin_spread * rng.standard_normal((n, 3))
        states[:, 7] += self.topspin_scale * settings[:, 0]
        states[:, 8] += self.sidespin_scale * settings[:, 1]
        return torch.from_numpy(states)

    def in_view(self, states: Tensor, surfaces: Surfaces, model: BallModel) -> Tensor:
        """(...) bool of states (..., 9): True while the ball is tracked.

        A ball beside the table leaves the view as it comes down to the table's height: from there on the track of a
        table of unknown extent would show a ball that falls through it.
        """
        x, y = states[..., 0], states[..., 1]
        inside = (x > self.x_low) & (x < self.x_high) & (y.abs() < self.y_far)
        above = model.gap(states, surfaces.table_height) > 0
        return inside & (surfaces.over_table(states) | above)


TABLE_LAUNCHER: Final = SimulatedLauncher()
"""For table tennis: returns topspin -3 at low levels, turns +-5 sidespin by 45 degrees, bounces once to three times."""

# passes, serves, kicks, throws and chips of each game: only orders of magnitude matter
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
