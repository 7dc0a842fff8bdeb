"""Tests linearised tracks for a tracker's memory and jittering stamps, and estimates their sizes.

Forecasts determine the width of intervals, but hardly how long a tracker's errors last; the density of the next samples
does. The test for a memory uses the likelihood without it: its derivative by the variance of the memory (score test, C.
R. Rao 1948), cleared of other parts of the noise, scatters about zero from track to track. The same holds for jitter.
The scatter is the tracks' own, so that noise of another shape is not named.
"""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array, Mask
from ballfg.estimation.noise.linear_filter import LinearFilter
from ballfg.estimation.noise.linear_tracks import LinearTracks
from ballfg.estimation.noise.marginal import MarginalFit
from ballfg.estimation.noise.parameters import Parameter, parameters_of
from ballfg.estimation.settings import Settings
from ballfg.tracks.noise import TrackNoise

MEMORY: Final = "tracker_memory"
JITTER: Final = "stamp_jitter"
NUMBERS: Final = {MEMORY: ("memory", "memory_time"), JITTER: ("stamp_jitter",)}
"""Fields of `TrackNoise` for each part of a tracker's noise."""
TIMES: Final = (0.005, 0.01, 0.02, 0.04)
"""s. Candidate durations of a memory; the score falls little between neighbours."""
LONGEST_TIME: Final = 0.06
"""s. Longer-lasting errors may belong to the motion and do not count as memory."""
CANDIDATES: Final = len(TIMES) + 1
ALWAYS: Final = ("position", "acceleration")
"""Numbers that also act from sample to sample: the white part, and forces that the model lacks."""
FOUND, CONFIRMED = 0.002, 0.05
"""Significance levels: of a part in all tracks, all candidates counted; of its confirmation in a half."""
COARSE, MOST_COARSE = 1.0, 15
"""Tolerance and most evaluations of fits that only test whether a part exists."""
KNOWN: Final = 2.5
"""Standard deviations by which every number of a named part must differ from zero."""
LEAST_TRACKS: Final = 5
"""Least number of tracks in a half for the scatter of scores."""
JITTER_UNIT: Final = 1e-3
"""s. The square of this jitter is the unit of its score."""
STATED_SPREAD: Final = 0.02
"""Standard deviation of the logarithm of a stated white noise."""
FAR: Final = 4.0
"""Times `STATED_SPREAD` from the stated white noise at which tracks contradict it, whatever the scatter of scores."""
AGREES: Final = 11.3
"""Chi-square of three numbers (99 %) up to which tracks agree with the stated white noise."""


@dataclass(frozen=True)
class Evidence:
    """The evidence of tracks for a part of a tracker's noise.

    Attributes:
        name: of the part.
        time: s, of a memory; 0 for jitter.
        p_value: probability of such a score of all tracks by chance, all candidates counted.
        halves: the same of each half, for this candidate alone.
    """

    name: str
    time: float
    p_value: float
    halves: tuple[float, float]

    @property
    def clear(self) -> bool:
        """True if both halves show it."""
        return self.p_value < FOUND and max(self.halves) < CONFIRMED


@dataclass(frozen=True)
class TrackerPart:
    """A part of a tracker's noise that shows in both halves of the tracks.

    Attributes:
        evidence: of both halves.
        values: value and standard deviation of `sigma` (m, or s for jitter), and of a memory's `time` (s).
        gains: (t,) log likelihood that it adds to each track.
        held_out: (t,) bool, tracks of the half that confirms.
    """

    evidence: Evidence
    values: dict[str, tuple[float, float]]
    gains: Array
    held_out: Mask


@dataclass(frozen=True)
class TrackerNoise:
    """All parts found, and the tracker's noise with them: white part, memory and jitter."""

    parts: tuple[TrackerPart, ...]
    noise: TrackNoise


def tracker_noise(
    tracks: LinearTracks, held_out: Mask, settings: Settings, stated: float | None = None
) -> TrackerNoise:
    """Parts of the tracker's noise that show in both halves of the tracks, with sizes from all tracks.

    Args:
        tracks: linearised.
        held_out: (t,) bool, tracks of the half that confirms.
        settings: all other noise; a memory or jitter in them is fixed and not tested.
        stated: m, white noise stated by the dataset; used unless the tracks contradict it.
    Returns: no parts if a half has fewer than `LEAST_TRACKS` tracks.
    """
    open_parts = {MEMORY: not settings.has_memory, JITTER: settings.stamp_jitter == 0.0}
    asked = [name for name, is_open in open_parts.items() if is_open]
    if min(held_out.sum(), (~held_out).sum()) < LEAST_TRACKS:
        white = np.array(settings.position_noise) * settings.position_scale
        return TrackerNoise((), TrackNoise(position=(white[0], white[1], white[2])))
    full, lean = (LinearFilter(tracks, settings.velocity_prior, biased=b) for b in (True, settings.has_memory))
    fits, found = (
        [MarginalFit(lean, settings, _parameters(settings, tracks, ()), tolerance=COARSE, most=MOST_COARSE)],
        list[Evidence](),
    )
    while asked:
        evidence = [e for name in asked for e in _evidence(full, fits[-1], name, held_out)]
        best = min(evidence, key=lambda e: e.p_value)
        if not best.clear:
            break
        asked.remove(best.name)
        needed = full if best.name == MEMORY or fits[-1].tracks is full else lean
        numbers = _parameters(settings, tracks, [*found, best])
        fit = MarginalFit(needed, settings, numbers, fits[-1].known, tolerance=COARSE, most=MOST_COARSE)
        if best.name == MEMORY and fit.values("memory_time") > LONGEST_TIME:
            continue
        fits.append(fit)
        found.append(best)
    return _sizes(fits, found, held_out, settings, stated)


