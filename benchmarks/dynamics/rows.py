"""Makes rows from the errors of finished contenders, pooled over tracks and averaged over seeds."""

from collections.abc import Iterator, Sequence

import numpy as np

from ballfg.benchmarks.dynamics.jobs import TIMED
from ballfg.benchmarks.dynamics.record import Record
from ballfg.benchmarks.dynamics.scoring import PathScore, pooled_rmse
from ballfg.benchmarks.dynamics.task import APEXES, Task
from ballfg.benchmarks.metrics import Figure
from ballfg.benchmarks.results import CURVE_MARK, Results


def add_rows(results: Results, task: Task, records: Sequence[Record]) -> None:
    """The rows of one method: means over the seeds, from the lowest to the highest seed; each seed by itself at `@`.

    Figures that a method does not have are left out: one that predicts only what comes after the observed part has no
    error over the whole track.
    """
    method, measured = records[0].method, task.truth is None
    by_seed = [{figure[0]: figure for figure in figures(record, measured)} for record in records]
    for name, (_, unit, value, n) in by_seed[0].items():
        values = [found[name][2] for found in by_seed]
        if len(values) == 1:
            results.add(task.case, method, name, unit, float(value), n)
            continue
        results.add(task.case, method, name, unit, Figure(float(np.mean(values)), min(values), max(values)), n)
        for record, one in zip(records, values, strict=True):
            results.add(task.case, method, f"{name}{CURVE_MARK}{record.seed}", unit, one, n)


def figures(record: Record, measured: bool) -> Iterator[tuple[str, str, float, int]]:
    """Metric, unit, value and number of tracks of every figure of one contender.

    On measured tracks `prediction_rmse_median` is the figure of `ballfg-bench estimators --data`, in its unit.
    """
    scores = record.scores
    n = len(scores)
    if all(s.track[0] is not None for s in scores):
        yield "track_rmse", "m", pooled_rmse([s.track for s in scores]), n
        yield "track_rmse_median", "m", float(np.median([s.track_rmse for s in scores])), n
    ahead = [s for s in scores if s.rest[1]]
    if ahead:
        yield "rest_rmse", "m", pooled_rmse([s.rest for s in ahead]), len(ahead)
        median = float(np.median([s.rest_rmse for s in ahead]))
        yield "rest_rmse_median", "m", median, len(ahead)
        if measured:
            yield "prediction_rmse_median", "mm", 1e3 * median, len(ahead)
    yield from _apex_figures(scores)
    yield "parameters", "1", record.parameters, 1
    yield "training_time", "s", record.training_time, 1
    yield "inference_time", "s", record.inference_time, min(TIMED, n)
    yield "not_converged", "1", record.not_converged, n


def _apex_figures(scores: Sequence[PathScore]) -> Iterator[tuple[str, str, float, int]]:
    """Mean and standard deviation of apex errors by flight: of all, and of those after the observed part."""
    errors, ahead = np.array([s.apex for s in scores], dtype=np.float64), np.array([s.apex_ahead for s in scores])
    for suffix, counted in (("", np.isfinite(errors)), ("_ahead", np.isfinite(errors) & ahead)):
        for flight, name in enumerate(APEXES):
            found = errors[counted[:, flight], flight]
            if len(found):
                yield f"apex_{name}{suffix}_mean", "m", float(found.mean()), len(found)
                yield f"apex_{name}{suffix}_std", "m", float(found.std()), len(found)
