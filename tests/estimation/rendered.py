"""Rendered rallies of one camera that pans and zooms, with truth: what is found, and how far off it is.

    python -m tests.estimation.rendered --count 6 --seed 0 [--rate 60] [--view behind] [--half]

renders rallies (strokes of `tests.estimation.population`, whose ball, spins and scatter are those that the intervals
are for) with bars of motion blur, players as moving shapes with white shoes, noise and video compression, and prints a
line for each and the sums. Each seed draws its view (from the side, behind a player, a corner, or near behind a player
who hides part of the table), the light, the focal length (and so the ball's size), the compression and how much the
camera shakes. With `--half` the candidates are those of another detector: half of the balls, with a noise of a pixel,
and twenty false ones in each picture.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.rally.video import Rally, track_moving_camera
from ballfg.state import POSITION, SPIN, VZ
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.given import read_candidates
from ballfg.vision.broadcast.lines import moved
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.detection.video import open_video
from tests.estimation.observations.sighted_rig import TABLE
from tests.estimation.population import STEP, Scattered, drawn_ball, scattered
from tests.estimation.rallies import MODEL
from tests.vision.broadcast.own import write_candidates
from tests.vision.broadcast.scene import COURT, looking, panned, picture

EXPOSURE, LENGTH = 0.45, 6.0  # of the time between pictures; s
NOISE, BOUNCE = 1.0, 0.02  # px, of another detector; s, within which a bounce is found
VIEWS = {
    "side": ((0.4, -8.0, 3.6), 1000.0),
    "behind": ((-8.5, -0.8, 3.2), 1350.0),
    "corner": ((-5.5, -5.5, 3.0), 1050.0),
    "near": ((-5.5, 0.9, 2.2), 800.0),
}
"""Places, m, and focal lengths, px."""
LIGHT, ZOOM, QUALITY, SHAKE = (0.5, 1.0), (0.7, 1.0), (35, 90), 4e-4
"""Ranges of the share of the full light, of the view's focal length and of JPEG's quality; rad a picture."""


@dataclass(frozen=True)
class Truth:
    """Strokes with times in the video, s, the cameras of its pictures, the share of light and JPEG's quality."""

    view: str
    strokes: tuple[Scattered, ...]
    cameras: tuple[Pinhole, ...]
    light: float
    quality: int

    @property
    def bounces(self) -> list[float]:
        """Times, s, of the bounces."""
        return [
            one.begin + STEP * (1 + row)
            for one in self.strokes
            for row in np.flatnonzero(np.diff(one.path[:, VZ]) > 1.0)
        ]

    def at(self, t: float) -> Array | None:
        """(9,) state with the table's surface at z = 0; None where no ball is in play."""
        for one in self.strokes:
            if one.begin < t <= one.end:
                state = one.at(t)
                state[2] -= TABLE
                return state
        return None


def truth(view: str, rate: float, seed: int) -> Truth:
    """Strokes of a rally, each from where the one before ends, and a camera that follows a little."""
    rng, now, found = np.random.default_rng(seed), 0.6, list[Scattered]()
    ball = drawn_ball(rng)
    side = float(rng.choice([-1, 1]))
    place = np.array([side * 1.5, rng.uniform(-0.4, 0.4), TABLE + 0.25])
    while now < LENGTH - 1.0 and (drawn := scattered(now, place, -side, ball, rng)) is not None:
        found.append(drawn)
        place, now, side = drawn.at(drawn.end)[POSITION], drawn.end, -side
    centre, focal = VIEWS[view]
    first = looking(np.add(centre, rng.normal(0.0, 0.3, 3)), (0.0, 0.0, 0.1), focal * rng.uniform(*ZOOM))
    cameras = panned(first, int(LENGTH * rate), rng.normal(0.0, 0.06), rng.normal(0.0, 0.05))
    shaken = [moved(one, np.append(rng.normal(0.0, SHAKE, 3), np.zeros(4))) for one in cameras]
    return Truth(view, tuple(found), tuple(shaken), rng.uniform(*LIGHT), int(rng.integers(*QUALITY)))


def pictures(of: Truth, rate: float, seed: int) -> Iterator[Image]:
    """The pictures, with two players who sway behind the ends of the table."""
    rng = np.random.default_rng([seed, 1])
    half = 0.5 * EXPOSURE / rate
    for number, camera in enumerate(of.cameras):
        t = number / rate
        ends = [of.at(t - half), of.at(t + half)]
        bar = [one[POSITION] for one in ends if one is not None]
        others = list[tuple[Array, float]]()
        for end in (-1.0, 1.0):
            sway = 0.35 * np.sin(2.0 * t + end) + 0.1 * np.sin(7.0 * t) - 0.5 * (of.view == "near")
            for low, high, wide, level in ((-0.7, 0.75, 0.2, 45), (-0.76, -0.66, 0.14, 235)):
                box = [(end * 2.3, sway + y, z) for y, z in ((-wide, low), (wide, low), (wide, high), (-wide, high))]
                if of.view != "behind" or end > 0.0:  # there he would hide most of the table
                    others.append((np.array(box), level))
        image = picture(camera, rng, [np.stack(bar)] if len(bar) == len(ends) else [], others)
        dark = np.asarray(np.round(of.light * image), dtype=np.uint8)
        packed = cv2.imencode(".jpg", dark, (cv2.IMWRITE_JPEG_QUALITY, of.quality))[1]
        yield np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)


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


