"""Rendered rallies of `ballfg.benchmarks.cameras.rallies`, line by line.

    python -m tests.estimation.rendered --count 6 --seed 0 [--rate 60] [--view behind] [--varied] [--half]
        [--hand] [--readout 0.4]

prints what is found of each, and the sums. With `--half` the candidates are those of another detector: half of the
balls, with a noise of a pixel, and twenty false ones in each picture.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from functools import partial
from pathlib import Path

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.films import VIEWS, Filmed, Truth
from ballfg.benchmarks.cameras.rallies import CameraScore, Score, rated
from ballfg.state import POSITION
from ballfg.vision.broadcast.given import read_candidates
from tests.vision.broadcast.own import write_candidates

NOISE = 1.0  # px, of another detector


def balls(of: Truth, rate: float, seed: int) -> dict[int, Array]:
    """The ball's centre (2,) px in each picture that shows it, with noise."""
    rng, found = np.random.default_rng([seed, 2]), dict[int, Array]()
    for number, camera in enumerate(of.cameras):
        state = of.at(number / rate)
        if state is not None:
            seen = camera.project(state[None, POSITION])[0] + rng.normal(0.0, NOISE, 2)
            if (seen > 0.0).all() and (seen < camera.size).all():
                found[number] = seen
    return found


def main() -> None:
    """Prints a line for each rally and view, and the sums."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=2, help="number of rallies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=25.0, help="Hz")
    parser.add_argument("--view", choices=VIEWS, help="the same for all")
    parser.add_argument("--varied", action="store_true", help="halls of varied looks, pictures of varied sizes")
    parser.add_argument("--hand", action="store_true", help="a camera in a hand that sways and walks")
    parser.add_argument("--readout", type=float, default=0.0, help="of a rolling shutter, of the time between pictures")
    parser.add_argument("--half", action="store_true", help="candidates of another detector")
    given = parser.parse_args()
    scores, cameras = list[Score](), list[CameraScore]()
    for seed in range(given.seed, given.seed + given.count):
        filmed, begun = (
            Filmed(seed, given.rate, given.view, given.varied, given.hand, given.readout),
            time.process_time(),
        )
        of = filmed.truth
        with tempfile.TemporaryDirectory() as folder:
            table, stamps = Path(folder) / "candidates.csv", np.arange(len(of.cameras)) / given.rate
            write_candidates(table, balls(of, given.rate, seed), stamps, of.cameras[0].size, NOISE, seed)
            one, seen = rated(filmed, partial(read_candidates, table) if given.half else None)
        scores.append(one)
        if seen is None:
            print(f"{seed} {of.view}, {of.cameras[0].size[0]} px, {of.look}: no court", flush=True)
            continue
        cameras.append(seen)
        print(
            f"{seed} {of.view}, light {of.light:.1f}, {of.cameras[0].focal:.0f} of "
            f"{of.cameras[0].size[0]} px, quality {of.quality}: "
            f"place {100 * seen.place:.2f} %, focal length {100 * seen.focal:.2f} %, "
            f"{one.found} of {one.strokes} strokes, {one.false} false, median "
            f"{1e3 * np.median(one.errors or [np.nan]):.0f} mm, spins {one.spins}, bounces {one.bounces}, "
            f"{time.process_time() - begun:.0f} s",
            flush=True,
        )
    worst = [100 * max(getattr(one, name) for one in cameras) for name in ("place", "focal")]
    middle = [100 * np.median([getattr(one, name) for one in cameras]) for name in ("place", "focal")]
    inside = 100 * np.mean([hold for one in cameras for hold in one.held])
    print(f"place {middle[0]:.2f} %, focal length {middle[1]:.2f} % (largest {worst[0]:.2f}, {worst[1]:.2f})", end="")
    print(f", 90 % intervals hold {inside:.0f} %")
    strokes, found, false = (sum(getattr(one, name) for one in scores) for name in ("strokes", "found", "false"))
    errors, held = (np.concatenate([getattr(one, name) for one in scores]) for name in ("errors", "held"))
    right, asked, sure, known = np.sum([one.spins for one in scores], axis=0)
    print(f"found {found} of {strokes}, false {false}, median {1e3 * np.median(errors):.0f} mm")
    print(f"90 % intervals hold {100 * held.mean():.0f} %, spin's sign {right} of {asked}", end="")
    print(f", where known to 2 sigma {sure} of {known}", end="")
    near, count = np.sum([one.bounces for one in scores], axis=0)
    print(f", bounces {near} of {count}, {100 * near / count:.0f} %")


if __name__ == "__main__":
    main()
