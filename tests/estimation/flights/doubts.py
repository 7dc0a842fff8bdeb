"""Whether recordings without a table get one, and whether the noise of what is no ball is refused.

    python -m tests.estimation.flights.doubts --count 100 --seed 5000

imports recordings in which hands, feet, rackets and walls touch the ball, and counts tables; then it asks for the noise
of sets that are no ball, by the command.
"""

from __future__ import annotations

import argparse
import contextlib
import io
import tempfile
from collections.abc import Iterator
from pathlib import Path

import numpy as np

import ballfg as bf
from ballfg.arrays import Array
from ballfg.importing.choices import UndecidedError
from ballfg.tracks import TABLE_TENNIS, Track, write_dataset
from ballfg.tracks.info import DatasetInfo
from tests.commands import status
from tests.estimation.flights.recordings import WITHOUT_TABLE, recording


def tables(count: int, seed: int) -> list[str]:
    """The recordings that get a table."""
    found = []
    for i in range(count):
        kind = list(WITHOUT_TABLE)[i % len(WITHOUT_TABLE)]
        track = recording(seed + i, kind=kind).track
        try:
            data = bf.import_tracks(np.column_stack((track.times, track.positions)), length="m", time="s", up="z")
        except UndecidedError as question:
            if question.option != "table-height":
                raise
        else:
            guess = (data.info.imported or {})["table height"]
            found.append(f"{track.name} {guess}")
    return found


def no_balls(seed: int) -> Iterator[tuple[str, list[Track]]]:
    """Sets of ten tracks that are no flying ball."""
    rng = np.random.default_rng(seed)
    times = np.arange(240) / 120.0

    def noisy(path: Array) -> Array:
        return path + rng.normal(0.0, 0.002, path.shape)

    for number in range(6):
        still = [Track(times, noisy(np.tile(rng.uniform(0.5, 2.0, 3), (240, 1))), name=f"{k}") for k in range(10)]
        yield f"still{number}", still
        steps = [np.cumsum(rng.normal(0.0, 0.01, (240, 3)), axis=0) + 1.0 for _ in range(10)]
        yield f"walk{number}", [Track(times, noisy(path), name=f"{k}") for k, path in enumerate(steps)]
        angle = 0.5 * np.sin(2 * np.pi * rng.uniform(0.5, 1.5) * times)
        swing = np.stack((np.sin(angle), 0 * angle, 2.0 - np.cos(angle)), axis=1)
        yield f"pendulum{number}", [Track(times, noisy(swing), name=f"{k}") for k in range(10)]
        yield f"held{number}", [recording(seed + 100 * number + k, kind="held").track for k in range(10)]
        level = np.stack((1.3 * times, 0.2 * times, np.ones_like(times)), axis=1)
        yield f"walking{number}", [Track(times, noisy(level), name=f"{k}") for k in range(10)]


def main() -> None:
    """Prints both counts."""
    parser = argparse.ArgumentParser()
    parser.add_argument("--count", type=int, default=100)
    parser.add_argument("--seed", type=int, default=5000)
    chosen = parser.parse_args()
    found = tables(chosen.count, chosen.seed)
    print(f"{len(found)} of {chosen.count} recordings without a table get one", *found, sep="\n")
    refused, answers = 0, list[str]()
    with tempfile.TemporaryDirectory() as folder:
        for name, tracks in no_balls(chosen.seed):
            write_dataset(Path(folder) / name, DatasetInfo(name, 0.0, TABLE_TENNIS), tracks)
            with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(io.StringIO()) as said:
                ended = status("noise", Path(folder) / name)
            refused += ended == 2 and len(said.getvalue().strip().splitlines()) >= 1
            answers += [] if ended == 2 else [name]
    print(f"{refused} of 30 sets that are no ball are refused", *answers, sep="\n")


if __name__ == "__main__":
    main()
