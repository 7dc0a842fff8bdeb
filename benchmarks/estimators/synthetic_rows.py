"""Makes the rows of the comparison on synthetic tracks, and of the smoother's consistency."""

from collections.abc import Sequence

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.estimators.protocols import Protocol
from ballfg.benchmarks.estimators.scoring import LEVELS, Scores, TrackScore, covered, every, pooled, score_tracks
from ballfg.benchmarks.metrics import Figure, Statistic, bootstrap, chi_square_band, pooled_mean, pooled_rms, ratio
from ballfg.benchmarks.results import CURVE_MARK, Results
from ballfg.state import STATE_DIM, VELOCITY

SETTLED = 20  # Observations from which on the errors at the newest sample are pooled into one number
BLOCKS = {"state": slice(0, STATE_DIM), "velocity": VELOCITY}  # Components whose coverage is reported
PLACES = {"first": 0.0, "quarter": 0.25, "middle": 0.5, "three_quarters": 0.75, "last": 1.0}
"""Places of the consistency test on a track, as shares of its samples."""


def run_protocol(results: Results, protocol: Protocol, jobs: int, counts: Sequence[int]) -> None:
    """Score all candidates, at the newest of several numbers of observations too, and add their rows."""
    what = f"synthetic tracks estimated ({protocol.name})"
    scores = score_tracks(protocol.candidates, protocol.tracks, counts, jobs, what)
    add_rows(results, protocol.name, scores, counts)


def run_consistency(results: Results, protocol: Protocol, jobs: int) -> None:
    """Smooths all tracks and adds the rows on the consistency of the smoother's covariances."""
    smoother = {"smoother": protocol.candidates["smoother"]}
    what = f"synthetic tracks estimated ({protocol.name})"
    add_consistency(results, protocol.name, score_tracks(smoother, protocol.tracks, (), jobs, what)["smoother"])


def add_rows(results: Results, case: str, scores: Scores, counts: Sequence[int]) -> None:
    """RMSE, ratios, NEES, coverage, and the curve over the number of observations.

    Left out, unless the metric's name says `all`: samples before the window of five is full, where filter and window
    know next to nothing, which would flatter every smoother; and samples at a bounce (`protocols.AT_BOUNCE`).
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
        ("velocity_rmse", pooled_rms(*pooled(scores, "velocity", 2)), "m/s"),
        ("velocity_rmse_all", pooled_rms(*pooled(scores, "velocity", 2, every)), "m/s"),
        ("position_rmse", pooled_rms(*pooled(scores, "position", 2)), "m"),
        ("spin_rmse", pooled_rms(*pooled(scores, "spin", 2)), "rad/s"),
        ("nees", pooled_mean(*pooled(scores, "nees", 1)), "1"),
        ("nees_velocity", pooled_mean(*pooled(scores, "velocity_nees", 1)), "1"),
    ]
    squares, number = _newest_sums(scores, counts)
    if number.all():
        found.append(("velocity_rmse_newest", pooled_rms(squares, number), "m/s"))
    for i, level in enumerate(LEVELS):
        for block, columns in BLOCKS.items():
            share = pooled_mean(*covered(scores, i, columns))
            found.append((f"coverage_{100 * level:.0f}_{block}", share, "1"))
    return found


def _newest_sums(scores: Sequence[TrackScore], counts: Sequence[int]) -> tuple[Array, Array]:
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
    n = len(scores["smoother"])
    for metric, statistic in statistics["smoother"].items():
        for method in scores:
            if method != "smoother" and metric in statistics[method]:
                figure = bootstrap(ratio(statistic, statistics[method][metric]), n, rng)
                results.add(case, "smoother", f"{metric}_vs_{method}", "1", figure, n)


def add_consistency(results: Results, case: str, scores: Sequence[TrackScore]) -> None:
    """NEES at five places of each track, each mean with the band that it should lie in, and over all samples.

    At one sample of each track the NEES are independent from track to track, so that their mean has an exact band:
    low and high are its ends. Samples of one track are not independent: the mean over all of them has the interval of
    a bootstrap over tracks. A place next to a bounce (`protocols.AT_BOUNCE`) moves to the nearest sample that is not.
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
    for name, select in (("nees", lambda score: score.away), ("nees_all", every)):
        figure = bootstrap(pooled_mean(*pooled(scores, "nees", 1, select)), n, rng)
        results.add(case, "smoother", name, "1", figure, n)
    at_bounce = sum(int((~score.away).sum()) for score in scores)
    results.add(case, "smoother", "samples_at_bounce", "1", at_bounce, sum(len(score.away) for score in scores))
    results.add(case, "smoother", "not_converged", "1", sum(not s.ok for s in scores), n)


def _place(score: TrackScore, share: float) -> int:
    """The sample nearest to a share of the track that is not at a bounce."""
    candidates = np.flatnonzero(score.away)
    wanted = share * (len(score.away) - 1)
    return int(candidates[np.abs(candidates - wanted).argmin()])
