"""Judges rendered rallies of one camera that pans and zooms against the truth: what is found, and how far off it is.

Strokes are those of `strokes`, for which the intervals are; pictures have bars of motion blur, players as moving shapes
with white shoes, noise and video compression. Each seed draws its view (from the side, behind a player, a corner, or
near behind a player who hides part of the table), the light, the focal length (and so the ball's size), the compression
and how much the camera shakes. Those of varied looks draw colours, the size of the pictures and judges, too.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.hall import COURT, PLAIN, SIZE, Colour, Look, looking, panned, picture
from ballfg.benchmarks.cameras.looks import SHIRTS, SIZES, drawn_look, judges
from ballfg.benchmarks.cameras.strokes import MODEL, STEP, TABLE, Scattered, drawn_ball, scattered
from ballfg.benchmarks.metrics import median_and_quartiles, median_and_range, share
from ballfg.benchmarks.results import Results, in_processes
from ballfg.estimation.rally.video import OwnCandidates, Rally, track_moving_camera
from ballfg.state import POSITION, SPIN, VZ
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.lines import moved
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.detection.video import open_video

EXPOSURE: Final = 0.45
"""Of the time between pictures."""
LENGTH: Final = 6.0
"""s, of a rally."""
BOUNCE: Final = 0.02
"""s, within which a bounce is found."""
SPUN: Final = 60.0
"""rad/s of top- or backspin whose sign counts."""
VIEWS: Final = {
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
    """Strokes with times in the video, s, the cameras of its pictures, the share of light and JPEG's quality.

    Attributes: judges: polygons and colours of people who sit.  shirts: of both players.
    """

    view: str
    strokes: tuple[Scattered, ...]
    cameras: tuple[Pinhole, ...]
    light: float
    quality: int
    look: Look = PLAIN
    judges: tuple[tuple[Array, Colour], ...] = ()
    shirts: tuple[Colour, Colour] = ((45, 45, 45), (45, 45, 45))

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
    first = looking(np.add(centre, rng.normal(0.0, 0.3, 3)).tolist(), (0.0, 0.0, 0.1), focal * rng.uniform(*ZOOM))
    cameras = panned(first, int(LENGTH * rate), rng.normal(0.0, 0.06), rng.normal(0.0, 0.05))
    shaken = [moved(one, np.append(rng.normal(0.0, SHAKE, 3), np.zeros(4))) for one in cameras]
    return Truth(view, tuple(found), tuple(shaken), rng.uniform(*LIGHT), int(rng.integers(*QUALITY)))


def varied(of: Truth, seed: int) -> Truth:
    """The same rally in a hall of another look, in pictures of another size."""
    rng = np.random.default_rng([seed, 3])
    size = SIZES[rng.integers(len(SIZES))]
    cameras = tuple(replace(one, size=size, focal=one.focal * size[0] / SIZE[0]) for one in of.cameras)
    left, right = (SHIRTS[k] for k in rng.integers(len(SHIRTS), size=2))
    return replace(of, cameras=cameras, look=drawn_look(rng), judges=tuple(judges(rng)), shirts=(left, right))


def pictures(of: Truth, rate: float, seed: int) -> Iterator[Image]:
    """The pictures, with two players who sway behind the ends of the table."""
    rng = np.random.default_rng([seed, 1])
    half = 0.5 * EXPOSURE / rate
    for number, camera in enumerate(of.cameras):
        t = number / rate
        ends = [of.at(t - half), of.at(t + half)]
        bar = [one[POSITION] for one in ends if one is not None]
        others = list(of.judges)
        for end, shirt in zip((-1.0, 1.0), of.shirts, strict=True):
            sway = 0.35 * np.sin(2.0 * t + end) + 0.1 * np.sin(7.0 * t) - 0.5 * (of.view == "near")
            for low, high, wide, colour in ((-0.7, 0.75, 0.2, shirt), (-0.76, -0.66, 0.14, (235, 235, 235))):
                box = [(end * 2.3, sway + y, z) for y, z in ((-wide, low), (wide, low), (wide, high), (-wide, high))]
                if of.view != "behind" or end > 0.0:  # there he would hide most of the table
                    others.append((np.array(box), colour))
        image = picture(camera, rng, [np.stack(bar)] if len(bar) == len(ends) else [], others, look=of.look)
        dark = np.asarray(np.round(of.light * image), dtype=np.uint8)
        packed = cv2.imencode(".jpg", dark, (cv2.IMWRITE_JPEG_QUALITY, of.quality))[1]
        yield np.asarray(cv2.imdecode(packed, cv2.IMREAD_COLOR), dtype=np.uint8)


def film(of: Truth, path: Path, rate: float, seed: int) -> None:
    """Writes the pictures as a compressed video."""
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, of.cameras[0].size)
    for image in pictures(of, rate, seed):
        writer.write(image)
    writer.release()


@dataclass
class Score:
    """Sums over rallies: strokes and those found, false ones, errors (m) of samples, whether 90 % intervals hold.

    And signs of spins that are right, of all beyond `SPUN` and of those known to 2 sigma, and bounces within `BOUNCE`
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
        states = ((i, of.at(float(t))) for i, t in enumerate(estimate.times))
        true = {i: state for i, state in states if state is not None}
        off = np.array([estimate.states[i, POSITION] - state[POSITION] for i, state in true.items()])
        if not numbers or not len(off) or np.median(np.linalg.norm(off, axis=1)) > 0.5:
            false += 1
            continue
        found.add(numbers[0])
        errors.append(float(np.sqrt((off**2).sum(axis=1).mean())))
        sigmas = np.array([np.sqrt(np.diag(estimate.covariances[i]))[POSITION] for i in true])
        held += (np.abs(off) < 1.645 * sigmas).ravel().tolist()
        first, state = next(iter(true.items()))
        spin, sigma = estimate.states[first, SPIN][1], np.sqrt(estimate.covariances[first][SPIN, SPIN][1, 1])
        if abs(state[SPIN][1]) > SPUN:
            right, known = bool(np.sign(state[SPIN][1]) == np.sign(spin)), bool(abs(spin) > 2.0 * sigma)
            spins += (right, 1, right and known, known)
    bounces = [event.t for event in rally.events if event.kind == "bounce"]
    near = sum(any(abs(t - true) < BOUNCE for t in bounces) for true in of.bounces)
    return Score(len(of.strokes), len(found), false, errors, held, tuple(spins.tolist()), (near, len(of.bounces)))


