"""Predicts the later positions of whole tracks from their observed first parts."""

import math
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING, TypeAlias

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import as_float
from ballfg.estimation.batch import map_blocks
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.measurement.as_measured import measured_positions, true_times
from ballfg.estimation.out_of_distribution import out_of_distribution
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import sample_sigmas, total_sigmas
from ballfg.prediction.belief import Belief
from ballfg.prediction.propagate import Propagator
from ballfg.state import POSITION, STATE_DIM, VELOCITY
from ballfg.tracks import Track
from ballfg.tracks.stamps import STAMP_TOLERANCE

if TYPE_CHECKING:
    from matplotlib.figure import Figure

    from ballfg.estimation.conformal import ConformalScales

BLOCK = 16  # Number of tracks that are propagated together in one process
Observed: TypeAlias = float | Callable[[Track], float]
"""s from a track's first stamp; or a function that gives each track its own."""


@dataclass(frozen=True, eq=False)
class TrackPrediction:
    """Predicted positions of one track, with the model's measurement effects, at recorded stamps.

    Attributes:
        name: of the track.
        times: (k,) s, the stamps after the observed part; none if the track ends before.
        positions: (k, 3) m.
        sigmas: (k, 3) m, of a measured position: state and measurement noise. Measurement effects are
            left out of them, such as a stretch of lengths, or a lag that multiplies the velocity's sigma.
        measured: (k, 3) m, the track's positions at those stamps.
        estimate: from the observed part.
        conformal: the scales of the sigmas; None for the model's own sigmas.
        covariances: (k, 3, 3) m^2, of the positions, without measurement noise.
        carried: (k, 3, p) m times their units, covariances of the positions with the p coefficients that are estimated
            with the track, in the order of `Settings.coefficients`.
        outside: (k,) share from 0, where a network was trained, to 1 far from there; None for other models.
    """

    name: str
    times: Array
    positions: Array
    sigmas: Array
    measured: Array
    estimate: Estimate
    conformal: "ConformalScales | None" = None
    outside: Array | None = None
    covariances: Array | None = None
    carried: Array | None = None

    def __repr__(self) -> str:
        return f"TrackPrediction({self.name!r}, {len(self.times)} positions, {self.status.name.lower()})"

    @property
    def status(self) -> Status:
        """The status of the observed part's estimate."""
        return self.estimate.status

    def plot(self) -> "Figure":
        """A picture of x, y and z over time: the estimate, the prediction and what was measured, with 90 % bands."""
        from ballfg.estimation.picture import predicted

        return predicted(self)


def predict_tracks(
    estimator: Estimator,
    tracks: Iterable[Track],
    count: int,
    observe: Observed,
    *,
    horizon: float = np.inf,
    beyond: bool = False,
    jobs: int = 1,
) -> Iterator[TrackPrediction]:
    """Predictions in the order of the tracks.

    Args:
        estimator: estimates the observed part of each track.
        tracks: a stream; some tens at a time and process are in memory.
        count: approximate number of tracks.
        observe: s from the track's first stamp; a stamp at its end is observed. A function gives each track its own.
        horizon: s after the last observed stamp; later stamps are left out.
        beyond: True for further stamps after the last measured one, in the track's usual steps up to a finite horizon;
            what was measured there is NaN.
        jobs: processes.

    Raises: ValueError: if observe or horizon is not positive.
    """
    if not callable(observe):
        check_observe(observe)
    horizon = as_float("horizon", horizon, "s")
    if not horizon > 0.0:
        raise ValueError(f"horizon must be a positive number of seconds; got {horizon:g}. Leave it out for all stamps.")
    asked = _Asked(observe, horizon, beyond and math.isfinite(horizon))
    work = partial(_block, estimator, Propagator(estimator.surfaces, estimator.settings.process), asked)
    made = map_blocks(work, tracks, count, jobs, BLOCK)
    return (
        replace(one, estimate=replace(one.estimate, world=estimator.world)) if one.estimate.world is None else one
        for one in made
    )


def check_observe(observe: float) -> None:
    """Checks the length of the observed part.

    Args: observe: s.
    Raises: ValueError: if it is not positive and finite. TypeError: no number.
    """
    seconds = as_float("observe", observe, "s")
    if not 0.0 < seconds < math.inf:
        raise ValueError(
            f"observe must be a positive number of seconds; got {seconds:g}. A quarter of a second is 0.25."
        )


