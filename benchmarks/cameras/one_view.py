"""Judges strokes that one camera saw, or two phones without a common clock, against the measured tracks of the same.

Of one camera: depth, intervals and bounces. The phones film at different rates by clocks that drift apart. What one of
them alone sees of a stroke gives the time of its bounce. The differences of both bounces, a line over the recording,
bring the clocks together to milliseconds. Then each stroke, seen by both, has a time offset as an unknown of its graph;
a line through these offsets is the clock.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.metrics import bootstrap, inside, median_and_quartiles, share
from ballfg.benchmarks.results import Results
from ballfg.dynamics import nominal_model
from ballfg.estimation import Estimate, Estimator, Settings, Smoother, dataset_surfaces, sighted_track
from ballfg.estimation.observations.rig import in_order
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.estimation.observations.sightings import TIME_OFFSET, sightings_of
from ballfg.estimation.registry import make_estimator
from ballfg.front import estimator_for
from ballfg.learning.calibration.calibrate import calibrate
from ballfg.learning.calibration.problem import population_model, population_settings, pose
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.progress import progress
from ballfg.tracks import Dataset, Track
from ballfg.tracks.sightings import Sightings
from ballfg.vision import Camera
from ballfg.vision.calibration.focal import pose_and_focal
from ballfg.vision.calibration.table_points import Marked
from ballfg.vision.projection import changed

METHOD: Final = "smoother, one camera"
CALIBRATED: Final = "smoother, one camera, calibrated by the view's other strokes"
ROUGH: Final = "smoother, one camera, roughly known"
CLICKED: Final = 8
"""Cameras whose errors and clicks are drawn, for the same strokes."""
FAILED: Final = 1.0
"""m, error of a stroke from which it counts as a failure, as one without states does."""
FOCAL: Final = 0.05
"""Relative error of the focal length of a camera that is known roughly, up or down."""
TURN, MOVE = np.deg2rad(2.0), 0.1
"""rad and m, errors of the pose, in any direction."""
CLICK: Final = 3.0
"""px, noise of each coordinate of a corner."""
LEVEL: Final = 0.9
LEAST: Final = 8
"""Strokes of a view of which one half can calibrate for the other."""


@dataclass(frozen=True)
class Stroke:
    """One stroke against its measured track.

    Attributes:
        error: m, root mean square over the stamps.  within: (n, 3) True inside the 90 % interval of an axis.
        late: s, and apart, m: distance in time and in place from the measured track's bounce; NaN without one.
        duration: s, of the estimate.
    """

    error: float
    within: NDArray[np.bool_]
    late: float
    apart: float
    duration: float


def run_views(results: Results, views: Sequence[SightedDataset], truth: Dataset) -> None:
    """Adds the rows of each view, with the nominal ball and with one that the view's other half calibrated.

    If the view states the table's ends, also those with a camera that is known roughly.

    The case is the name of the view. Every second stroke calibrates for the others, and the others for it.

    Args: views: strokes of one camera each.  truth: their measured tracks, under the same names.
    Raises: ValueError: a view without a stroke of the truth.
    """
    known: dict[str, Track] = {track.name: track for track in truth}
    measured = estimator_for(truth)
    whole = {name: measured.estimate(track.since_first()) for name, track in known.items()}
    for view in views:
        tracks = [track for track in view if track.name in known]
        if not tracks:
            raise ValueError(f"{view.path} must hold tracks of {truth.path}; it holds none. Give views of its strokes.")
        nominal = estimator_for(view)
        nominal.estimate(tracks[0])  # machine code is compiled once

        def judged(estimator: Estimator, track: Track) -> Stroke:
            begun = time.perf_counter()
            estimate = estimator.estimate(track)
            duration = time.perf_counter() - begun
            return _judged(estimate, known[track.name], whole[track.name], duration)

        watched = progress(tracks, len(tracks), f"strokes of {view.info.name}")
        _add(results, view.info.name, METHOD, [judged(nominal, track) for track in watched])
        if view.info.table_extent is not None:
            rough = (track for number in range(CLICKED) for track in roughly_known(view, tracks, results.seed + number))
            watched = progress(rough, CLICKED * len(tracks), f"strokes of {view.info.name}, camera roughly known")
            _add(results, view.info.name, ROUGH, [judged(nominal, track) for track in watched])
        if len(tracks) < LEAST:
            continue
        found = list[Stroke]()
        for fit, judge in ((tracks[::2], tracks[1::2]), (tracks[1::2], tracks[::2])):
            estimator = calibrated(view, [track.name for track in fit])
            found += [judged(estimator, track) for track in judge]
        _add(results, view.info.name, CALIBRATED, found)


def calibrated(view: SightedDataset, names: Sequence[str]) -> Estimator:
    """The smoother with a ball that some strokes of a view calibrated, as `ballfg-train` with `kind: calibrate` does.

    Args: view: of one camera.  names: of those strokes.
    """
    problem = pose(view, nominal_model(view.ball), CalibrationConfig())
    problem = replace(problem, split=replace(problem.split, fit=tuple(names), judge=()))
    *_, last = calibrate(problem, watch=progress)
    model, settings = population_model(problem, last), population_settings(problem, last)
    return make_estimator("smoother", model, problem.surfaces, settings)


def _judged(estimate: Estimate, track: Track, whole: Estimate, duration: float) -> Stroke:
    """One estimate against the measured track, and its first bounce against that of the track's estimate."""
    error = estimate.states[:, :3] - _at(track, estimate.times - estimate.times[0])
    late = apart = np.nan
    if estimate.contacts and whole.contacts:
        one, other = estimate.contacts[0].time - estimate.times[0], whole.contacts[0].time
        late = abs(one - other)
        apart = float(np.linalg.norm(_place(estimate, estimate.times[0] + one) - _place(whole, other)))
    within = inside(error, estimate.sigmas[:, :3], LEVEL)
    lost = np.inf if estimate.status.failed else float(np.sqrt((error**2).sum(axis=1).mean()))
    return Stroke(lost, within, late, apart, duration)


