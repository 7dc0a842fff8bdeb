"""Estimates the noise of a set of tracks by the calibration of forecasts within them."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable, Sequence
from contextlib import closing
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, Final, TypeVar

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_each, check_flag, check_instance, check_range
from ballfg.dynamics.compiled.kept_model import check_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.measurement.as_measured import plainly_measured
from ballfg.estimation.measurement.invert_measurement import InvertMeasurement
from ballfg.estimation.noise.forecasts import EARLIEST_START, START_EVERY, Forecaster
from ballfg.estimation.noise.linear_tracks import LEAST_SAMPLES, LinearTracks, linearise
from ballfg.estimation.noise.marginal import scatter_of
from ballfg.estimation.noise.parameters import (
    COEFFICIENTS,
    Parameter,
    by_logs,
    coefficient_factors,
    noise_of,
    parameters_of,
    track_noise,
    with_noise,
)
from ballfg.estimation.noise.profile import Profile
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.parallel.parts import with_jobs
from ballfg.parallel.work import on_one_thread
from ballfg.progress import Watch, unwatched
from ballfg.tracks import Track
from ballfg.tracks.noise import TrackNoise

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

T = TypeVar("T")

LONGEST_PART: Final = 0.75
"""s, usually used part of a track: forecasts of 0.3 s that start 0.2 s after the first sample or somewhat later."""
MOST_TRACKS: Final = 80
"""Number of used tracks, which take one to three seconds. By the noise that 20 show, 90 % intervals of the set may
hold 72 %."""
MOST_ITERATIONS: Final = 25
EARLIEST_SHARE: Final = 0.7
"""Share of a short track before the first forecast."""
EVERY_SHARE: Final = 0.12
"""Share of a short track between two starts."""
FIXED_TRACKER: Final = 0.1
"""Weight of the next samples where the tracker's errors are fixed: what these lack shows in the next samples, and would
count as motion. Else it is 1."""
MANY: Final = 0.1
"""Share of samples that estimates leave out as outliers beyond which stamps may err instead. To an estimate without
jitter those that err most look like outliers, and without them the jitter looks too small: then the tracks are
estimated anew with the jitter found. `robot_rallies`, where 6 % are left out, and simulated jitter of 1.5 ms, where a
quarter is, chose it."""
MOST_LOOKS: Final = 4
"""Largest number of such estimates."""
SETTLED: Final = 0.02
"""Share by which the jitter changes at most in the last one."""
OPEN: Final = 0.7
"""In standard deviations of the prior: an interval beyond it is open, since the prior and not the tracks ends it."""


@dataclass(frozen=True)
class NoiseEstimate:
    """The noise estimated from tracks.

    Attributes:
        noise: standard deviations.
        relative_errors: standard deviation of each number's logarithm, by name, with `.x`, `.y`, `.z` if there is one
            per axis, and `coefficients.` before that of a coefficient; the larger one of its two sides.
        intervals: of the same numbers, one standard deviation to each side, in their own units; from 0 or to infinity
            if the tracks do not bound a number below or above.
        coefficient_factors: spread of each coefficient from track to track, as a multiple of the settings'.
        settings: with that noise.
        held_before: share of forecast coordinates inside their 90 % intervals with the settings given.
        held: the same with this noise.
        tracks: number of used tracks.
        starts: number of forecast origins.
    """

    noise: TrackNoise
    relative_errors: dict[str, float]
    intervals: dict[str, tuple[float, float]]
    coefficient_factors: dict[str, float]
    settings: Settings
    held_before: float
    held: float
    tracks: int
    starts: int


def estimate_noise(
    model: BallModel,
    surfaces: Surfaces,
    settings: Settings,
    tracks: Iterable[Track],
    *,
    position_known: bool = False,
    tracker_known: bool = False,
    longest: float = LONGEST_PART,
    errors: bool = True,
    watch: Watch = unwatched,
    jobs: int = 1,
) -> NoiseEstimate | None:
    """The noise that makes forecasts 20 to 300 ms ahead within the tracks most probable.

    Every track is estimated once and linearised about the estimate; another noise then costs only a Kalman filter. The
    model stays: its errors count as noise.

    Args:
        model: the ball, and how it is measured.
        surfaces: table and floor.
        settings: prior medians of all numbers.
        tracks: measured positions.
        position_known: True if the settings' white noise of positions is fixed.
        tracker_known: True if the settings' memory of the tracker and jitter of the stamps are fixed.
        longest: s, used part of each track, from its first sample on. Errors of the model late in a track, after
            bounces, count as noise too.
        errors: True to compute error bars, which take several times as long.
        watch: called for each track and each step of the search.
        jobs: processes, then threads of the search.
    Returns: None if no track is long enough.
    """
    check_model(model, "Load one with load_model.")
    check_instance("settings", settings, Settings, "Make them with Settings.for_measured(model).")
    for name, flag in (("position_known", position_known), ("tracker_known", tracker_known), ("errors", errors)):
        check_flag(name, flag)
    check_range("longest", longest, 0.0, math.inf)
    measured = check_each("tracks", tracks, Track, "Make one with Track(times, positions).")
    parts = [part for track in measured if len(part := track.opening(longest)) >= LEAST_SAMPLES]
    own_sigmas = any(part.sigmas is not None for part in parts)
    about = settings if tracker_known else replace(settings, stamp_jitter=0.0)  # a guess of it moves no estimate
    known, found = (position_known or own_sigmas, tracker_known), None
    for _ in range(MOST_LOOKS):
        linear = linearised(model, surfaces, about, parts, watch, jobs=jobs)
        if linear is None:
            return None
        # torch's batches are small: its threads gain nothing, and slow each other down on a busy machine
        found = with_jobs(
            jobs, partial(on_one_thread, partial(_searched, parts, settings, known, errors, watch)), linear
        )
        jitter = 0.0 if found is None else found.noise.stamp_jitter or 0.0
        kept = float(linear.used.sum()) / sum(len(parts[number]) for number in linear.numbers.astype(int).tolist())
        if kept > 1.0 - MANY or jitter <= about.stamp_jitter * (1.0 + SETTLED):
            break
        about = replace(settings, stamp_jitter=jitter)
    return found


def _searched(
    parts: Sequence[Track],
    settings: Settings,
    known: tuple[bool, bool],
    errors: bool,
    watch: Watch,
    linear: LinearTracks,
) -> NoiseEstimate | None:
    """The noise of linearised parts of tracks; known: its white part, and what the tracker adds."""
    search = _search(parts, settings, known, linear)
    if not len(search.forecaster.starts):
        return None
    parameters = search.parameters
    watched = watch(range(2 * MOST_ITERATIONS), 2 * MOST_ITERATIONS, "steps of the noise")
    with closing(step for step in watched) as steps:
        logs = search.minimised(lambda: next(steps, None))
    sides = np.empty((0, 2))
    if errors:
        profile = search.profile(logs)
        logs, sides = profile.best, profile.sides()
    found = track_noise(parameters, logs, settings)
    return NoiseEstimate(
        noise=found,
        relative_errors=dict(zip(search.names, sides.max(axis=1).tolist(), strict=False)),
        intervals=dict(zip(search.names, _intervals(logs, sides, OPEN * search.spread), strict=False)),
        coefficient_factors=coefficient_factors(parameters, logs, settings),
        settings=with_noise(settings, found),
        held_before=search.held(search.start),
        held=search.held(logs),
        tracks=len(linear),
        starts=len(search.forecaster.starts),
    )


def held_with(model: BallModel, surfaces: Surfaces, settings: Settings, tracks: Iterable[Track]) -> float:
    """The share of forecast coordinates inside their 90 % intervals with a noise, on tracks that show theirs.

    Args: as of `estimate_noise`.
    """
    parts = [part for track in tracks if len(part := track.opening(LONGEST_PART)) >= LEAST_SAMPLES]
    known = (any(part.sigmas is not None for part in parts), False)

    def held(linear: LinearTracks) -> float:
        search = _search(parts, settings, known, linear)
        return search.held(search.start)

    linear = linearised(model, surfaces, replace(settings, stamp_jitter=0.0), parts)  # as `estimate_noise` has them
    return math.nan if linear is None else on_one_thread(held, linear)


def _search(parts: Sequence[Track], settings: Settings, known: tuple[bool, bool], linear: LinearTracks) -> _Search:
    """The search from the origins that a robot would use, or earlier ones in tracks that are too short."""
    typical = float(np.median([part.duration for part in parts]))
    earliest, every = min(EARLIEST_START, EARLIEST_SHARE * typical), min(START_EVERY, EVERY_SHARE * typical)
    biased = settings.has_memory or not known[1]
    weight = FIXED_TRACKER if known[1] else 1.0
    forecaster = Forecaster(linear, settings.velocity_prior, earliest, every, biased=biased, next_samples=weight)
    return _Search(forecaster, parameters_of(settings, linear, *known), settings)


def _intervals(logs: Array, sides: Array, wide: Array) -> list[tuple[float, float]]:
    """Limits at distances (k, 2) below and above logarithms (k,); open where a distance is beyond `wide` (k,)."""
    ends = np.exp(logs[: len(sides), None] + sides * (-1.0, 1.0))
    low, high = np.where(sides < wide[: len(sides), None], ends, (0.0, np.inf)).T.tolist()
    return list(zip(low, high, strict=True))


def linearised(
    model: BallModel,
    surfaces: Surfaces,
    settings: Settings,
    tracks: Sequence[Track],
    watch: Watch = unwatched,
    *,
    jobs: int = 1,
) -> LinearTracks | None:
    """Tracks linearised about estimates without memory of the tracker; None if all are short.

    Known jitter stays in: to white noise alone, stamps that err by more look like hits.

    Args:
        model: the ball, and how it is measured.
        surfaces: what it may bounce on.
        settings: their memory is ignored.
        tracks: measured.
        watch: called for each track.
        jobs: processes.
    """
    plain = replace(settings, memory=(0.0, 0.0, 0.0))
    tracks = [track.since_first() for track in tracks]
    if model.measures_plainly:
        return linearise(Smoother(model, surfaces, plain), tracks, watch, jobs=jobs)
    inverse = InvertMeasurement(Smoother, model, surfaces, plain)  # of measured positions as they happened
    undone = [one.track for one in map_tracks(inverse.undo, tracks, len(tracks), jobs)]
    plain = replace(plain, spin_label_noise=inverse.smoother.settings.spin_label_noise)
    found = linearise(Smoother(plainly_measured(model), surfaces, plain), undone, watch, jobs=jobs)
    if found is None or settings.launcher is not None:  # whose spins are no labels
        return found
    spread = plain.spin_label_noise / settings.spin_label_noise
    return replace(found, label_spreads=np.full_like(found.label_spreads, spread))


def spread_over(tracks: Iterable[T], count: int, most: int = MOST_TRACKS) -> list[T]:
    """Up to `most` tracks, evenly from the first `count` of a stream."""
    chosen = set(np.linspace(0, count - 1, min(most, count)).round().astype(int).tolist()) if count else set()
    found = []
    for number, track in enumerate(tracks):
        if number in chosen:
            found.append(track)
        if number + 1 >= count:
            break
    return found


class _Search:
    """The minimisation of the score, with the prior of each number, over their logarithms."""

    def __init__(self, forecaster: Forecaster, parameters: list[Parameter], settings: Settings) -> None:
        self.forecaster, self.parameters, self.settings = forecaster, parameters, settings
        self.low = np.log([p.low for p in parameters])
        self.high = np.log([p.high for p in parameters])
        self.start = np.clip(np.log([p.start for p in parameters]), self.low, self.high)
        self.spread = np.array([p.spread for p in parameters])
        self.weight = float(len(forecaster.starts))

    def value(self, logs: Array) -> tuple[float, Array]:
        """Negative log posterior and its gradient (k,); every start counts as one observation."""
        noise = noise_of(self.parameters, logs[None], self.settings)
        score = self.forecaster.score(noise)
        gradient = by_logs(self.parameters, noise, score.slopes).sum(axis=0)
        away = (logs - self.start) / self.spread
        value = self.weight * score.value + 0.5 * float(away @ away)
        return value, self.weight * gradient + away / self.spread

    def minimised(self, tick: Callable[[], object]) -> Array:
        """(k,) logarithms at the minimum."""

        def objective(logs: Array) -> tuple[float, Array]:
            tick()
            return self.value(logs)

        bounds = list(zip(self.low, self.high, strict=True))
        options = {"maxiter": MOST_ITERATIONS, "maxfun": 2 * MOST_ITERATIONS, "ftol": 1e-5}
        from scipy.optimize import minimize  # it takes half a second to import

        found = minimize(objective, self.start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
        return np.asarray(found.x)

    def profile(self, logs: Array) -> Profile:
        """The profile of the minimum near some logarithms (k,)."""
        return Profile(self.value, self._scatter, logs, self.spread, self.low, self.high)

    @property
    def names(self) -> list[str]:
        """Names of the numbers, with `.x`, `.y`, `.z` if there is one per axis, or that of the coefficient."""
        names = tuple(self.settings.coefficients)
        parts = [(p, names if p.name == COEFFICIENTS else "xyz") for p in self.parameters]
        return [p.name if p.axis is None else f"{p.name}.{of[p.axis]}" for p, of in parts]

    def _scatter(self, logs: Array) -> Array:
        """(k, k) sum over tracks of the squares of their gradients about the mean."""
        noise = noise_of(self.parameters, logs[None], self.settings)
        return scatter_of(self.weight * by_logs(self.parameters, noise, self.forecaster.score(noise).slopes))

    def held(self, logs: Array) -> float:
        """Share of forecast coordinates inside their 90 % intervals."""
        return self.forecaster.score(noise_of(self.parameters, np.asarray(logs)[None], self.settings)).held
