"""Errors of estimates against the truth, track by track, on all cores."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Literal

import joblib
import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.benchmarks.metrics import inside, nees, square_norms
from ballfg.benchmarks.synthetic import Case
from ballfg.estimation import Estimator, Status
from ballfg.estimation.filters.sliding_window import WINDOW
from ballfg.progress import progress
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

Array = NDArray[np.float64]

LEVELS = (0.5, 0.9)
"""Of the intervals whose coverage is reported."""


@dataclass(frozen=True)
class Candidate:
    """An estimator in a comparison.

    Attributes:
        estimator: with its settings.
        newest: how its state at the newest of k samples comes about. "pass": a state depends on no later sample, so
            that one pass over a track gives it for every k. "anew": the first k samples are estimated for each k.
            "none": it is not asked for.
    """

    estimator: Estimator
    newest: Literal["pass", "anew", "none"] = "anew"


@dataclass(frozen=True)
class TrackScore:
    """The errors of one estimate of n samples.

    Attributes:
        velocity: (n,) m/s, length of the error.  position: (n,) m.  spin: (n,) rad/s.
        nees: (n,) of the whole state, 9 degrees of freedom.  velocity_nees: (n,) 3 degrees of freedom.
        covered: (levels, n, 9) whether each component lies in the central interval of each of `LEVELS`.
        away: (n,) the sample is not at a bounce (`away_from_bounces`).
        newest: (k,) m/s, velocity error at the newest sample for each number of observations; NaN beyond the track.
        ok: the estimation ended well.
    """

    velocity: Array
    position: Array
    spin: Array
    nees: Array
    velocity_nees: Array
    covered: NDArray[np.bool_]
    away: NDArray[np.bool_]
    newest: Array
    ok: bool


Scores = dict[str, list[TrackScore]]
"""By method, in the order of the tracks."""


def score_tracks(
    candidates: Mapping[str, Candidate], tracks: Sequence[Case], counts: Sequence[int], jobs: int, what: str
) -> Scores:
    """Scores of every candidate on every track.

    Args:
        candidates: by method.
        tracks: with their truth.
        counts: numbers of observations for `TrackScore.newest`.
        jobs: processes.
        what: for the progress line.
    """
    parallel = joblib.Parallel(n_jobs=jobs, return_as="generator", batch_size=1)
    scored = parallel(joblib.delayed(_score_all)(candidates, track, counts) for track in tracks)
    per_track = list(progress(scored, len(tracks), what))
    return {name: [scores[name] for scores in per_track] for name in candidates}


def _score_all(candidates: Mapping[str, Candidate], case: Case, counts: Sequence[int]) -> dict[str, TrackScore]:
    torch.set_num_threads(1)  # the processes share the cores already
    return {name: score_track(candidate, case, counts) for name, candidate in candidates.items()}


def score_track(candidate: Candidate, case: Case, counts: Sequence[int]) -> TrackScore:
    """Score of one estimator on one track. The estimator sees the measured track, never the truth."""
    truth = case.true_states
    estimate = candidate.estimator.estimate(case.track)
    errors = estimate.states - truth
    covariances = estimate.covariances
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


def judged(score: TrackScore) -> NDArray[np.bool_]:
    """(n,) the samples that are judged: the sliding window is full, and no bounce is at them."""
    mask = score.away.copy()
    mask[: WINDOW - 1] = False
    return mask


def every(score: TrackScore) -> NDArray[np.bool_]:
    """(n,) all samples."""
    return np.ones_like(score.away)


Selection = Callable[[TrackScore], NDArray[np.bool_]]
"""Which samples count."""


def sums(scores: Sequence[TrackScore], name: str, power: int, select: Selection = judged) -> tuple[Array, Array]:
    """For each track the sum of a field to a power, and the number of samples.

    Args:
        scores: of one method.
        name: field of `TrackScore`, for instance `velocity` (power 2 for an RMSE) or `nees` (power 1 for a mean).
        power: 1 or 2.
        select: which samples.
    """
    values = [getattr(score, name)[select(score)] ** power for score in scores]
    return np.array([float(v.sum()) for v in values]), np.array([float(len(v)) for v in values])


def covered(scores: Sequence[TrackScore], level: int, block: slice) -> tuple[Array, Array]:
    """For each track how many components of a block lie in the interval of `LEVELS[level]`, and how many there are."""
    values = [score.covered[level, judged(score), block] for score in scores]
    return np.array([float(v.sum()) for v in values]), np.array([float(v.size) for v in values])


BLOCKS = {"state": slice(0, STATE_DIM), "velocity": VELOCITY}
"""Components whose coverage is reported."""
