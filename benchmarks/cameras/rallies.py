"""Judges rendered rallies of one camera, moving or not, against the truth: what is found, and how far off it is."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from ballfg.benchmarks.cameras.films import Filmed, Truth, film
from ballfg.benchmarks.cameras.hall import COURT
from ballfg.benchmarks.cameras.strokes import MODEL
from ballfg.benchmarks.metrics import median_and_quartiles, median_and_range, share
from ballfg.benchmarks.results import Results, in_processes
from ballfg.estimation.one_camera import track_one_camera
from ballfg.estimation.rally.moments import Event
from ballfg.estimation.rally.video import OwnCandidates, surfaces_of, track_moving_camera
from ballfg.estimation.result import Estimate
from ballfg.state import POSITION, SPIN
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.detection.video import open_video
from ballfg.vision.tracking.pipeline import detect_videos

BOUNCE: Final = 0.02
"""s, within which a bounce is found."""
STANDING_RATE: Final = 50.0
"""Hz, of a camera that stands."""
SPUN: Final = 60.0
"""rad/s of top- or backspin whose sign counts."""


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


def judged(estimates: Iterable[Estimate], events: Iterable[Event], of: Truth) -> Score:
    """The strokes and events of a rally against the truth."""
    found, false, errors, held, spins = set[int](), 0, list[float](), list[bool](), np.zeros(4, dtype=int)
    for estimate in estimates:
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
    bounces = [event.t for event in events if event.kind == "bounce"]
    near = sum(any(abs(t - true) < BOUNCE for t in bounces) for true in of.bounces)
    return Score(len(of.strokes), len(found), false, errors, held, tuple(spins.tolist()), (near, len(of.bounces)))


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
    estimates = [one for shot in rally.shots for one in shot.estimates]
    return judged(estimates, rally.events, of), camera_judged(rally.motion.shots[0], of)


def rated_standing(filmed: Filmed) -> Score:
    """The score of a minute before a camera that stands and is calibrated, as `ballfg track` finds it."""
    of = filmed.truth
    camera = of.cameras[0].camera(of.view)
    with TemporaryDirectory() as folder:
        path = Path(folder) / "minute.mp4"
        film(of, path, filmed.rate, filmed.seed)
        (seen,) = detect_videos({of.view: path}, [camera])
    strokes = track_one_camera(seen, camera, MODEL, surfaces_of(COURT))
    return judged(strokes.estimates, strokes.events, of)


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


def run_standing(results: Results, count: int, jobs: int) -> None:
    """Adds the rows of minutes before a camera that stands, so many of them."""
    every = [Filmed(results.seed + number, STANDING_RATE, stands=True) for number in range(count)]
    if every:
        scores = in_processes(rated_standing, every, jobs, "minutes of a camera that stands drawn and tracked")
        add_rally(results, f"a camera that stands, minutes at {STANDING_RATE:g} Hz", scores)


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
