"""`ballfg predict`: from the first part of every track, where the ball is at all later stamps."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ballfg.cli.estimate import Method
from ballfg.cli.inputs import default_jobs, open_inputs
from ballfg.cli.progress import progress


def predict(
    dataset: Annotated[Path, typer.Argument(help="Folder with dataset.yaml and tracks.csv or tracks.parquet.")],
    observe: Annotated[float, typer.Option(help="Seconds from the start of each track that the estimator sees.")],
    out: Annotated[Path, typer.Option(help="Table to write; .csv or .parquet.")],
    method: Annotated[Method, typer.Option(help="The estimator.")] = Method.SMOOTHER,
    model: Annotated[Path | None, typer.Option(help="Model file; the nominal table-tennis model without it.")] = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.", show_default="one per core")] = default_jobs(),
) -> None:
    """Positions at every stamp after the observed part, with the standard deviation of a measurement there.

    Example: ballfg predict data/ballgun --observe 0.25 --out predictions.csv
    """
    import numpy as np

    from ballfg.predict import predict_tracks
    from ballfg.tracks import TableWriter

    inputs = open_inputs(dataset, model)
    count = len(inputs.dataset)
    estimator = inputs.estimator(method.value)
    rows, squares, ended = 0, 0.0, 0
    with TableWriter(out) as table:
        predictions = predict_tracks(estimator, inputs.dataset, count, observe, jobs=jobs)
        for result in progress(predictions, count, "tracks predicted"):
            x, sigma = result.positions, result.sigmas
            table.write(
                {"trajectory": np.repeat(result.name, len(x)), "t": result.times}
                | {name: x[:, i] for i, name in enumerate(("x", "y", "z"))}
                | {name: sigma[:, i] for i, name in enumerate(("sigma_x", "sigma_y", "sigma_z"))}
            )
            rows += len(x)
            ended += len(x) == 0
            squares += float(((x - result.measured) ** 2).sum())
    print(f"{out}: {rows} positions of {count} tracks, from the first {observe:g} s of each by {method.value}")
    if rows:
        print(f"  RMSE against what was measured there: {1e3 * (squares / rows) ** 0.5:.1f} mm over all stamps")
    if ended:
        print(f"  {ended} tracks end within {observe:g} s: nothing to predict")
