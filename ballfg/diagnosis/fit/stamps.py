"""Finds errors of stamps from the tracks alone: counted frames of which some were dropped, and a wrong clock.

Both must be known before a track is cut into flights: with them free flight looks like a chain of hits.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from scipy import stats

from ballfg.arrays import Array, Index, quadratics
from ballfg.estimation.measurement.position_noise import FLOOR
from ballfg.tracks import Track

REGULAR: Final = 0.02  # Relative. Largest difference between the intervals of stamps that count frames
NEAR: Final = 9  # Number of neighbouring steps that give the length of a step of one frame
SHORT: Final = 25.0  # Percentile of these lengths that is first taken as one frame's
MOST_MISSING: Final = 6  # Largest number of frames between two samples
WINDOW: Final = 16  # Number of samples in a piece of flight for its polynomial
ROUNDS: Final = 100  # Number of times that frames are counted again on a smoother motion
CLEAR: Final = 0.7  # Largest ratio of a piece's variance with and without a further missing frame
LEAST_SHARE: Final = 0.02  # Smallest share of missing frames at first
TINY: Final = 1e-9  # m. Least step in a division
QUIET: Final = 3.0  # Pieces whose scatter exceeds this multiple of the lower quartile hold a bounce or a hit
SMOOTHER: Final = 0.5  # Least decrease of the log variance about polynomials for counted frames
FAR: Final = 0.2  # Least error of a clock: the fit itself finds smaller ones, and a lift may look like one
CHANCE: Final = 1e-3  # Significance level of wrong stamps in each half of the tracks


@dataclass(frozen=True)
class Evidence:
    """The mean over a half's tracks of a number that is zero on average by chance, and its probability."""

    mean: float
    p_value: float
    gain: float

    @classmethod
    def of(cls, values: Sequence[float]) -> "Evidence":
        """Computes the evidence from one number per track; gain: of a normal log likelihood, per track."""
        spread = float(np.std(values, ddof=1)) if len(values) > 2 else np.inf
        mean = float(np.mean(values)) if len(values) else 0.0
        if not np.isfinite(spread) or spread == 0.0:
            return cls(mean, 1.0, 0.0)
        return cls(mean, float(stats.ttest_1samp(values, 0.0).pvalue), 0.5 * (mean / spread) ** 2)


@dataclass(frozen=True)
class Stamps:
    """Errors of a dataset's stamps, found before any fit."""

    missing: float = 0.0  # Average number of missing frames per sample; zero if stamps are times
    counted: Mapping[str, Array] = field(default_factory=dict)
    """(n,) s stamps of each track with the missing frames inserted, at the recorded mean rate."""
    scale: float = 0.0  # Recorded durations over true ones less one; zero if the clock is not far off
    found: Mapping[str, tuple[Evidence, Evidence]] = field(default_factory=dict)
    """By effect, the evidence on the search half and on the held-out half."""

    @property
    def stretch(self) -> float:
        """True durations over those of stamps with the missing frames inserted."""
        return (1.0 + self.missing) / (1.0 + self.scale)

    def repaired(self, track: Track) -> Track:
        """The track with corrected stamps: missing frames inserted, and true durations."""
        if not self.found:
            return track
        times = self.counted.get(track.name, track.times)
        return replace(track, times=times[0] + (times - times[0]) * self.stretch)


def look_at_stamps(tracks: Sequence[Track], gravity: float, drag: float) -> Stamps:
    """Finds counted frames and a clock that is far off.

    Args: tracks: every second one belongs to the search half.  gravity: m/s^2.  drag: 1/m, of the declared model.
    """
    stamps = _with_counts(tracks)
    repaired = [stamps.repaired(track) for track in tracks]
    logs = np.array([_log_gravity(track, gravity, drag) for track in repaired])
    halves = [Evidence.of(half[np.isfinite(half)].tolist()) for half in (logs[::2], logs[1::2])]
    scale = float(np.exp(-0.5 * halves[0].mean)) - 1.0
    if abs(scale) < FAR or max(h.p_value for h in halves) > CHANCE:
        return stamps
    return replace(stamps, scale=scale, found={**stamps.found, "time_scale": (halves[0], halves[1])})


def _with_counts(tracks: Sequence[Track]) -> Stamps:
    """The missing frames between samples, if stamps count frames and some are missing."""
    counts = [frame_counts(track) for track in tracks]
    falls = []
    for track, count in zip(tracks, counts, strict=True):
        before, after = (_pieces(times, track.positions)[1] for times in (track.times, count.astype(np.float64)))
        falls.append(float(np.log(before / after).mean()) if len(before) else np.nan)
    halves = [Evidence.of([f for f in falls[first::2] if np.isfinite(f)]) for first in (0, 1)]
    missing = sum(int(c[-1]) for c in counts) / max(1, sum(len(c) - 1 for c in counts)) - 1.0
    if missing < LEAST_SHARE or min(h.mean for h in halves) < SMOOTHER or max(h.p_value for h in halves) > CHANCE:
        return Stamps()
    counted = {}
    for track, count in zip(tracks, counts, strict=True):
        period = float(np.median(np.diff(track.times)))
        counted[track.name] = track.times[0] + count * period / (1.0 + missing)
    return Stamps(missing, counted, 0.0, {"counted_frames": (halves[0], halves[1])})