def film(of: Truth, path: Path, rate: float, seed: int) -> None:
    """Writes the pictures as a compressed video."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, of.cameras[0].size)
    for image in pictures(of, rate, seed):
        writer.write(image)
    writer.release()


@dataclass
class Score:
    """Sums over rallies: strokes and those found, false ones, errors (m) of samples, whether 90 % intervals hold.

    And signs of spins that are right, of all beyond 60 rad/s and of those known to 2 sigma, and bounces within `BOUNCE`
    of the true ones, each with the number of all.
    """

    strokes: int
    found: int
    false: int
    errors: Sequence[float]
    held: Sequence[bool]
    spins: tuple[int, ...]
    bounces: tuple[int, int] = (0, 0)


@dataclass
class CameraScore:
    """Errors of place and focal length, of the true ones, and whether 90 % intervals hold."""

    place: float
    focal: float
    held: Sequence[bool]


def camera_judged(shot: Shot, of: Truth) -> CameraScore:
    """The cameras of a shot against the truth: the place, and three pictures' focal lengths."""
    pictures = [0, len(shot) // 2, len(shot) - 1]
    pairs = [(shot.cameras[k], of.cameras[shot.first + k]) for k in pictures]
    sigmas = [np.sqrt(np.diag(shot.covariances[k])) for k in pictures]
    true = pairs[0][1]
    off = pairs[0][0].place - true.place
    held = (np.abs(off) < 1.645 * sigmas[0][3:6]).tolist()
    focal = [np.log(found.focal / real.focal) for found, real in pairs]
    held += [abs(error) < 1.645 * sigma[6] for error, sigma in zip(focal, sigmas, strict=True)]
    return CameraScore(float(np.linalg.norm(off) / np.linalg.norm(true.place)), float(np.abs(focal).max()), held)


def judged(rally: Rally, of: Truth) -> Score:
    """A rally against the truth."""
    found, false, errors, held, spins = set[int](), 0, list[float](), list[bool](), np.zeros(4, dtype=int)
    for estimate in (one for shot in rally.shots for one in shot.estimates):
        middle = float(np.median(estimate.times))
        numbers = [i for i, one in enumerate(of.strokes) if one.begin < middle <= one.end]
        states = [of.at(float(t)) for t in estimate.times]
        good = [i for i, state in enumerate(states) if state is not None]
        off = np.array([estimate.states[i, POSITION] - states[i][POSITION] for i in good])
        if not numbers or not len(off) or np.median(np.linalg.norm(off, axis=1)) > 0.5:
            false += 1
            continue
        found.add(numbers[0])
        errors.append(float(np.sqrt((off**2).sum(axis=1).mean())))
        sigmas = np.array([np.sqrt(np.diag(estimate.covariances[i]))[POSITION] for i in good])
        held += (np.abs(off) < 1.645 * sigmas).ravel().tolist()
        true = states[good[0]][SPIN]
        if abs(true[1]) > 60.0:
            spin, sigma = estimate.states[good[0], SPIN][1], np.sqrt(estimate.covariances[good[0]][SPIN, SPIN][1, 1])
            right, known = bool(np.sign(true[1]) == np.sign(spin)), bool(abs(spin) > 2.0 * sigma)
            spins += (right, 1, right and known, known)
    bounces = [event.t for event in rally.events if event.kind == "bounce"]
    near = sum(any(abs(t - true) < BOUNCE for t in bounces) for true in of.bounces)
    return Score(len(of.strokes), len(found), false, errors, held, tuple(spins.tolist()), (near, len(of.bounces)))


def main() -> None:
    """Prints a line for each rally and view, and the sums."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--count", type=int, default=2, help="number of rallies")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--rate", type=float, default=25.0, help="Hz")
    parser.add_argument("--view", choices=VIEWS, help="the same for all")
    parser.add_argument("--half", action="store_true", help="candidates of another detector")
    given = parser.parse_args()
    scores, cameras = list[Score](), list[CameraScore]()
    for seed in range(given.seed, given.seed + given.count):
        view = given.view or list(VIEWS)[seed % len(VIEWS)]
        of = truth(view, given.rate, seed)
        begun = time.process_time()
        with tempfile.TemporaryDirectory() as folder:
            path = Path(folder) / "rally.mp4"
            film(of, path, given.rate, seed)
            video, own = open_video(path), None
            if given.half:
                table, stamps = Path(folder) / "candidates.csv", np.arange(len(of.cameras)) / given.rate
                write_candidates(table, balls(of, given.rate, seed), stamps, of.cameras[0].size, NOISE, seed)
                own = partial(read_candidates, table)
            try:
                rally = track_moving_camera(video.frames, COURT, MODEL, count=video.count, candidates=own)
            except ValueError as error:
                print(f"{seed} {view}: {error}", flush=True)
                scores.append(Score(len(of.strokes), 0, 0, [], [], (0, 0, 0, 0)))
                continue
        cameras.append(seen := camera_judged(rally.motion.shots[0], of))
        scores.append(one := judged(rally, of))
        print(
            f"{seed} {view}, light {of.light:.1f}, {of.cameras[0].focal:.0f} px, quality {of.quality}: "
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
