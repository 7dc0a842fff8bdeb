"""The comparison on synthetic tracks: the paper's protocol, the fair one, and the smoother's consistency."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from ballfg.benchmarks.estimators.scoring import (
    BLOCKS,
    LEVELS,
    Candidate,
    Scores,
    TrackScore,
    covered,
    every,
    score_tracks,
    sums,
)
from ballfg.benchmarks.metrics import (
    Array,
    Statistic,
    bootstrap,
    pooled_mean,
    pooled_rms,
    ratio,
)
from ballfg.benchmarks.results import CURVE_MARK, Results
from ballfg.benchmarks.synthetic import Protocol
from ballfg.estimation import ExtendedKalmanFilter, Online, SlidingWindow, Smoother

COUNTS = (5, 6, 7, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 70, 80)
"""Numbers of observations on the curves."""
SETTLED = 20
"""Observations from which on the errors at the newest sample are pooled into one number."""


def paper_candidates(protocol: Protocol) -> dict[str, Candidate]:
    """The paper's three methods, and the filter once more with another start.

    In the paper filter and graph start from the mean velocity of the first five samples. To the filter that is a
    belief, in place of these samples; to the graph a place to start the minimisation from. `ekf-no-window` starts like
    the graph: it knows nothing and takes in every sample.
    """
    given = (protocol.model, protocol.surfaces, protocol.settings)
    return {
        "sliding-window": Candidate(SlidingWindow(*given), newest="pass"),
        "ekf": Candidate(ExtendedKalmanFilter(*given, initialise="window"), newest="pass"),
        "ekf-no-window": Candidate(ExtendedKalmanFilter(*given), newest="pass"),
        "smoother": Candidate(Smoother(*given)),
    }


def fair_candidates(protocol: Protocol) -> dict[str, Candidate]:
    """All estimators, with one and the same settings. At the newest sample the RTS pass leaves the filter's state."""
    given = (protocol.model, protocol.surfaces, protocol.settings)
    return {
        "sliding-window": Candidate(SlidingWindow(*given), newest="pass"),
        "ekf": Candidate(ExtendedKalmanFilter(*given), newest="pass"),
        "ekf+rts": Candidate(ExtendedKalmanFilter(*given, smooth=True), newest="none"),
        "online": Candidate(Online(*given)),
        "smoother": Candidate(Smoother(*given)),
    }


def run_protocol(
    results: Results, protocol: Protocol, candidates: Mapping[str, Candidate], jobs: int, counts: Sequence[int] = COUNTS
) -> Scores:
    """Score all candidates and add their rows."""
    what = f"synthetic tracks estimated ({protocol.name})"
    scores = score_tracks(candidates, protocol.tracks, counts, jobs, what)
    add_rows(results, protocol.name, scores, counts)
    return scores


def add_rows(results: Results, case: str, scores: Scores, counts: Sequence[int]) -> None:
    """RMSE, ratios, NEES, coverage, and the curve over the number of observations.

    Left out, unless the metric's name says `all`: samples before the window of five is full, where filter and window
    know next to nothing, which would flatter every smoother; and samples at a bounce (`synthetic.AT_BOUNCE`).
    """
    rng = np.random.default_rng([results.seed, 2])
    for method, of_method in scores.items():
        n = len(of_method)
        for name, statistic, unit in _statistics(of_method, counts):
            results.add(case, method, name, unit, bootstrap(statistic, n, rng), n)
        results.add(case, method, "not_converged", "1", sum(not s.ok for s in of_method), n)
        _add_curve(results, case, method, of_method, counts)
    _add_ratios(results, case, scores, counts, rng)


def _statistics(scores: Sequence[TrackScore], counts: Sequence[int]) -> list[tuple[str, Statistic, str]]:
    """Metric, statistic and unit of everything that is pooled over samples."""
    found = [
        ("velocity_rmse", pooled_rms(*sums(scores, "velocity", 2)), "m/s"),
        ("velocity_rmse_all", pooled_rms(*sums(scores, "velocity", 2, every)), "m/s"),
        ("position_rmse", pooled_rms(*sums(scores, "position", 2)), "m"),
        ("spin_rmse", pooled_rms(*sums(scores, "spin", 2)), "rad/s"),
        ("nees", pooled_mean(*sums(scores, "nees", 1)), "1"),
        ("nees_velocity", pooled_mean(*sums(scores, "velocity_nees", 1)), "1"),
    ]
    squares, number = newest_sums(scores, counts)
    if number.all():
        found.append(("velocity_rmse_newest", pooled_rms(squares, number), "m/s"))
    for i, level in enumerate(LEVELS):
        for block, columns in BLOCKS.items():
            share = pooled_mean(*covered(scores, i, columns))
            found.append((f"coverage_{100 * level:.0f}_{block}", share, "1"))
    return found


def newest_sums(scores: Sequence[TrackScore], counts: Sequence[int]) -> tuple[Array, Array]:
    """For each track sum of squares and number of the newest-sample errors at `SETTLED` or more observations."""
    settled = np.array(counts) >= min(SETTLED, max(counts))
    newest = np.stack([score.newest for score in scores])[:, settled]
    return np.nansum(newest**2, axis=1), np.isfinite(newest).sum(axis=1).astype(np.float64)


def _add_curve(results: Results, case: str, method: str, scores: Sequence[TrackScore], counts: Sequence[int]) -> None:
    """Root mean square, mean and standard deviation over tracks of the velocity error at sample k.

    `newest`: when k samples were seen; `whole`: when the whole track was.
    """
    newest = np.stack([score.newest for score in scores])
    for i, count in enumerate(counts):
        whole = np.array([s.velocity[count - 1] for s in scores if len(s.away) >= count and s.away[count - 1]])
        for when, errors in (("newest", newest[np.isfinite(newest[:, i]), i]), ("whole", whole)):
            if len(errors) < 2:
                continue
            figures = {"rmse": np.sqrt((errors**2).mean()), "mean": errors.mean(), "sd": errors.std(ddof=1)}
            for name, value in figures.items():
                metric = f"velocity_{name}_{when}{CURVE_MARK}{count}"
                results.add(case, method, metric, "m/s", float(value), len(errors))


def _add_ratios(results: Results, case: str, scores: Scores, counts: Sequence[int], rng: np.random.Generator) -> None:
    """The smoother's velocity RMSE divided by each other method's; below one, the smoother is better."""
    statistics = {
        method: {name: statistic for name, statistic, unit in _statistics(of_method, counts) if unit == "m/s"}
        for method, of_method in scores.items()
    }
    own = statistics["smoother"]
    n = len(scores["smoother"])
    for metric, statistic in own.items():
        for method in scores:
            if method != "smoother" and metric in statistics[method]:
                figure = bootstrap(ratio(statistic, statistics[method][metric]), n, rng)
                results.add(case, "smoother", f"{metric}_vs_{method}", "1", figure, n)
