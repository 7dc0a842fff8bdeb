"""`ballfg estimate`: the states of every track of a dataset."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli import inputs
from ballfg.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from ballfg.estimation import Estimate


def estimate(
    dataset: Annotated[
        Path,
        typer.Argument(
            help="Folder with dataset.yaml and tracks, or detections and cameras.", callback=inputs.check_dataset
        ),
    ],
    out: inputs.OutTable,
    method: inputs.MethodName = "smoother",
    model: inputs.ModelFile = None,
    source: Annotated[
        inputs.Source | None,
        typer.Option(
            "--from",
            help="Input: positions of tracks, or camera detections (detections.csv with cameras.yaml).",
            show_default="positions where there is a table of tracks",
        ),
    ] = None,
    effects_file: inputs.EffectsFiles = None,
    jobs: inputs.Jobs = inputs.CORES,
) -> None:
    """Position, velocity and spin with standard deviations, one row per stamp.

    Measurement effects of the model file are removed from the states; the stamps stay as they are written.

    From detections, the smoother and the online estimator use every camera's pixels at its own stamp; the stamps of the
    table are then true times, with the cameras' time offsets subtracted. The other methods use roughly triangulated
    positions. A network that knows where it was trained adds the column outside: 0 there, 1 far from it.

    Example: ballfg estimate data/aimy --method smoother --out states.csv
    """
    from ballfg.estimation import estimate_tracks, has_positions
    from ballfg.estimation.outside import outside_of
    from ballfg.tracks import TableWriter

    statuses: Counter[str] = Counter()
    doubts: list[str] = []
    outside: list[float] = []
    rows = hits = 0
    with TableWriter(out) as table:
        inputs.check_out(out, dataset)
        positions = has_positions(dataset) if source is None else source is inputs.Source.POSITIONS
        open_dataset = inputs.open_inputs if positions else inputs.open_sighted
        opened = open_dataset(dataset, model, effects_file)
        count = len(opened.dataset)
        estimates = estimate_tracks(opened.estimator(method), opened.dataset, count, jobs)
        for result in progress(estimates, count, "tracks estimated"):
            share = outside_of(opened.model, result.states)
            table.write(_columns(result) | ({} if share is None else {"outside": share}))
            outside += [] if share is None else [float(share.mean())]
            statuses[result.status.value] += 1
            doubts += [f"track {result.name!r}: {note}" for note in result.notes]
            rows, hits = rows + len(result.times), hits + len(result.hits)
    print(f"{out}: {rows} states of {count} tracks by {method}; {hits} hits found")
    inputs.print_outcome(statuses, doubts)
    inputs.print_outside(outside)


def _columns(result: Estimate) -> dict[str, str | np.ndarray]:
    from ballfg.state import SIGMA_NAMES, STATE_NAMES

    columns: dict[str, str | np.ndarray] = {"trajectory": result.name, "t": result.times}
    columns |= dict(zip(STATE_NAMES, result.states.T, strict=True))
    columns |= dict(zip(SIGMA_NAMES, result.sigmas.T, strict=True))
    return columns
