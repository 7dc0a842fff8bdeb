"""Simulated shots with any list of settings, and datasets made of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

from ballfg.arrays import Array
from ballfg.dynamics import Effect
from ballfg.simulation import SETTING_LEVELS, SimulationConfig, dataset_info, simulate
from ballfg.tracks import Dataset, Track, read_dataset, write_dataset


def shots(settings: Array, seed: int, effects: Sequence[Effect] = ()) -> list[Track]:
    """One track for each row of settings (n, 3), with noise of its own."""
    tracks = []
    for number, row in enumerate(settings):
        levels = {name: [int(level)] for name, level in zip(SETTING_LEVELS, row, strict=True)}
        config = SimulationConfig(1, seed=1000 * seed + number, settings=levels, undeclared=tuple(effects))
        tracks.append(next(iter(simulate(config))).track)
    return tracks


def dataset_of(folder: Path, tracks: Sequence[Track]) -> Dataset:
    """The tracks as a dataset that states what the simulation declares."""
    named = (replace(track, name=f"{number:03d}") for number, track in enumerate(tracks))
    write_dataset(folder, dataset_info(SimulationConfig(1)), named)
    return read_dataset(folder)
