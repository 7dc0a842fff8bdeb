"""Computes errors of estimates against the truth, track by track, on all cores."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.benchmarks.estimators.protocols import Candidate, Case
from ballfg.benchmarks.metrics import inside, nees, square_norms
from ballfg.benchmarks.results import in_processes
from ballfg.estimation import Status
from ballfg.estimation.filters.sliding_window import WINDOW
from ballfg.state import POSITION, SPIN, VELOCITY

LEVELS = (0.5, 0.9)  # Levels of the intervals with a reported coverage


@dataclass(frozen=True)
class TrackScore:
    """The errors of one estimate of n samples."""

    velocity: Array  # (n,) m/s, length of the error
    position: Array  # (n,) m
    spin: Array  # (n,) rad/s
    nees: Array  # (n,) of the whole state, 9 degrees of freedom
    velocity_nees: Array  # (n,) 3 degrees of freedom
    covered: NDArray[np.bool_]  # (levels, n, 9) whether each component lies in the central interval of each of `LEVELS`
    away: NDArray[np.bool_]  # (n,) the sample is not at a bounce (`away_from_bounces`)
    newest: Array  # (k,) m/s, velocity error at the newest sample for each number of observations; NaN beyond the track
    ok: bool  # True if the estimate succeeded


Scores = dict[str, list[TrackScore]]  # By method, in the order of the tracks


def score_tracks(
    candidates: Mapping[str, Candidate], tracks: Sequence[Case], counts: Sequence[int], jobs: int, what: str
) -> Scores:
    """Scores of every candidate on every track.

    Args: counts: numbers of observations for `TrackScore.newest`.  what: for the progress line.
    """

    def scored(case: Case) -> dict[str, TrackScore]:
        return {name: score_track(candidate, case, counts) for name, candidate in candidates.items()}

    per_track = in_processes(scored, tracks, jobs, what)
    return {name: [scores[name] for scores in per_track] for name in candidates}


def score_track(candidate: Candidate, case: Case, counts: Sequence[int]) -> TrackScore:
    """Score of one estimator on one track. The estimator sees the measured track, never the truth."""
    estimate = candidate.estimator.estimate(case.track)
    errors, covariances = estimate.states - case.true_states, estimate.covariances
    speed_error = np.sqrt(square_norms(errors[:, VELOCITY]))
    return TrackScore(
        velocity=speed_error,
        position=np.sqrt(square_norms(errors[:, POSITION])),
        spin=np.sqrt(square_norms(errors[:, SPIN])),
        nees=nees(errors, covariances),
        velocity_nees=nees(errors[:, VELOCITY], covariances[:, VELOCITY, VELOCITY]),
        covered=np.stack([inside(errors, estimate.sigmas, level) for level in LEVELS]),
        away=case.away,
        newest=_newest(candidate, case, speed_error, counts),
        ok=estimate.status is Status.OK,
    )


def _newest(candidate: Candidate, case: Case, whole: Array, counts: Sequence[int]) -> Array:
    """(k,) m/s: velocity error at sample k - 1 when k samples were seen."""
    track = case.track
    found = np.full(len(counts), np.nan)
    for i, count in enumerate(counts):
        if count > len(track) or not case.away[count - 1] or candidate.newest == "none":
            continue
        if candidate.newest == "pass":
            found[i] = whole[count - 1]
        else:
            seen = candidate.estimator.estimate(track.until(float(track.times[count - 1])))
            found[i] = np.linalg.norm(seen.states[-1, VELOCITY] - case.true_states[count - 1, VELOCITY])
    return found


Selection = Callable[[TrackScore], NDArray[np.bool_]]  # (n,) True for samples that count


def judged(score: TrackScore) -> NDArray[np.bool_]:
    """(n,) the judged samples: the sliding window is full, and no bounce is at them."""
    mask = score.away.copy()
    mask[: WINDOW - 1] = False
    return mask


def every(score: TrackScore) -> NDArray[np.bool_]:
    """(n,) all samples."""
    return np.ones_like(score.away)


def sums_and_counts(values: Sequence[NDArray[np.generic]]) -> tuple[Array, Array]:
    """(m,) the sum of each track's values, and (m,) their number."""
    return np.array([float(v.sum()) for v in values]), np.array([float(v.size) for v in values])


def pooled(scores: Sequence[TrackScore], name: str, power: int, select: Selection = judged) -> tuple[Array, Array]:
    """For each track the sum of a field of its score to a power over the selected samples, and their number."""
    return sums_and_counts([getattr(score, name)[select(score)] ** power for score in scores])


def covered(scores: Sequence[TrackScore], level: int, block: slice) -> tuple[Array, Array]:
    """For each track how many components of a block lie in the interval of `LEVELS[level]`, and how many there are."""
    return sums_and_counts([score.covered[level, judged(score), block] for score in scores])
