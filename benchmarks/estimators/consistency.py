"""Whether the smoother's covariances are honest: its NEES over many tracks against chi-square bands."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from ballfg.benchmarks.estimators.scoring import Candidate, TrackScore, every, score_tracks, sums
from ballfg.benchmarks.metrics import Figure, bootstrap, chi_square_band, pooled_mean
from ballfg.benchmarks.results import Results
from ballfg.benchmarks.synthetic import Protocol
from ballfg.estimation import Smoother
from ballfg.state import STATE_DIM

PLACES = {"first": 0.0, "quarter": 0.25, "middle": 0.5, "three_quarters": 0.75, "last": 1.0}
"""Where on a track the consistency is tested, as a share of its samples."""


def run_consistency(results: Results, protocol: Protocol, jobs: int) -> None:
    """Smooth all tracks and add the rows."""
    smoother = {"smoother": Candidate(Smoother(protocol.model, protocol.surfaces, protocol.settings))}
    scores = score_tracks(smoother, protocol.tracks, (), jobs, f"synthetic tracks estimated ({protocol.name})")
    add_consistency(results, protocol.name, scores["smoother"])


def add_consistency(results: Results, case: str, scores: Sequence[TrackScore]) -> None:
    """NEES at five places of each track, each mean with the band that it should lie in, and over all samples.

    At one sample of each track the NEES are independent from track to track, so that their mean has an exact band:
    low and high are its ends. Samples of one track are not independent: the mean over all of them has the interval of
    a bootstrap over tracks. A place next to a bounce (`synthetic.AT_BOUNCE`) moves to the nearest sample that is not.
    """
    n = len(scores)
    band = chi_square_band(STATE_DIM, n)
    outside = 0
    for place, share in PLACES.items():
        mean = float(np.mean([score.nees[_place(score, share)] for score in scores]))
        outside += not band[0] <= mean <= band[1]
        results.add(case, "smoother", f"nees_{place}", "1", Figure(mean, *band), n)
    results.add(case, "smoother", "places_outside_99", "1", outside, len(PLACES))
    rng = np.random.default_rng([results.seed, 3])
    for name, select in (("nees", _away), ("nees_all", every)):
        results.add(case, "smoother", name, "1", bootstrap(pooled_mean(*sums(scores, "nees", 1, select)), n, rng), n)
    at_bounce = sum(int((~score.away).sum()) for score in scores)
    results.add(case, "smoother", "samples_at_bounce", "1", at_bounce, sum(len(score.away) for score in scores))
    results.add(case, "smoother", "not_converged", "1", sum(not s.ok for s in scores), n)


def _away(score: TrackScore) -> np.ndarray:
    return score.away


def _place(score: TrackScore, share: float) -> int:
    """The sample nearest to a share of the track that is not at a bounce."""
    candidates = np.flatnonzero(score.away)
    wanted = share * (len(score.away) - 1)
    return int(candidates[np.abs(candidates - wanted).argmin()])