def _place(estimate: Estimate, at: float) -> Array:
    """(2,) m, horizontal place at a bounce: the state before it, moved on in a straight line."""
    row = max(int(np.searchsorted(estimate.times, at, side="right")) - 1, 0)
    state = estimate.states[row]
    return np.asarray(state[:2] + (at - estimate.times[row]) * state[3:5])


def _add(results: Results, case: str, method: str, found: Sequence[Stroke]) -> None:
    """The rows of one view and method."""
    add, n, rng = partial(results.add, case, method), len(found), np.random.default_rng(results.seed)
    errors = 1e3 * np.array([stroke.error for stroke in found])
    add("error_median", "mm", bootstrap(lambda rows: np.median(errors[rows], axis=-1), n, rng), n)
    add("error_p90", "mm", float(np.quantile(errors, 0.9)), n)
    add("failures", "1", share([stroke.error > FAILED for stroke in found]), n)
    held = np.array([stroke.within.mean(axis=0) for stroke in found])
    for axis, name in enumerate("xyz"):
        add(f"coverage_90_{name}", "1", float(held[:, axis].mean()), n)
    late, apart = (np.array([getattr(stroke, name) for stroke in found]) for name in ("late", "apart"))
    add("bounce_time_median", "ms", 1e3 * float(np.nanmedian(late)), int(np.isfinite(late).sum()))
    add("bounce_place_median", "mm", 1e3 * float(np.nanmedian(apart)), int(np.isfinite(apart).sum()))
    add("time", "s", median_and_quartiles([stroke.duration for stroke in found]), n)


def roughly_known(view: SightedDataset, tracks: list[Track], seed: int) -> Iterator[Track]:
    """The tracks of a view as a camera sees them that corners of the table gave back.

    Args: view: of one camera, with the ends of its table.  seed: of the camera's errors and of the clicks.
    Raises: ValueError: a view without the table's ends.
    """
    if view.info.table_extent is None:
        raise ValueError(f"{view.path} must state the table's ends, frame.table; it does not. Add them.")
    low_x, high_x, low_y, high_y = view.info.table_extent
    height, (camera,), rng = view.info.table_height, view.cameras, np.random.default_rng(seed)
    corners = np.array([(x, y, height) for x in (low_x, high_x) for y in (low_y, high_y)])
    clicks = camera.project(corners) + CLICK * rng.standard_normal((4, 2))
    zoom = np.log1p(rng.choice((-FOCAL, FOCAL)))
    wrong = changed(camera, np.concatenate((TURN * _direction(rng), MOVE * _direction(rng), [zoom])))
    found = pose_and_focal(wrong, Marked(("a", "b", "c", "d"), corners, clicks, CLICK), FOCAL).camera
    model = nominal_model(view.ball)
    for track in tracks:
        sightings = sightings_of(track).sightings
        again = sighted_track(track.name, sightings, [found], track.labels, model=model)
        yield replace(again, dataset=view)


def _direction(rng: np.random.Generator) -> Array:
    """(3,) a unit vector."""
    drawn = rng.standard_normal(3)
    return np.asarray(drawn / np.linalg.norm(drawn))


CASE: Final = "two phones, clocks 0.3 s apart, drifting by 50 ppm"
RATES: Final = (240.0, 60.0)
"""Hz, of the phones."""
LATE: Final = 0.3
"""s, of the second phone's stamps at the start."""
DRIFT: Final = 50e-6
"""Relative, of its clock."""
NOISE: Final = 2.0
"""px"""
INTERVAL: Final = 3.0
"""s from one stroke to the next."""
EVERY: Final = 3
"""One of so many strokes of the dataset is filmed."""
ALONE: Final = 60.0
"""Hz, most frames of one phone alone: more cost time and show a bounce no better."""
WRONG: Final = 0.02
"""s. Bounces whose difference is farther from the median are not the same bounce."""
NEAR: Final = 0.005
"""s, prior standard deviation of a stroke's time offset."""


