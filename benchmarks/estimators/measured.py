"""Compares estimators on measured tracks without known truth, by predictions of later samples."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from itertools import islice, pairwise

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.estimators.protocols import LEVELS, sums_and_counts
from ballfg.benchmarks.metrics import Figure, Statistic, bootstrap, inside, pooled_mean, quantile, root_mean_square
from ballfg.benchmarks.results import CURVE_MARK, Results
from ballfg.dynamics import BallModel, nominal_model
from ballfg.estimation import ConformalScales, Estimate, Status, dataset_settings, dataset_surfaces, predict_tracks
from ballfg.estimation.batch import estimate_tracks
from ballfg.estimation.conformal import FEWEST, LEVEL
from ballfg.estimation.registry import ESTIMATORS, make_estimator
from ballfg.estimation.segmentation.result import Quality
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.progress import progress
from ballfg.tracks import Dataset

SPLITS = 200
"""Random splits. The mean of their coverages is then good to 0.3 %; that of a single split has a spread of 3 %."""


def conformal_coverage(predictions: Sequence[TrackPrediction], observe: float, seed: int) -> Figure | None:
    """The share of measured coordinates of one half in the 90 % intervals that the other half calibrates.

    Mean over random splits, and the range of 95 % of them; None where half of the tracks are too few.

    Args: predictions: of tracks that last longer than the observed part.  observe: s.
    """
    if len(predictions) // 2 < FEWEST:
        return None
    shares, rng = list[float](), np.random.default_rng([seed, 6])
    for _ in range(SPLITS):
        order = rng.permutation(len(predictions))
        half = len(order) // 2
        scales = ConformalScales.of((predictions[i] for i in order[:half]), "half", observe)
        scaled = [scales.scaled(predictions[i]) for i in order[half:]]
        held = [inside(one.measured - one.positions, one.sigmas, LEVEL) for one in scaled]
        shares.append(float(np.concatenate(held).mean()))
    low, high = np.quantile(shares, [0.025, 0.975])
    return Figure(float(np.mean(shares)), float(low), float(high))


OBSERVE = 0.25  # s, observed part of each track
HORIZON = 0.3  # s, predicted part after it
END = 0.05  # s, end of the horizon to which `prediction_end_error` applies
CALIBRATION = (0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.99)  # Nominal levels of the calibration curve
QUARTILES = {"median": 0.5, "lower_quartile": 0.25, "upper_quartile": 0.75}
BINS = np.linspace(0.0, HORIZON, 13)  # s, edges of the error-growth curve
WHOLE = "smoother (whole tracks)"  # The method in `results.json` of rows about smoothing without prediction
WITHIN = 5.0  # Standard deviations within which a whitened innovation is explained


@dataclass(frozen=True)
class Measured:
    """The estimates and predictions of a dataset's tracks."""

    name: str  # of the dataset
    predictions: dict[str, list[TrackPrediction]]  # by method, of the tracks that last longer than the observed part
    smoothed: list[Estimate]  # the smoother's estimates of the whole tracks
    unseen: int  # number of tracks that end within the observed part


def run_measured(results: Results, dataset: Dataset, tracks: int | None, jobs: int) -> Measured:
    """Estimate and predict the first tracks of a dataset (None: all of them), and add the rows.

    Nominal model, noise as the dataset states it or as its tracks show it: nothing is fitted to a single track's
    later part, nor to labels.
    """
    model: BallModel = nominal_model(dataset.info.ball)
    settings, surfaces = dataset_settings(dataset, model), dataset_surfaces(dataset)
    listed = list(islice(dataset, tracks))
    predictions = {}
    for method in ESTIMATORS:
        estimator = make_estimator(method, model, surfaces, settings)
        made = predict_tracks(estimator, listed, len(listed), OBSERVE, horizon=HORIZON, jobs=jobs)
        predictions[method] = [p for p in progress(made, len(listed), f"tracks predicted ({method})") if len(p.times)]
    made_whole = estimate_tracks(make_estimator("smoother", model, surfaces, settings), listed, len(listed), jobs)
    smoothed = list(progress(made_whole, len(listed), "whole tracks smoothed"))
    measured = Measured(dataset.info.name, predictions, smoothed, len(listed) - len(predictions["smoother"]))
    _add_predictions(results, measured)
    _add_smoothing(results, measured)
    return measured


def prediction_rmse(prediction: TrackPrediction, after: float = 0.0, until: float = np.inf) -> float:
    """m: root mean square distance between measured and predicted positions in a span (s) since the last observed one.

    NaN where nothing was measured in it.
    """
    elapsed = prediction.times - prediction.estimate.times[-1]
    within = (elapsed > after) & (elapsed <= until)
    errors = (prediction.measured - prediction.positions)[within]
    return root_mean_square(errors) if len(errors) else float("nan")