@dataclass(frozen=True)
class _Asked:
    """The arguments of `predict_tracks` that say which stamps are predicted."""

    observe: Observed
    horizon: float
    beyond: bool

    def opening(self, track: Track) -> Track:
        """The observed part."""
        return track.opening(self.observe(track) if callable(self.observe) else self.observe)

    def ahead(self, track: Track, begin: float, white: Array) -> tuple[Array, Array, Array]:
        """Stamps (k,) s after one, the measured positions (k, 3) m and the sigmas (k, 3) m of white noise there.

        Args: white: (n, 3) m, of the whole track.
        """
        later = (track.times > begin) & (track.times <= begin + self.horizon + STAMP_TOLERANCE)
        times, measured, white = track.times[later], track.positions[later], white[later]
        if not self.beyond or len(track) < 2:
            return times, measured, white
        step, last = float(np.median(np.diff(track.times))), max(float(track.times[-1]), begin)
        count = max(int((begin + self.horizon - last + STAMP_TOLERANCE) / step), 0) if step > 0.0 else 0
        usual = np.median(white, axis=0) if len(white) else np.zeros(3)
        return (
            np.concatenate((times, last + step * np.arange(1, count + 1))),
            np.concatenate((measured, np.full((count, 3), np.nan))),
            np.concatenate((white, np.tile(usual, (count, 1)))),
        )


def _block(
    estimator: Estimator, propagator: Propagator, asked: _Asked, tracks: Sequence[Track]
) -> list[TrackPrediction]:
    """Predictions of a block, without a model that all tracks share, so that processes need not send it."""
    for track in tracks:
        estimator.prepared(track)  # checks the whole track for metres and seconds
    counted = [track.since_first() for track in tracks]
    estimates = [estimator.estimate(asked.opening(track)) for track in counted]
    made: dict[int, TrackPrediction] = {}
    owners = [estimator.of(track) for track in counted]
    for owner in dict.fromkeys(owners):  # tracks with the same coefficients are predicted together
        rows = [i for i, own in enumerate(owners) if own is owner]
        alike = _predict_alike(owner, propagator, [estimates[i] for i in rows], [counted[i] for i in rows], asked)
        made.update(zip(rows, alike, strict=True))
    found = []
    for number, track in enumerate(tracks):  # with the stamps of the data
        one = made[number]
        seen, start = len(one.estimate.times), float(track.times[0]) - float(counted[number].times[0])
        estimate, times = one.estimate.dated(track.times[:seen]), track.times[seen : seen + len(one.times)]
        times = np.concatenate((times, start + one.times[len(times) :]))
        if not estimator.model.variations:  # else the world of each estimate is that of its track
            estimate = replace(estimate, world=None)
        found.append(replace(one, times=times, estimate=estimate))
    return found


def _predict_alike(
    estimator: Estimator, propagator: Propagator, estimates: list[Estimate], tracks: list[Track], asked: _Asked
) -> Iterator[TrackPrediction]:
    settings, model = estimator.settings, estimator.model
    noise = [sample_sigmas(settings, len(track), track.sigmas) for track in tracks]
    parts = [asked.ahead(t, float(e.times[-1]), w) for t, e, w in zip(tracks, estimates, noise, strict=True)]
    seen = [len(e.times) for e in estimates]
    stamps = [np.concatenate((t.times[:n], later)) for t, n, (later, _, _) in zip(tracks, seen, parts, strict=True)]
    clocks = [true_times(model, one) for one in stamps]
    ends = [float(clock[n - 1]) for clock, n in zip(clocks, seen, strict=True)]
    times = _padded([clock[n:] for clock, n in zip(clocks, seen, strict=True)], ends)
    belief = Belief.of(estimator.model, [e.last for e in estimates], estimator.settings.coefficients)
    belief = replace(belief, time=np.array(ends))
    positions, velocities = (np.zeros((*times.shape, 3)) for _ in range(2))
    covariances = np.zeros((*times.shape, 3, 3))
    carried = np.zeros((*times.shape, 3, len(estimator.settings.coefficients)))
    outside: Array | None = None
    for k, predicted in enumerate(propagator.walk(belief, times) if times.size else ()):
        velocities[:, k] = predicted.mean[:, VELOCITY]
        positions[:, k] = measured_positions(predicted.model, predicted.mean, estimator.surfaces)
        share = out_of_distribution(predicted.model, predicted.mean)
        if share is not None:
            outside = np.zeros(times.shape) if outside is None else outside
            outside[:, k] = share
        covariances[:, k] = predicted.covariance[:, POSITION, POSITION]
        carried[:, k] = predicted.covariance[:, POSITION, STATE_DIM:]
    for i, (track, result, (later, measured, white)) in enumerate(zip(tracks, estimates, parts, strict=True)):
        k = len(later)
        variances = np.diagonal(covariances[i, :k], axis1=1, axis2=2)
        stated = total_sigmas(settings, white, partial(np.asarray, velocities[i, :k]))
        sigmas = np.sqrt(variances + stated**2)
        left = None if outside is None else outside[i, :k]
        ahead = later, positions[i, :k], sigmas, measured
        yield TrackPrediction(track.name, *ahead, result, None, left, covariances[i, :k], carried[i, :k])


def _padded(times: list[Array], ends: list[float]) -> Array:
    """(n, k) s: each row's times, then repeats of the last; a row without any holds the end of its observation."""
    longest = max(map(len, times))
    rows = [np.concatenate(([end], row)) for row, end in zip(times, ends, strict=True)]
    return np.stack([np.pad(row, (0, longest + 1 - len(row)), mode="edge")[1:] for row in rows])
