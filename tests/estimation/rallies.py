"""Rallies of a minute as one camera sees them: which strokes are found, which are false, and how far off they are.

    python -m tests.estimation.rallies --count 3 --seed 31 [--rate 50]

simulates rallies (strokes with one bounce each, 50 Hz, 0.7 px, 8 % of the frames and 25 bursts hidden, wrong candidates
in every frame) for a camera at the side and an oblique one, and prints a line for each and the sums. A stroke counts as
found if an estimate covers more than half of it and is less than half a metre off.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Sequence
from typing import Final

import numpy as np

from ballfg.benchmarks.cameras.strokes import MODEL, SURFACES, TABLE, Stroke, flown, stroke
from ballfg.estimation.one_camera import track_one_camera
from ballfg.estimation.result import Estimate
from ballfg.state import POSITION
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Candidates, Detections
from tests.estimation.observations.sighted_rig import looking

CAMERAS: Final = (looking("side", (-0.2, -4.0, 2.2)), looking("oblique", (-3.6, -3.0, 2.4)))
RATE, LENGTH, BEGIN = 50.0, 60.0, 100.0  # Hz, s, s: stamp of the first frame
NOISE, HIDDEN, BURSTS = 0.7, 0.08, 25  # px, share of frames, number of runs of hidden frames
COVERED, NEAR = 0.5, 0.5  # least share of a found stroke, largest error of one in m


def rally(seed: int) -> list[Stroke]:
    """Strokes of a minute, with pauses between points."""
    rng = np.random.default_rng(seed)
    now, found = 0.5 + rng.uniform(0.0, 0.3), list[Stroke]()
    while now < LENGTH - 2.0:
        side = float(rng.choice([-1, 1]))
        place = np.array([side * rng.uniform(1.2, 1.5), rng.uniform(-0.4, 0.4), TABLE + rng.uniform(0.1, 0.35)])
        for _ in range(rng.integers(3, 10)):
            drawn = stroke(place, -side, rng)
            if drawn is None or now + drawn[1] > LENGTH - 0.5:
                break
            state, lasts = drawn
            found.append(Stroke(now, now + lasts, state))
            place, now, side = flown(state, np.array([lasts]))[0, POSITION], now + lasts, -side
        now += rng.uniform(1.5, 3.0)
    return found


def detections(strokes: Sequence[Stroke], camera: Camera, seed: int, rate: float = RATE) -> Detections:
    """What a detector finds in the frames of a rally, at a rate in Hz."""
    rng, count = np.random.default_rng([seed, 7]), int(LENGTH * rate)
    pixels = np.full((count, 2), np.nan)
    for one in strokes:
        frames = np.arange(int(np.ceil(one.begin * rate)), min(int(np.ceil(one.end * rate)), count))
        pixels[frames] = camera.project(flown(one.state, frames / rate - one.begin)[:, POSITION])
    hidden = rng.uniform(size=count) < HIDDEN
    for first in rng.integers(0, count, BURSTS):
        hidden[first : first + rng.integers(2, 5)] = True
    frames = []
    for k, ball in enumerate(pixels):
        wrong = [*rng.uniform((0, 0), camera.size, (2, 2))]
        passing = np.array([100.0 + (150.0 * k / rate) % 1100, 600.0]) + NOISE * rng.standard_normal(2)
        places, scores = [*wrong, passing], [0.35, 0.4, 0.5]
        if not hidden[k] and (ball > 0.0).all() and (ball < np.array(camera.size) - 1.0).all():  # NaN is not above 0
            places, scores = [*places, ball + NOISE * rng.standard_normal(2)], [*scores, 0.9]
        frames.append((BEGIN + k / rate, Candidates.at(np.array(places), NOISE, scores)))
    return Detections.of_frames(camera.name, frames)


def matched(estimate: Estimate, strokes: Sequence[Stroke], rate: float = RATE) -> tuple[int, float, float] | None:
    """The stroke that holds most of an estimate, the share of it that is covered, and the error, m; None: none does."""
    times = estimate.times - BEGIN
    for number, one in enumerate(strokes):
        inside = (times >= one.begin - 1e-6) & (times <= one.end)
        if inside.sum() >= 0.5 * len(times):
            true = flown(one.state, np.maximum(times[inside] - one.begin, 1e-9))[:, POSITION]
            error = np.sqrt(((estimate.states[inside, POSITION] - true) ** 2).sum(axis=1).mean())
            return number, inside.sum() / max((one.end - one.begin) * rate, 1.0), float(error)
    return None


def main() -> None:
    """Prints a line for each rally and camera, and the shares of all."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=3, help="number of rallies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=RATE, help="Hz")
    given = parser.parse_args()
    totals = np.zeros(4, dtype=np.int64)
    for seed in range(given.seed, given.seed + given.count):
        strokes = rally(seed)
        for camera in CAMERAS:
            seen, begun = detections(strokes, camera, seed, given.rate), time.process_time()
            estimates = track_one_camera(seen, camera, MODEL, SURFACES).estimates
            found = [match for one in estimates if (match := matched(one, strokes, given.rate)) is not None]
            good = {number for number, share, error in found if share > COVERED and error < NEAR}
            row = np.array([len(strokes), len(good), len(estimates), len(estimates) - len(found)])
            totals += row
            median, spent = 1e3 * np.median([error for *_, error in found]), time.process_time() - begun
            print(
                f"{seed} {camera.name}: {row[1]} of {row[0]} found, {row[3]} of {row[2]} false, "
                f"median {median:.0f} mm, {spent:.0f} s",
                flush=True,
            )
    print(f"found {100 * totals[1] / totals[0]:.1f} %, false {100 * totals[3] / totals[2]:.1f} %")


if __name__ == "__main__":
    main()
