"""Runs `ballfg-bench estimators`: synthetic tracks by two protocols, or a dataset of measured ones."""

import re
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.estimators.measured import HORIZON, OBSERVE, run_measured
from ballfg.benchmarks.estimators.protocols import (
    LEVELS,
    Scores,
    TrackScore,
    covered,
    every,
    fair_protocol,
    paper_protocol,
    pooled,
    score_tracks,
)
from ballfg.benchmarks.gaussian_settings import StepNoise
from ballfg.benchmarks.metrics import Figure, Statistic, bootstrap, chi_square_band, pooled_mean, pooled_rms, ratio
from ballfg.benchmarks.results import CURVE_MARK, Results
from ballfg.dynamics import nominal_model
from ballfg.estimation import Settings, dataset_settings
from ballfg.progress import doing
from ballfg.state import STATE_DIM, VELOCITY
from ballfg.tracks import Dataset

SETTLED = 20  # Observations from which on the errors at the newest sample are pooled into one number
BLOCKS = {"state": slice(0, STATE_DIM), "velocity": VELOCITY}  # Components whose coverage is reported
PLACES = {"first": 0.0, "quarter": 0.25, "middle": 0.5, "three_quarters": 0.75, "last": 1.0}
"""Places of the consistency test on a track, as shares of its samples."""


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


@dataclass(frozen=True)
class Size:
    """The amount of computation."""

    compared: int  # synthetic tracks in each protocol
    consistency: int  # synthetic tracks whose NEES is taken
    measured: int | None  # measured tracks at most; None for all
    counts: Sequence[int]  # numbers of observations on the curves


COUNTS = (5, 6, 7, 8, 10, 12, 15, 20, 25, 30, 40, 50, 60, 70, 80)
FULL = Size(compared=50, consistency=200, measured=None, counts=COUNTS)
QUICK = Size(compared=10, consistency=40, measured=12, counts=(5, 10, 20, 40, 80))
CONSISTENCY_SEED = 1_000_000  # Added to the seed: other tracks than those of the comparison


def run_synthetic(results: Results, out: Path, size: Size, jobs: int) -> list[Path]:
    """Both protocols and the consistency of the smoother. Returns: the pictures written."""
    from ballfg.benchmarks.estimators.pictures import observations_picture

    titles = {
        "paper": "paper's protocol: free flight, true dynamics and spin known",
        "fair": "fair protocol: bounces, declared noise, same settings for all",
    }
    protocols = [paper_protocol(size.compared, results.seed), fair_protocol(size.compared, results.seed)]
    for protocol in protocols:
        print(f"{protocol.name}: {len(protocol.tracks)} tracks; {describe_settings(protocol.settings)}")
    for protocol in protocols:
        with doing(f"{protocol.name}: {len(protocol.tracks)} tracks by all estimators"):
            what = f"synthetic tracks estimated ({protocol.name})"
            scores = score_tracks(protocol.candidates, protocol.tracks, size.counts, jobs, what)
            add_rows(results, protocol.name, scores, size.counts)
    many = fair_protocol(size.consistency, results.seed + CONSISTENCY_SEED, name="consistency")
    with doing(f"consistency: {len(many.tracks)} tracks"):
        smoother, what = {"smoother": many.candidates["smoother"]}, "synthetic tracks estimated (consistency)"
        add_consistency(results, many.name, score_tracks(smoother, many.tracks, (), jobs, what)["smoother"])
    return [
        observations_picture(results.rows, name, title, out / f"estimators_{name}.png")
        for name, title in titles.items()
    ]


def run_dataset(results: Results, dataset: Dataset, out: Path, size: Size, jobs: int) -> list[Path]:
    """Measured tracks. Returns: the pictures written."""
    from ballfg.benchmarks.estimators.pictures import calibration_picture, growth_picture, tracks_picture

    settings = dataset_settings(dataset, nominal_model(dataset.info.ball))
    what = f"{OBSERVE:g} s observed, {HORIZON:g} s predicted, nominal model"
    print(f"{dataset.info.name}: {len(dataset)} tracks; {what}; {describe_settings(settings)}")
    measured = run_measured(results, dataset, size.measured, jobs)
    if measured.unseen:
        print(f"{measured.unseen} tracks end within the observed {OBSERVE:g} s: nothing to predict")
    if not measured.predictions["smoother"]:
        raise ValueError(
            f"{dataset.path}: no track goes on after {OBSERVE:g} s, so that nothing can be predicted. "
            "Give a dataset with longer tracks."
        )
    rows, name = results.rows, re.sub(r"[^\w-]+", "-", measured.name)
    return [
        growth_picture(rows, measured, out / f"growth_{name}.png"),
        calibration_picture(rows, measured, out / f"calibration_{name}.png"),
        tracks_picture(measured, out / f"tracks_{name}.png"),
    ]


def describe_settings(settings: Settings) -> str:
    """Noise and priors in words; of the process noise the terms that act, in SI units."""
    process = settings.process
    unused: tuple[str, ...] = () if settings.find_events else ("hit",)
    unused += ("acceleration", "contact") if isinstance(process, StepNoise) else ()
    terms = [f"{name} {value:g}" for name, value in vars(process).items() if value and not name.startswith(unused)]
    parts = [
        f"position noise {' / '.join(f'{1e3 * s:.2g}' for s in settings.position_noise)} mm",
        "process noise " + ", ".join(terms),
        f"spin label {settings.spin_label_noise:g} rad/s, spin prior {settings.spin_prior:g} rad/s",
        f"velocity prior {settings.velocity_prior:g} m/s",
        f"{settings.loss.name} loss",
    ]
    if settings.coefficients:
        parts.append("coefficients per track: " + ", ".join(settings.coefficients))
    return "; ".join(parts)
