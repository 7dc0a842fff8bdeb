"""One launch with many spins: the paths that a dynamics model predicts for each launcher setting."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ballfg.benchmarks.dynamics.contenders import GraphContender
from ballfg.simulation import SETTING_LEVELS, table_tennis
from ballfg.simulation.settings import Settings
from ballfg.tracks import Track

Array = NDArray[np.float64]

SPEED_LEVEL: Final = 11
"""The launcher's middle velocity level."""
DURATION: Final = 1.2
"""s that are shown."""
RATE: Final = 120.0
"""Hz, of the paths and of the short straight track that tells a contender the direction of the launch."""
STRAIGHT: Final = 12
"""Samples of that track."""
DIGITS: Final = 5
"""Of a kept coordinate in m, 0.01 mm."""


@dataclass(frozen=True)
class Fan:
    """Paths from one launch.

    Attributes:
        topspin: by level, (k, 3) m, without sidespin.
        sidespin: by level, (k, 3) m, without topspin.
    """

    topspin: dict[int, Array]
    sidespin: dict[int, Array]

    def to_json(self) -> dict[str, Any]:
        """Plain lists."""
        return {
            name: {str(level): np.round(path, DIGITS).tolist() for level, path in group.items()}
            for name, group in vars(self).items()
        }

    @classmethod
    def from_json(cls, content: dict[str, Any]) -> Fan:
        """What `to_json` gave."""
        return cls(
            **{
                name: {int(level): np.array(path) for level, path in content[name].items()}
                for name in ("topspin", "sidespin")
            }
        )


def fan_of(contender: GraphContender) -> Fan:
    """The paths of all levels of topspin, and of all levels of sidespin, from the launcher's middle shot."""
    shots = list(_settings())
    start = _launch()
    states = np.tile(start, (len(shots), 1))
    for row, (topspin, sidespin) in zip(states, shots, strict=True):
        row[6:] = _spin(contender, start, topspin, sidespin)
    times = np.arange(round(DURATION * RATE) + 1) / RATE
    paths = dict(zip(shots, contender.roll(states, [times] * len(shots)), strict=True))
    return Fan(
        topspin={level: paths[level, 0] for level in SETTING_LEVELS["topspin"]},
        sidespin={level: paths[0, level] for level in SETTING_LEVELS["sidespin"]},
    )


def _settings() -> Iterator[tuple[int, int]]:
    """Pairs of topspin and sidespin, each once."""
    yield from ((level, 0) for level in SETTING_LEVELS["topspin"])
    yield from ((0, level) for level in SETTING_LEVELS["sidespin"] if level)


def _launch() -> Array:
    """(9,) the launcher's first state at the middle velocity level, without spread and spin."""
    kind = table_tennis()
    still = {name: 0.0 for name in ("position_spread", "speed_spread", "aim_spread", "spin_spread")}
    settings: Settings = np.array([[0, 0, SPEED_LEVEL]])
    launcher = kind.launcher.with_fields(still)
    return np.asarray(launcher.launch(settings, kind.surfaces.table_height, np.random.default_rng(0))[0].numpy())


def _spin(contender: GraphContender, start: Array, topspin: int, sidespin: int) -> Array:
    """(3,) rad/s, what the contender takes launcher settings to mean for a launch."""
    times = np.arange(STRAIGHT) / RATE
    positions = start[:3] + times[:, None] * start[3:6]
    labels = {"topspin": float(topspin), "sidespin": float(sidespin), "speed": float(SPEED_LEVEL)}
    launch = contender.label(Track("launch", times, positions, labels=labels))
    label = contender.settings.spin_label(launch)
    return np.zeros(3) if label is None else label.spin
