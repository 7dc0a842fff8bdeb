"""Rendered rallies of `ballfg.benchmarks.cameras.rallies`, line by line.

    python -m tests.estimation.rendered --count 6 --seed 0 [--rate 60] [--view behind] [--varied] [--half]
        [--hand] [--readout 0.4]
    python -m tests.estimation.rendered --count 4 --seed 0 --stands [--rate 50] [--view oblique]

prints what is found of each, and the sums. With `--half` the candidates are those of another detector: half of the
balls, with a noise of a pixel, and twenty false ones in each picture. With `--stands` a calibrated camera that stands
sees a minute.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from functools import partial
from pathlib import Path

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.films import STANDING, VIEWS, Filmed, Truth
from ballfg.benchmarks.cameras.rallies import STANDING_RATE, CameraScore, Score, rated, rated_standing
from ballfg.state import POSITION
from ballfg.vision.broadcast.pictures import read_candidates
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


def moving(filmed: Filmed, *, half: bool) -> tuple[Score, CameraScore | None]:
    """The scores of a rally of a moving camera; prints the camera's. Args: half: candidates of another detector."""
    of = filmed.truth
    camera, size = of.cameras[0], of.cameras[0].size
    with tempfile.TemporaryDirectory() as folder:
        table, stamps = Path(folder) / "candidates.csv", np.arange(len(of.cameras)) / filmed.rate
        write_candidates(table, balls(of, filmed.rate, filmed.seed), stamps, size, NOISE, filmed.seed)
        one, seen = rated(filmed, partial(read_candidates, table) if half else None)
    print(f"light {of.light:.1f}, {camera.focal:.0f} of {size[0]} px, quality {of.quality}, ", end="")
    if seen is None:
        print(f"{of.look}: no court, ", end="")
    else:
        print(f"place {100 * seen.place:.2f} %, focal length {100 * seen.focal:.2f} %, ", end="")
    return one, seen


def print_cameras(cameras: Sequence[CameraScore]) -> None:
    """Prints the errors of all cameras."""
    worst = [100 * max(getattr(one, name) for one in cameras) for name in ("place", "focal")]
    middle = [100 * np.median([getattr(one, name) for one in cameras]) for name in ("place", "focal")]
    inside = 100 * np.mean([hold for one in cameras for hold in one.held])
    print(f"place {middle[0]:.2f} %, focal length {middle[1]:.2f} % (largest {worst[0]:.2f}, {worst[1]:.2f})", end="")
    print(f", 90 % intervals hold {inside:.0f} %")


def print_strokes(scores: Sequence[Score]) -> None:
    """Prints what is found of all strokes."""
    strokes, found, false = (sum(getattr(one, name) for one in scores) for name in ("strokes", "found", "false"))
    errors, held = (np.concatenate([getattr(one, name) for one in scores]) for name in ("errors", "held"))
    right, asked, sure, known = np.sum([one.spins for one in scores], axis=0)
    print(f"found {found} of {strokes}, false {false}, median {1e3 * np.median(errors):.0f} mm")
    print(f"90 % intervals hold {100 * held.mean():.0f} %, spin's sign {right} of {asked}", end="")
    print(f", where known to 2 sigma {sure} of {known}", end="")
    near, count = np.sum([one.bounces for one in scores], axis=0)
    print(f", bounces {near} of {count}, {100 * near / count:.0f} %")


def main() -> None:
    """Prints a line for each rally and view, and the sums."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=2, help="number of rallies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, help="Hz; 25 of a moving camera, 50 of one that stands")
    parser.add_argument("--view", choices=[*VIEWS, *STANDING], help="the same for all")
    parser.add_argument("--varied", action="store_true", help="halls of varied looks, pictures of varied sizes")
    parser.add_argument("--hand", action="store_true", help="a camera in a hand that sways and walks")
    parser.add_argument("--readout", type=float, default=0.0, help="of a rolling shutter, of the time between pictures")
    parser.add_argument("--half", action="store_true", help="candidates of another detector")
    parser.add_argument("--stands", action="store_true", help="minutes of a calibrated camera that stands")
    given = parser.parse_args()
    rate = given.rate or (STANDING_RATE if given.stands else 25.0)
    own = (given.view, given.varied, given.hand, given.readout, given.stands)
    scores, cameras = list[Score](), list[CameraScore]()
    for seed in range(given.seed, given.seed + given.count):
        filmed, begun = Filmed(seed, rate, *own), time.process_time()
        print(f"{seed} {filmed.truth.view}: ", end="")
        if given.stands:
            one = rated_standing(filmed)
        else:
            one, seen = moving(filmed, half=given.half)
            cameras += [] if seen is None else [seen]
        scores.append(one)
        print(
            f"{one.found} of {one.strokes} strokes, {one.false} false, median "
            f"{1e3 * np.median(one.errors or [np.nan]):.0f} mm, spins {one.spins}, bounces {one.bounces}, "
            f"{time.process_time() - begun:.0f} s",
            flush=True,
        )
    if cameras:
        print_cameras(cameras)
    print_strokes(scores)


if __name__ == "__main__":
    main()