def covered(predictions: Sequence[TrackPrediction], level: float, axes: slice = slice(0, 3)) -> tuple[Array, Array]:
    """For each track how many coordinates lie in the interval of a level, and how many there are."""
    return sums_and_counts([inside((p.measured - p.positions)[:, axes], p.sigmas[:, axes], level) for p in predictions])


def _add_predictions(results: Results, measured: Measured) -> None:
    rng = np.random.default_rng([results.seed, 4])
    for method, predictions in measured.predictions.items():
        n = len(predictions)
        if not n:
            continue
        add = partial(results.add, measured.name, method)
        for metric, unit, statistic, count in _statistics(predictions):
            add(metric, unit, bootstrap(statistic, count, rng), count)
        for level in CALIBRATION:
            held, total = covered(predictions, level)
            add(f"coverage{CURVE_MARK}{level:g}", "1", float(held.sum() / total.sum()), n)
        conformal = conformal_coverage(predictions, OBSERVE, results.seed)
        if conformal is not None:
            add("conformal_coverage_90", "1", conformal, n)
        # chi-square with 3 degrees of freedom has the median 2.37; one outlier decides the mean
        nis = np.concatenate([p.estimate.nis for p in predictions])
        nis = nis[np.isfinite(nis)]
        if len(nis):
            add("nis_median", "1", float(np.median(nis)), len(nis))
            add("nis_mean", "1", float(nis.mean()), len(nis))
        add("not_converged", "1", sum(p.status is not Status.OK for p in predictions), n)
        for low, high in pairwise(BINS):
            errors = [error for p in predictions if np.isfinite(error := prediction_rmse(p, low, high))]
            for name, q in QUARTILES.items() if errors else ():
                metric = f"prediction_error_{name}{CURVE_MARK}{(low + high) / 2:.4g}"
                add(metric, "mm", float(1e3 * np.quantile(errors, q)), len(errors))


def _statistics(predictions: Sequence[TrackPrediction]) -> list[tuple[str, str, Statistic, int]]:
    """Metric, unit, statistic and number of tracks of everything that has an interval."""
    n = len(predictions)
    rmse = [1e3 * prediction_rmse(p) for p in predictions]
    found = [(f"prediction_rmse_{name}", "mm", quantile(rmse, q), n) for name, q in QUARTILES.items()]
    ends = [1e3 * error for p in predictions if np.isfinite(error := prediction_rmse(p, after=HORIZON - END))]
    if ends:
        found.append(("prediction_end_error_median", "mm", quantile(ends, 0.5), len(ends)))
    for level in LEVELS:
        metric = f"coverage_{100 * level:.0f}"
        found.append((metric, "1", pooled_mean(*covered(predictions, level)), n))
        for i, axis in enumerate("xyz"):
            share = pooled_mean(*covered(predictions, level, slice(i, i + 1)))
            found.append((f"{metric}_{axis}", "1", share, n))
    return found


def _add_smoothing(results: Results, measured: Measured) -> None:
    """Measures of the smoother on whole tracks: whitened innovations, marked samples, hits, contacts.

    Samples next to a marked hit do not count.
    """
    estimates, case = measured.smoothed, measured.name
    counted = [_explained(e) for e in estimates]
    rng = np.random.default_rng([results.seed, 5])
    samples = [c["samples"] for c in counted]
    for metric in ("within_5_sigma", "within_5_sigma_marked_fail", "share_marked", "share_wide"):
        figure = bootstrap(pooled_mean([c[metric] for c in counted], samples), len(counted), rng)
        results.add(case, WHOLE, metric, "1", figure, sum(samples))
    results.add(case, WHOLE, "hits", "1", sum(len(e.hits) for e in estimates), len(estimates))
    results.add(case, WHOLE, "contacts", "1", sum(len(e.contacts) for e in estimates), len(estimates))
    failed = sum(e.status is not Status.OK for e in estimates)
    results.add(case, WHOLE, "not_converged", "1", failed, len(estimates))


def _explained(estimate: Estimate) -> dict[str, int]:
    """Numbers of samples away from hits: all, within 5 sigma, the same and not marked, marked, wide.

    Marked is what the segmentation calls shifted or an outlier, whose innovations are measured against a much larger
    noise; wide samples are measured against a noise four times as large.
    """
    away = np.ones(len(estimate.times), dtype=bool)
    away[estimate.hits] = away[estimate.hits + 1] = False
    within = (np.abs(estimate.whitened) <= WITHIN).all(axis=-1)  # NaN is not within
    marked = estimate.quality >= Quality.SHIFTED
    masks = {
        "samples": away,
        "within_5_sigma": away & within,
        "within_5_sigma_marked_fail": away & within & ~marked,
        "share_marked": away & marked,
        "share_wide": away & (estimate.quality == Quality.WIDE),
    }
    return {name: int(mask.sum()) for name, mask in masks.items()}
