"""Simulated shots with any list of settings, and datasets made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.effect import Effect
from ballfg.simulation import SimulationConfig, simulate, table_tennis
from ballfg.simulation.launcher import SimulatedLauncher
from ballfg.simulation.settings import SETTING_LEVELS
from ballfg.simulation.synthetic import dataset_info
from ballfg.state import SPIN, VELOCITY
from ballfg.tracks import Dataset, Track, read_dataset, write_dataset
from ballfg.tracks.track import SPIN_LABELS


def shots(settings: Array, seed: int, effects: Sequence[Effect] = ()) -> list[Track]:
    """One track for each row of settings (n, 3), with noise of its own."""
    tracks = []
    for number, row in enumerate(settings):
        levels = {name: [int(level)] for name, level in zip(SETTING_LEVELS, row, strict=True)}
        config = SimulationConfig(1, seed=1000 * seed + number, settings=levels, undeclared=tuple(effects))
        tracks.append(next(iter(simulate(config))).track)
    return tracks


@dataclass(frozen=True)
class TurnedLauncher(SimulatedLauncher):
    """A launcher that aims to the side of +x; its spins turn with it."""

    yaw: float = 0.0
    """rad about the vertical."""

    def launch(self, settings: np.ndarray, table_height: float, rng: np.random.Generator) -> torch.Tensor:
        """First states as those of a launcher that aims along +x, turned about the muzzle."""
        states = super().launch(settings, table_height, rng)
        cosine, sine = np.cos(self.yaw), np.sin(self.yaw)
        turn = torch.tensor([[cosine, -sine, 0.0], [sine, cosine, 0.0], [0.0, 0.0, 1.0]], dtype=torch.float64)
        for part in (VELOCITY, SPIN):
            states[:, part] = states[:, part] @ turn.T
        return states


AIMED = ("topspin", "sidespin", "speed", "elevation", "yaw")
"""Labels of aimed shots: levels of spin, m/s, degrees above the horizontal, degrees to the side."""


def aimed_shots(settings: Array, seed: int, effects: Sequence[Effect] = ()) -> list[Track]:
    """One track of at most 2.5 s for each row (n, 5) of `AIMED` settings, with noise of its own."""
    kind, tracks = table_tennis(), []
    for number, row in enumerate(settings.tolist()):
        topspin, sidespin, speed, elevation, yaw = row
        slope = np.radians(elevation)
        launcher = TurnedLauncher(
            speed_slow=speed,
            speed_fast=speed,
            elevation_slow=slope,
            elevation_fast=slope,
            duration=2.5,
            yaw=np.radians(yaw),
        )
        config = SimulationConfig(
            1,
            seed=1000 * seed + number,
            ball=replace(kind, launcher=launcher),
            settings={"topspin": [int(topspin)], "sidespin": [int(sidespin)]},
            undeclared=tuple(effects),
        )
        track = next(iter(simulate(config))).track
        labels = {name: track.labels[name] for name in SPIN_LABELS} | dict(zip(AIMED, row, strict=True))
        tracks.append(replace(track, labels=labels))
    return tracks


def dataset_of(folder: Path, tracks: Sequence[Track]) -> Dataset:
    """The tracks as a dataset that states what the simulation declares."""
    named = (replace(track, name=f"{number:03d}") for number, track in enumerate(tracks))
    write_dataset(folder, dataset_info(SimulationConfig(1)), named)
    return read_dataset(folder)
