"""Judges two phones without a common clock: measured strokes, filmed at different rates by clocks that drift apart.

What one phone alone sees of a stroke gives the time of its bounce. The differences of both bounces, a line over the
recording, bring the clocks together to milliseconds. Then each stroke, seen by both, has a time offset as an unknown of
its graph; a line through these offsets is the clock.
"""

from dataclasses import replace
from functools import partial
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.results import Results
from ballfg.dynamics import nominal_model
from ballfg.estimation import Settings, Smoother, dataset_surfaces, sighted_track
from ballfg.estimation.observations.rig import in_order
from ballfg.estimation.observations.sightings import TIME_OFFSET
from ballfg.progress import progress
from ballfg.tracks import Dataset, Track
from ballfg.tracks.sightings import Sightings
from ballfg.vision import Camera

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