def frame_counts(track: Track) -> Index:
    """(n,) number of the frame of each sample, from the lengths of the ball's steps; 0, 1, 2 ... without missing ones.

    A step of the ball over a missing frame is twice as long as its neighbours.
    """
    plain = np.arange(len(track.times))
    gaps = np.diff(track.times)
    if len(gaps) <= WINDOW or np.ptp(gaps) > 2.0 * REGULAR * float(np.median(gaps)):
        return plain
    steps = np.linalg.norm(np.diff(track.positions, axis=0), axis=-1)
    near = sliding_window_view(np.pad(steps, NEAR // 2, mode="reflect"), NEAR)
    one = np.percentile(near, SHORT, axis=-1)
    frames = np.clip(np.round(steps / np.maximum(one, TINY)), 1, MOST_MISSING + 1)
    numbers, quiet = np.concatenate(([0], np.cumsum(frames.astype(np.int64)))), _across(track)
    for _ in range(ROUNDS):
        changes = _changes(numbers, track.positions, quiet)
        if not changes.any():
            break
        numbers = numbers + np.concatenate(([0], np.cumsum(changes)))
    return numbers


def _changes(numbers: Index, positions: Array, quiet: float) -> Index:
    """(n - 1,) number of frames to add to each step for the smoothest motion; of neighbours only the best changes.

    Args: numbers: (n,) frames so far.  positions: (n, 3) m.  quiet: m^2, variance of a coordinate's noise.
    """
    steps, gaps = np.arange(len(numbers) - 1), np.diff(numbers)
    tried = (0, -1, 1)
    costs = np.full((len(tried), len(steps)), np.inf)
    for behind in (WINDOW // 4, WINDOW // 2, 3 * WINDOW // 4):  # a bounce is in some of the windows about a step
        first = np.clip(steps - behind + 1, 0, len(numbers) - WINDOW)
        inside = first[:, None] + np.arange(WINDOW)
        for row, change in zip(costs, tried, strict=True):
            moved = numbers[inside] + change * (inside > steps[:, None])
            np.minimum(row, quadratics(moved.astype(np.float64), positions[inside])[1], out=row)
    freedom = 3.0 * (WINDOW - 3)
    share = np.clip(1.0 - len(steps) / numbers[-1], LEAST_SHARE, 0.9)
    unclear = costs[2] > CLEAR * costs[0]  # a bounce stays a kink whatever is counted
    costs = freedom * costs / quiet - 2.0 * np.log(share) * np.array(tried)[:, None]
    costs[1, gaps <= 1], costs[2, unclear | (gaps > MOST_MISSING)] = np.inf, np.inf
    best = np.argmin(costs, axis=0)
    gain = costs[0] - costs[best, steps]
    most = sliding_window_view(np.pad(gain, WINDOW // 2), WINDOW + 1).max(axis=-1)
    return np.where((gain > 0.0) & (gain == most), np.array(tried)[best], 0)


def _pieces(times: Array, positions: Array) -> tuple[Array, Array]:
    """Quadratics through windows of samples, by `quadratics`; none for a track that is too short."""
    if len(times) < WINDOW:
        return np.zeros((0, 3, 3)), np.zeros(0)
    windows = sliding_window_view(times, WINDOW)[:: WINDOW // 4]
    return quadratics(windows, sliding_window_view(positions, WINDOW, axis=0)[:: WINDOW // 4].swapaxes(-1, -2))


def _across(track: Track) -> float:
    """m^2, variance of a coordinate across the motion, about planar parabolas; wrong stamps do not change it.

    A ball that falls straight down with x = y = 0, as one axis of a computed track does, has none: at least `FLOOR`.
    """
    windows = sliding_window_view(track.positions, WINDOW, axis=0)[:: WINDOW // 4].swapaxes(-1, -2)
    ways = windows - windows.mean(axis=1, keepdims=True)
    spread = np.linalg.eigvalsh(ways.swapaxes(-1, -2) @ ways)  # smallest: out of the plane of the motion
    return max(float(np.median(spread[:, 0])) / (WINDOW - 3), FLOOR**2)


def _log_gravity(track: Track, gravity: float, drag: float) -> float:
    """Log of the downward acceleration over g after drag is subtracted; drag along a path is free of the clock."""
    found, variances = _pieces(track.times, track.positions)
    if not len(variances):
        return float("nan")
    quiet = variances <= QUIET**2 * np.percentile(variances, 25.0)
    velocity = found[quiet, 1]
    upward = 2.0 * found[quiet, 0, 2] + drag * np.linalg.norm(velocity, axis=-1) * velocity[:, 2]
    down = -float(np.median(upward))
    return float(np.log(down / gravity)) if down > 0.0 else float("nan")
