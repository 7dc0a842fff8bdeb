"""Predicts one launch with many spins, one path for each launcher setting."""

from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.contenders import GraphContender
from ballfg.simulation import table_tennis
from ballfg.simulation.settings import SETTING_LEVELS, Settings
from ballfg.state import POSITION, SPIN, VELOCITY
from ballfg.tracks import Track

SPEED_LEVEL: Final = 11  # The launcher's middle velocity level
DURATION: Final = 1.2  # s that are shown
RATE: Final = 120.0
"""Hz, of the paths and of the short straight track that tells a contender the direction of the launch."""
STRAIGHT: Final = 12  # Samples of that track
DIGITS: Final = 5  # Resolution of a kept coordinate in m, 0.01 mm


Point = tuple[float, float, float]


@dataclass(frozen=True)
class Fan:
    """Paths from one launch.

    Attributes: topspin: by level, m, without sidespin, to `DIGITS`.  sidespin: by level, m, without topspin.
    """

    topspin: dict[int, list[Point]]
    sidespin: dict[int, list[Point]]


def fan_of(contender: GraphContender) -> Fan:
    """The paths of all levels of topspin, and of all levels of sidespin, from the launcher's middle shot."""
    return Fan(_paths(contender, "topspin"), _paths(contender, "sidespin"))


def _paths(contender: GraphContender, setting: str) -> dict[int, list[Point]]:
    """The paths by the levels of one setting, the other one being zero."""
    levels, start = SETTING_LEVELS[setting], _launch()
    states = np.tile(start, (len(levels), 1))
    for row, level in zip(states, levels, strict=True):
        row[SPIN] = _spin(contender, start, {setting: float(level)})
    times = np.arange(round(DURATION * RATE) + 1) / RATE
    paths = contender.roll(states, [times] * len(levels))
    return {level: np.round(path, DIGITS).tolist() for level, path in zip(levels, paths, strict=True)}


def _launch() -> Array:
    """(9,) the launcher's first state at the middle velocity level, without spread and spin."""
    kind = table_tennis()
    still = {name: 0.0 for name in ("position_spread", "speed_spread", "aim_spread", "spin_spread")}
    settings: Settings = np.array([[0, 0, SPEED_LEVEL]])
    launcher = kind.launcher.with_fields(still)
    return np.asarray(launcher.launch(settings, kind.surfaces.table_height, np.random.default_rng(0))[0].numpy())


def _spin(contender: GraphContender, start: Array, settings: dict[str, float]) -> Array:
    """(3,) rad/s, the spin that launcher settings mean to the contender for a launch."""
    times = np.arange(STRAIGHT) / RATE
    positions = start[POSITION] + times[:, None] * start[VELOCITY]
    labels = {"topspin": 0.0, "sidespin": 0.0, "speed": float(SPEED_LEVEL)} | settings
    launch = contender.label(Track(times, positions, labels=labels, name="launch"))
    label = contender.settings.spin_label(launch)
    return np.zeros(3) if label is None else label.spin