@dataclass(frozen=True)
class Filmed:
    """A rally to film: its seed, Hz, its view (None: that of its seed), and whether its look is drawn."""

    seed: int
    rate: float
    view: str | None = None
    varied: bool = False

    @property
    def truth(self) -> Truth:
        """What happens in it."""
        plain = truth(self.view or list(VIEWS)[self.seed % len(VIEWS)], self.rate, self.seed)
        return varied(plain, self.seed) if self.varied else plain


def rated(filmed: Filmed, candidates: OwnCandidates | None = None) -> tuple[Score, CameraScore | None]:
    """The scores of a rally; without a camera where no court is found. Args: candidates: of another detector."""
    of = filmed.truth
    with TemporaryDirectory() as folder:
        path = Path(folder) / "rally.mp4"
        film(of, path, filmed.rate, filmed.seed)
        video = open_video(path)
        try:
            rally = track_moving_camera(video.frames, COURT, MODEL, count=video.count, candidates=candidates)
        except ValueError:  # no court: nothing is found
            return Score(len(of.strokes), 0, 0, [], [], (0, 0, 0, 0), (0, len(of.bounces))), None
    return judged(rally, of), camera_judged(rally.motion.shots[0], of)


def run_rallies(results: Results, counts: Mapping[float, int], jobs: int) -> None:
    """Adds the rows. Args: counts: of rallies at each rate, Hz."""
    every = [Filmed(results.seed + number, rate) for rate, count in counts.items() for number in range(count)]
    found = in_processes(rated, every, jobs, "rallies of a moving camera drawn and tracked")
    for rate, count in counts.items():
        pairs = [pair for one, pair in zip(every, found, strict=True) if one.rate == rate]
        add_rally(results, f"a camera that pans and zooms, {rate:g} Hz", [one for one, _ in pairs])
        cameras = [camera for _, camera in pairs if camera is not None]
        add = partial(results.add, f"a camera that pans and zooms, {rate:g} Hz", "the camera")
        add("found", "1", share([camera is not None for _, camera in pairs]), count)
        add("place_error", "1", median_and_range([one.place for one in cameras] or [np.nan]), len(cameras))
        add("focal_error", "1", median_and_range([one.focal for one in cameras] or [np.nan]), len(cameras))


def add_rally(results: Results, case: str, scores: Sequence[Score]) -> None:
    """How many strokes and bounces are found, how far off the strokes are, and whether intervals and spins hold."""
    strokes, found, false = (sum(getattr(one, name) for one in scores) for name in ("strokes", "found", "false"))
    near, bounces = np.sum([one.bounces for one in scores], axis=0).tolist()
    right, asked, *_ = np.sum([one.spins for one in scores], axis=0).tolist()
    shares = {"strokes_found": (found, strokes), "false_strokes": (false, found + false)}
    shares |= {"bounces_found": (near, bounces), "spin_sign": (right, asked)}
    add = partial(results.add, case, "track")
    for name, (good, count) in shares.items():
        add(name, "1", share([True] * good + [False] * (count - good)) if count else np.nan, count)
    errors, held = (np.concatenate([getattr(one, name) for one in scores]) for name in ("errors", "held"))
    add("position_rmse", "mm", median_and_quartiles((1e3 * errors).tolist()) if found else np.nan, len(errors))
    add("coverage_90", "1", float(held.mean()) if found else np.nan, len(held))
