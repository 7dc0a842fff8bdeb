"""Datasets and results whose numbers are known: balls that fall, bounce once and fly on, without air."""

from __future__ import annotations

import csv
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ballfg.arrays import Array
from ballfg.state import SIGMA_NAMES, STATE_NAMES

TABLE, RADIUS, RATE, GRAVITY, RESTITUTION = 0.76, 0.02, 100.0, 9.81, 0.9
NOISE, SPREAD = 0.003, 0.05
"""m, of a measured coordinate and of a prediction."""
OBSERVED = 0.25
EXTENT = "  table: {x: [0.0, 2.74], y: [-0.7625, 0.7625]}\n"


@dataclass(frozen=True)
class Fall:
    """A ball that is dropped from a height with a speed along x and y."""

    height: float = 0.3
    speed: tuple[float, float] = (3.0, 0.2)
    samples: int = 60

    @property
    def contact(self) -> float:
        """s, from the closed form of a fall."""
        return float(np.sqrt(2.0 * self.height / GRAVITY))

    @property
    def times(self) -> Array:
        return np.arange(self.samples) / RATE

    def states(self) -> Array:
        t, c = self.times, self.contact
        later = np.maximum(t - c, 0.0)
        up = RESTITUTION * GRAVITY * c
        z = np.where(t < c, self.height - 0.5 * GRAVITY * t**2, up * later - 0.5 * GRAVITY * later**2)
        vz = np.where(t < c, -GRAVITY * t, up - GRAVITY * later)
        ones = np.ones_like(t)
        moving = [self.speed[0] * t, self.speed[1] * t, z + TABLE + RADIUS]
        return np.column_stack([*moving, *(v * ones for v in self.speed), vz, 10.0 * ones, 150.0 * ones, 0.0 * t])


@dataclass(frozen=True)
class Made:
    """Paths of a dataset and its results, and the balls in it."""

    dataset: Path
    states: Path
    predictions: Path
    falls: dict[str, Fall]


def make(folder: Path, falls: dict[str, Fall], extent: bool = True, noise: bool = True, seed: int = 5) -> Made:
    """Writes a dataset, its true states as an estimate, and predictions that err as their sigmas say."""
    generator = np.random.default_rng(seed)
    data = folder / "data"
    data.mkdir(parents=True)
    (data / "dataset.yaml").write_text(
        f"name: made <shots> & more\nframe:\n  up: z\n  table_height: {TABLE}\n{EXTENT if extent else ''}"
        f"ball: {{radius: {RADIUS}, mass: 0.0027}}\n" + (f"position_noise: {NOISE}\n" if noise else "")
    )
    measured, states, predicted = [], [], []
    for name, fall in falls.items():
        truth = fall.states()
        seen = truth[:, :3] + NOISE * generator.normal(size=(len(truth), 3))
        guess = seen + SPREAD * generator.normal(size=seen.shape)
        for t, z, p, x in zip(fall.times, seen, guess, truth, strict=True):
            measured.append([name, t, *z])
            states.append([name, t, *x, *[0.001] * 3, *[0.01] * 3, *[1.0] * 3])
            if t > OBSERVED:
                predicted.append([name, t, *p, *[SPREAD] * 3])
    write(data / "tracks.csv", ("trajectory", "t", "x", "y", "z"), measured)
    write(folder / "states.csv", ("trajectory", "t", *STATE_NAMES, *SIGMA_NAMES), states)
    columns = ("trajectory", "t", "x", "y", "z", "sigma_x", "sigma_y", "sigma_z")
    write(folder / "predictions.csv", columns, predicted)
    return Made(data, folder / "states.csv", folder / "predictions.csv", falls)


def write(path: Path, head: Sequence[str], rows: Iterable[Sequence[object]]) -> None:
    """A CSV table."""
    with path.open("w", newline="", encoding="utf-8") as file:
        csv.writer(file, lineterminator="\n").writerows([head, *rows])
