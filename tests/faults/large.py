"""Writes a dataset as large as asked for, estimates it with `ballfg estimate`, and prints time and memory.

python -m tests.faults.large --samples 1000000     one endless rally in one track
python -m tests.faults.large --tracks 100000       tracks of five samples
"""

from __future__ import annotations

import argparse
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import torch

from ballfg.dynamics import Surfaces, nominal_model, rollout
from ballfg.tracks import Ball, Track, write_dataset
from ballfg.tracks.info import DatasetInfo

RATE, NOISE, HEIGHT = 100.0, 0.0015, 0.76
SHORT = 5
"""Samples of a short track."""
EVERY = 50
"""Shots after which the ball vanishes for a second and is served anew."""


def rally(samples: int, seed: int = 0, every: int = EVERY) -> Track:
    """A ball that is hit to and fro over a table, with one bounce between two hits.

    Args: samples: at 100 Hz.  seed: of shots and noise.  every: shots between two serves.
    """
    rng, model, table = np.random.default_rng(seed), nominal_model(), Surfaces.table_tennis(HEIGHT)
    times, positions, now, shots, count = [], [], 0.0, 0, 0
    side, at = 1.0, np.array([-1.3, 0.0, HEIGHT + 0.3])
    while count < samples:
        flight = rng.uniform(0.35, 0.5)
        landing = np.array([side * rng.uniform(0.5, 1.1), rng.uniform(-0.5, 0.5), HEIGHT + 0.02])
        velocity = (landing - at) / flight + [0.0, 0.0, 9.81 * flight / 2.0]
        start = np.concatenate((at, velocity, rng.normal(0.0, 50.0, 3)))
        since = np.arange(1, int((flight + rng.uniform(0.2, 0.3)) * RATE) + 1) / RATE
        with torch.no_grad():
            states = rollout(model, torch.from_numpy(start)[None], torch.from_numpy(since), table)[0].numpy()
        times.append(now + since)
        positions.append(states[:, :3])
        now, at, side, shots, count = now + since[-1], states[-1, :3], -side, shots + 1, count + len(since)
        if at[2] < HEIGHT + 0.05 or shots % every == 0:
            now, at = now + 1.0, np.array([-side * 1.3, 0.0, HEIGHT + 0.3])
    shown = np.concatenate(positions)[:samples]
    return Track(np.concatenate(times)[:samples], shown + rng.normal(0.0, NOISE, shown.shape), name="rally")


def short_tracks(count: int, seed: int = 0) -> Iterator[Track]:
    """Throws seen five times each."""
    rng, times = np.random.default_rng(seed), np.arange(SHORT) / RATE
    for number in range(count):
        velocity = np.array([rng.uniform(2.0, 6.0), rng.uniform(-1.0, 1.0), rng.uniform(-2.0, 2.0)])
        path = [0.0, 0.0, HEIGHT + 0.5] + times[:, None] * velocity - [0.0, 0.0, 4.905] * times[:, None] ** 2
        yield Track(times, path + rng.normal(0.0, NOISE, path.shape), name=f"{number:06d}")


def main() -> None:
    """Writes, estimates, prints."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    size = parser.add_mutually_exclusive_group(required=True)
    size.add_argument("--samples", type=int, help="of one track")
    size.add_argument("--tracks", type=int, help=f"of {SHORT} samples each")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--format", choices=("csv", "parquet"), default="csv")
    given = parser.parse_args()
    tracks = [rally(given.samples)] if given.samples else short_tracks(given.tracks)
    with tempfile.TemporaryDirectory() as folder:
        data, out = Path(folder, "data"), Path(folder, f"states.{given.format}")
        info = DatasetInfo(
            name="large", table_height=HEIGHT, ball=Ball(radius=0.02, mass=0.0027), rate=RATE, position_noise=NOISE
        )
        write_dataset(data, info, tracks, given.format)
        run = "from ballfg.cli.main import run; import sys; run(sys.argv[1:])"
        command = [sys.executable, "-c", run, "estimate", str(data), "--out", str(out), "--jobs", str(given.jobs)]
        start = time.perf_counter()
        subprocess.run(command, check=True)
        took, used = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
        print(f"{took:.1f} s, {used.ru_utime + used.ru_stime:.1f} s of processor time")
        print(
            f"peak memory of the largest process {used.ru_maxrss / 1e3:.0f} MB; {out.stat().st_size / 1e6:.0f} MB out"
        )


if __name__ == "__main__":
    main()