def _parameters(settings: Settings, tracks: LinearTracks, parts: Iterable[Evidence]) -> list[Parameter]:
    """The numbers that act from sample to sample, with those of some parts."""
    times = {part.name: part.time for part in parts}
    names = [*ALWAYS, *(number for name in times for number in NUMBERS[name])]
    starts = {"memory_time": times.get(MEMORY, 0.0), "stamp_jitter": JITTER_UNIT}
    found = [p for p in parameters_of(settings, tracks, position_known=False) if p.name in names]
    return [replace(p, start=starts.get(p.name, p.start)) for p in found]


def _evidence(full: LinearFilter, fit: MarginalFit, name: str, held_out: Mask) -> list[Evidence]:
    """The score tests of a part that a fit does not include."""
    times = TIMES if name == MEMORY else (0.0,)
    found = []
    for time in times:
        score = _score(full if name == MEMORY else fit.tracks, fit, name, time)
        score = _cleared(score, fit.gradients)
        freedom = (len(score) - fit.gradients.shape[1]) / len(score)
        whole, *halves = (_p_value(score[some], freedom) for some in (slice(None), ~held_out, held_out))
        found.append(Evidence(name, time, min(1.0, CANDIDATES * whole), (halves[0], halves[1])))
    return found


def _cleared(scores: Array, others: Array) -> Array:
    """Scores (t,) or (t, m) of tracks minus their projection on the scores (t, k) of other numbers."""
    return np.asarray(scores - others @ np.linalg.lstsq(others, scores, rcond=None)[0])


def _score(tracks: LinearFilter, fit: MarginalFit, name: str, time: float) -> Array:
    """(t,) derivative of each track's log likelihood by the variance of a part, at zero variance."""
    noise = fit.noise()
    if name != MEMORY:
        _, slopes = tracks.losses(replace(noise, stamp_jitter=np.zeros(1)))
        return -(JITTER_UNIT**2) * slopes.stamp_jitter
    white = noise.position.mean() * np.square(fit.settings.position_noise)
    _, slopes = tracks.losses(replace(noise, memory=np.zeros((1, 3)), memory_time=np.array([time])))
    return -slopes.memory @ white


def _p_value(score: Array, freedom: float) -> float:
    """One-sided; freedom: share of the scatter that remains after the projection."""
    spread = np.sqrt(len(score) * score.var(ddof=1) / max(freedom, 0.1))
    if not spread > 0.0:  # identical tracks have no scatter
        return 1.0
    from scipy import stats  # it takes half a second to import

    return float(stats.t.sf(score.sum() / spread, len(score) - 1))


def _sizes(
    fits: list[MarginalFit], found: list[Evidence], held_out: Mask, settings: Settings, stated: float | None
) -> TrackerNoise:
    """The parts found with their sizes and error bars; each fit has one part more than the fit before.

    If a number is hardly known, the part found last stays unnamed.
    """
    if not found:
        return TrackerNoise((), _noise_of(fits[0]))
    last = _settled(fits[-1], settings, stated)
    covariance, parts = last.covariance(), []
    for evidence, before, after in zip(found, fits[:-1], fits[1:], strict=True):
        values = {"sigma": _size(last, covariance, NUMBERS[evidence.name][0])}
        if evidence.name == MEMORY:
            values["time"] = _size(last, covariance, "memory_time")
        parts.append(TrackerPart(evidence, values, before.losses - after.losses, held_out))
    if any(value < KNOWN * sigma for part in parts for value, sigma in part.values.values()):
        return _sizes(fits[:-1], found[:-1], held_out, settings, stated)
    return TrackerNoise(tuple(parts), _noise_of(last))


def _noise_of(fit: MarginalFit) -> TrackNoise:
    white, memory, time, jitter = (
        fit.values(n).tolist() for n in ("position", "memory", "memory_time", "stamp_jitter")
    )
    return TrackNoise(
        position=(white[0], white[1], white[2]),
        memory=(memory[0], memory[1], memory[2]) if memory else None,
        memory_time=time[0] if time else None,
        stamp_jitter=jitter[0] if jitter else None,
    )


def _settled(fit: MarginalFit, settings: Settings, stated: float | None) -> MarginalFit:
    """The same fit until convergence, with the stated white noise unless the tracks contradict it.

    If errors last no longer than a frame, only the stated white noise separates white noise and memory.
    """
    if stated is not None:
        sure = [replace(p, start=stated, spread=STATED_SPREAD) if p.name == "position" else p for p in fit.parameters]
        believed = MarginalFit(fit.tracks, settings, sure, {n: v for n, v in fit.known.items() if n[0] != "position"})
        rows = [k for k, p in enumerate(sure) if p.name == "position"]
        others = np.delete(believed.gradients, rows, axis=1)
        score = _cleared(believed.gradients[:, rows], others)
        total = score.sum(axis=0)
        away = np.abs(np.log(believed.values("position") / stated)).max() / STATED_SPREAD
        if away < FAR and float(total @ np.linalg.solve(score.T @ score, total)) < AGREES:
            return believed
    return MarginalFit(fit.tracks, settings, fit.parameters, fit.known)


def _size(fit: MarginalFit, covariance: Array, name: str) -> tuple[float, float]:
    """A number and its standard deviation; of a number along three axes the root mean square."""
    rows, values = [k for k, p in enumerate(fit.parameters) if p.name == name], fit.values(name)
    size = float(np.sqrt((values**2).mean()))
    weights = values**2 / (values**2).sum()  # derivative of the size's logarithm by those of the values
    return size, size * float(np.sqrt(weights @ covariance[np.ix_(rows, rows)] @ weights))
