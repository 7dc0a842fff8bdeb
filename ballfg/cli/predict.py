"""`ballfg predict`: from the first part of every track, where the ball is at all later stamps."""

from __future__ import annotations

from collections import Counter
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli import inputs
from ballfg.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from ballfg.estimation import TrackPrediction


def predict(
    dataset: inputs.DatasetFolder,
    observe: Annotated[float, typer.Option(help="Observed time from the start of each track, s.")],
    out: inputs.OutTable,
    method: inputs.MethodName = "smoother",
    model: inputs.ModelFile = None,
    effects_file: inputs.EffectsFiles = None,
    jobs: inputs.Jobs = inputs.CORES,
) -> None:
    """Positions at every stamp after the observed part, with the standard deviation of a measurement there.

    These are the positions that will be measured: measurement effects of the model file are included.

    Example: ballfg predict data/ballgun --observe 0.25 --out predictions.csv
    """
    from ballfg.estimation import check_observe, predict_tracks
    from ballfg.tracks import TableWriter

    statuses: Counter[str] = Counter()
    doubts: list[str] = []
    rows, squares, ended = 0, 0.0, 0
    with TableWriter(out) as table:
        inputs.check_out(out, dataset)
        check_observe(observe)
        opened = inputs.open_inputs(dataset, model, effects_file, observe)
        count = len(opened.dataset)
        predictions = predict_tracks(opened.estimator(method), opened.dataset, count, observe, jobs=jobs)
        for result in progress(predictions, count, "tracks predicted"):
            table.write(_columns(result))
            statuses[result.status.value] += 1
            doubts += [f"track {result.name!r}: {note}" for note in result.estimate.notes]
            rows += len(result.times)
            ended += len(result.times) == 0
            squares += float(((result.positions - result.measured) ** 2).sum())
    print(f"{out}: {rows} positions of {count} tracks, from the first {observe:g} s of each by {method}")
    inputs.print_outcome(statuses, doubts)
    if rows:
        print(f"  RMSE against what was measured there: {1e3 * (squares / rows) ** 0.5:.1f} mm over all stamps")
    if ended:
        print(f"  {ended} of the tracks end within {observe:g} s: nothing to predict")


def _columns(result: TrackPrediction) -> dict[str, str | np.ndarray]:
    columns: dict[str, str | np.ndarray] = {"trajectory": result.name, "t": result.times}
    columns |= dict(zip(("x", "y", "z"), result.positions.T, strict=True))
    columns |= dict(zip(("sigma_x", "sigma_y", "sigma_z"), result.sigmas.T, strict=True))
    return columns