def run_phones(results: Results, cameras: tuple[Camera, Camera], truth: Dataset) -> None:
    """Adds the rows. Args: cameras: at two places.  truth: measured tracks of strokes."""
    rng, strokes = np.random.default_rng(results.seed), list(truth)[::EVERY]
    filmed = [tuple(_film(track, n, k, cameras[k], rng) for k in range(2)) for n, track in enumerate(strokes)]
    model, surfaces = nominal_model(truth.ball), dataset_surfaces(truth)
    settings = Settings.for_measured(model)
    plain = Smoother(model, surfaces, settings)
    free = Smoother(model, surfaces, replace(settings, time_offsets={cameras[1].name: NEAR}))

    bounces = []
    for both in progress(filmed, len(filmed), "strokes seen by each phone alone"):
        bounces.append([_bounce(plain, seen, camera) for seen, camera in zip(both, cameras, strict=True)])
    first, late = (np.array(bounces) @ [[1.0, -1.0], [0.0, 1.0]]).T
    same = np.abs(late - np.nanmedian(late)) < WRONG
    clock = np.polyfit(first[same], late[same], 1)

    offsets = []
    for both in progress(filmed, len(filmed), "strokes seen by both phones"):
        estimate = free.estimate(_together(both, cameras, clock))
        column = estimate.unknown_names.index(TIME_OFFSET + cameras[1].name)
        sigma = np.sqrt(estimate.unknown_covariance[column, column])
        offsets.append((estimate.times.mean(), estimate.unknowns[column], 1.0 / sigma))
    middle, more, weight = np.array(offsets).T
    clock = clock + np.polyfit(middle, more, 1, w=weight)

    errors = []
    for n, both in enumerate(progress(filmed, len(filmed), "strokes on one clock")):
        estimate = plain.estimate(_together(both, cameras, clock))
        error = estimate.states[:, :3] - _at(strokes[n], estimate.times - INTERVAL * n)
        errors.append(float(np.sqrt((error**2).sum(axis=1).mean())))
    off = np.polyval(clock, middle) - LATE - DRIFT * middle
    add, n = partial(results.add, CASE, "bounces, then time offsets"), len(errors)
    add("error_median", "mm", 1e3 * float(np.median(errors)), n)
    add("largest_offset_error", "ms", 1e3 * float(np.abs(off).max()), n)
    add("drift_error", "1e-6", 1e6 * float(clock[0] - DRIFT), n)


def _film(track: Track, number: int, phone: int, camera: Camera, rng: np.random.Generator) -> Sightings:
    """One phone's sightings of a stroke, with the stamps of its clock."""
    times = INTERVAL * number + np.arange(rng.uniform() / RATES[phone], track.duration, 1.0 / RATES[phone])
    pixels = camera.project(_at(track, times - INTERVAL * number)) + NOISE * rng.standard_normal((len(times), 2))
    stamps = times + phone * (LATE + DRIFT * times)
    camera_of = np.zeros(len(times), dtype=np.int64)
    return Sightings((camera.name,), camera_of, stamps, pixels, np.tile(NOISE**2 * np.eye(2), (len(times), 1, 1)))


def _at(track: Track, times: Array) -> Array:
    """(n, 3) m, the measured positions at times (n,) s since the first."""
    return np.stack([np.interp(times, track.seconds, places) for places in track.positions.T], axis=1)


def _bounce(smoother: Smoother, seen: Sightings, camera: Camera) -> float:
    """s, stamp of the first bounce that one phone alone sees; NaN without one."""
    step = max(1, round(len(seen) / (ALONE * np.ptp(seen.times))))
    track = sighted_track("stroke", seen.select(np.arange(0, len(seen), step)), [camera], surfaces=smoother.surfaces)
    contacts = smoother.estimate(track).contacts
    return contacts[0].time if contacts else float("nan")


def _together(both: tuple[Sightings, ...], cameras: tuple[Camera, Camera], clock: Array) -> Track:
    """The track of a stroke that both phones saw. Args: clock: drift and lateness (s) of the second."""
    one, other = both
    times = np.concatenate((one.times, (other.times - clock[1]) / (1.0 + clock[0])))
    camera = np.repeat([0, 1], [len(one), len(other)])
    pixels, spread = (np.concatenate((getattr(one, name), getattr(other, name))) for name in ("pixels", "covariances"))
    rows = Sightings(tuple(c.name for c in cameras), camera, times, pixels, spread)
    return sighted_track("stroke", in_order(rows, cameras), cameras)
