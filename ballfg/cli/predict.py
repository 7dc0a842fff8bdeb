"""`ballfg predict`: from the first part of every track, where the ball is at all later stamps."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli.estimate import Method
from ballfg.cli.inputs import CORES, Jobs, ModelFile, OutTable, OwnEffects, check_out, open_inputs, status_lines
from ballfg.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from ballfg.prediction import TrackPrediction


def predict(
    dataset: Annotated[Path, typer.Argument(help="Folder with dataset.yaml and tracks.csv or tracks.parquet.")],
    observe: Annotated[float, typer.Option(help="Observed time from the start of each track, s.")],
    out: OutTable,
    method: Annotated[Method, typer.Option(help="Estimator.")] = Method.SMOOTHER,
    model: ModelFile = None,
    effects: OwnEffects = None,
    jobs: Jobs = CORES,
) -> None:
    """Positions at every stamp after the observed part, with the standard deviation of a measurement there.

    These are the positions that will be measured: measurement effects of the model file are included.

    Example: ballfg predict data/ballgun --observe 0.25 --out predictions.csv
    """
    from ballfg.prediction import check_observe, predict_tracks
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
