"""`ballfg predict`: from the first part of every track, where the ball is at all later stamps."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli.estimate import Method
from ballfg.cli.inputs import OwnEffects, check_dataset, check_out, default_jobs, open_inputs, status_lines
from ballfg.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from ballfg.estimation import TrackPrediction


def predict(
    dataset: Annotated[
        Path, typer.Argument(help="Folder with dataset.yaml and tracks.csv or tracks.parquet.", callback=check_dataset)
    ],
    observe: Annotated[float, typer.Option(help="Seconds from the start of each track that the estimator sees.")],
    out: Annotated[Path, typer.Option(help="Table to write; .csv or .parquet.")],
    method: Annotated[Method, typer.Option(help="The estimator.")] = Method.SMOOTHER,
    model: Annotated[Path | None, typer.Option(help="Model file; the nominal table-tennis model without it.")] = None,
    effects: OwnEffects = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.", show_default="one per core")] = default_jobs(),
) -> None:
    """Positions at every stamp after the observed part, with the standard deviation of a measurement there.

    They are those that will be measured, with all measurement effects that the model file holds.

    Example: ballfg predict data/ballgun --observe 0.25 --out predictions.csv
    """
    from ballfg.estimation import check_observe, predict_tracks
    from ballfg.tracks import TableWriter

    statuses: Counter[str] = Counter()
    rows, squares, ended = 0, 0.0, 0
    with TableWriter(out) as table:
        check_out(out, dataset)
        check_observe(observe)
        inputs = open_inputs(dataset, model, effects)
        count = len(inputs.dataset)
        predictions = predict_tracks(inputs.estimator(method.value), inputs.dataset, count, observe, jobs=jobs)
        for result in progress(predictions, count, "tracks predicted"):
            table.write(_columns(result))
            statuses[result.status.value] += 1
            rows += len(result.times)
            ended += len(result.times) == 0
            squares += float(((result.positions - result.measured) ** 2).sum())
    print(f"{out}: {rows} positions of {count} tracks, from the first {observe:g} s of each by {method.value}")
    for line in status_lines(statuses):
        print(line)
    if rows:
        print(f"  RMSE against what was measured there: {1e3 * (squares / rows) ** 0.5:.1f} mm over all stamps")
    if ended:
        print(f"  {ended} of the tracks end within {observe:g} s: nothing to predict")


def _columns(result: TrackPrediction) -> dict[str, str | np.ndarray]:
    columns: dict[str, str | np.ndarray] = {"trajectory": result.name, "t": result.times}
    columns |= dict(zip(("x", "y", "z"), result.positions.T, strict=True))
    columns |= dict(zip(("sigma_x", "sigma_y", "sigma_z"), result.sigmas.T, strict=True))
    return columns
