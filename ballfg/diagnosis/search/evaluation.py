"""What a model is worth on tracks that it was not fitted to: predictions of unseen parts, and held-out likelihood."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnosis.fit.fit import fit, followed
from ballfg.diagnosis.fit.problem import Fit, Noise, Robust, weighted_residual
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.diagnosis.fit.system import by_track
from ballfg.diagnosis.result import Errors
from ballfg.diagnosis.search.score import score_tests
from ballfg.diagnosis.search.signatures import Signatures
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import TrackPrediction, predict_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.settings import Settings
from ballfg.prediction.apexes import measured_apexes, path_apex
from ballfg.tracks import Track

Array = NDArray[np.float64]

OBSERVED = 0.4
"""Share of each judged track that is observed; the rest is predicted."""
LEAST_PREDICTED = 3
"""Samples that must be left to predict."""


@dataclass(frozen=True)
class JudgedTrack:
    """The part of a track that a model is to explain: up to the first hit or rest, without outliers.

    Attributes:
        track: that part.
        bounces: (b,) s, contacts in it.
    """

    track: Track
    bounces: Array


def prediction_errors(
    model: BallModel, judged: Sequence[JudgedTrack], surfaces: Surfaces, settings: Settings, jobs: int
) -> Errors:
    """Errors of the predictions that `ballfg predict` would make with a model.

    Args:
        model: with what was found out about noise and launcher in `trained`.
        judged: tracks that it was not fitted to.
        surfaces, settings: of the dataset with this model.
        jobs: processes.
    Raises: ValueError: if no track leaves enough to predict.
    """
    estimator = make_estimator("smoother", model, surfaces, settings)
    tracks = [j.track for j in judged]
    predictions = predict_tracks(estimator, tracks, len(tracks), lambda t: OBSERVED * t.duration, jobs=jobs)
    pairs = [(j, p) for j, p in zip(judged, predictions, strict=True) if len(p.times) >= LEAST_PREDICTED]
    if not pairs:
        raise ValueError(
            f"tracks must leave {LEAST_PREDICTED} samples after the first {OBSERVED:.0%} of them, to judge predictions "
            "by; none does. Record longer tracks."
        )
    squares = [((p.positions - p.measured) ** 2).sum(axis=-1) for _, p in pairs]
    scores = np.concatenate([((p.positions - p.measured) / p.sigmas).ravel() for _, p in pairs])
    sigmas = np.concatenate([p.sigmas.ravel() for _, p in pairs])
    apexes = np.concatenate([_apex_distances(j, p) for j, p in pairs])
    return Errors(
        1e3 * float(np.sqrt(np.concatenate(squares).mean())),
        1e3 * float(np.sqrt((apexes**2).mean())) if len(apexes) else float("nan"),
        float((scores**2).mean()),
        float((-0.5 * scores**2 - np.log(sigmas)).mean() - 0.5 * np.log(2 * np.pi)),
        1e3 * np.sqrt([s.mean() for s in squares]),
    )


def _apex_distances(judged: JudgedTrack, prediction: TrackPrediction) -> Array:
    """(a,) m between measured and predicted apexes of flights whose apex was not observed."""
    track, end = judged.track, float(prediction.times[0])
    points, when = measured_apexes(track.times, track.positions, judged.bounces)
    edges = [float(track.times[0]), *judged.bounces.tolist(), float(track.times[-1])]
    found = []
    for point, time in zip(points, when, strict=True):
        if np.isfinite(time) and time > end:
            start = max(e for e in edges if e <= time)
            stop = min(e for e in edges if e >= time)
            predicted, _ = path_apex(prediction.times, prediction.positions, start, stop)
            found.append(float(np.linalg.norm(predicted - point)))
    return np.array([d for d in found if np.isfinite(d)])


@dataclass(frozen=True)
class HeldOut:
    """Gain of one fit over another on other tracks: log likelihood per track, and its probability by chance."""

    gain: float
    p_value: float


def held_out(before: Fit, after: Fit, judged: Stretches) -> HeldOut:
    """How much better a larger model explains tracks that neither was fitted to; only first states adapt to them.

    The gain says whether it helps. Whether by chance, the residual says that is left along what the larger model would
    change: were there nothing, its product with that change would scatter about zero, track by track, and the sum of
    losses, which the change's own length weighs down by half of it, is a test with a quarter of the information.

    Args: before, after: fits on other tracks.  judged: the tracks to compare on.
    """
    for fitted in (before, after):
        judged = followed(fitted.problem.model, judged, fitted.unknowns.values)
    old, new = (_on(f, judged, after.noise) for f in (before, after))
    weights = old.robust
    left = _rows(old, weights)
    columns = np.stack((left - _rows(new, weights), left), axis=-1)
    gram = by_track(columns.swapaxes(-1, -2) @ columns, judged.track)
    (score,) = score_tests(Signatures(gram, np.zeros(0), 0), [[0]])
    gain = float((weights.losses - new.robust.losses).sum()) / len(gram)
    if score is None or gain <= 0.0 or score.estimate[0] <= 0.0:
        return HeldOut(gain, 1.0)
    return HeldOut(gain, score.p_value / 2.0)


def _rows(fitted: Fit, weights: Robust) -> Array:
    return weighted_residual(fitted.problem, fitted.unknowns, fitted.noise, fitted.predicted, weights)


def _on(fitted: Fit, judged: Stretches, noise: Noise) -> Fit:
    """A fit's shared unknowns on other stretches, whose first states are fitted."""
    problem = replace(fitted.problem, stretches=judged, shared=False)
    unknowns = replace(fitted.unknowns, starts=judged.starts.numpy().copy())
    return fit(problem, unknowns, noise, settle_noise=False)
