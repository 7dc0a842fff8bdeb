"""`ballfg estimate`: the states of every track of a dataset."""

from __future__ import annotations

import enum
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli.inputs import (
    OwnEffects,
    Source,
    check_dataset,
    check_out,
    default_jobs,
    open_inputs,
    open_sighted,
    source_of,
    status_lines,
)
from ballfg.progress import progress

if TYPE_CHECKING:
    import numpy as np

    from ballfg.estimation import Estimate


class Method(enum.StrEnum):
    """The estimators, by the name of the option."""

    SMOOTHER = "smoother"
    ONLINE = "online"
    EKF = "ekf"
    SLIDING_WINDOW = "sliding-window"


def estimate(
    dataset: Annotated[
        Path,
        typer.Argument(help="Folder with dataset.yaml and tracks, or detections and cameras.", callback=check_dataset),
    ],
    out: Annotated[Path, typer.Option(help="Table to write; .csv or .parquet.")],
    method: Annotated[Method, typer.Option(help="The estimator.")] = Method.SMOOTHER,
    model: Annotated[Path | None, typer.Option(help="Model file; the nominal table-tennis model without it.")] = None,
    source: Annotated[
        Source | None,
        typer.Option(
            "--from",
            help="Positions of tracks, or detections of cameras: detections.csv with cameras.yaml.",
            show_default="positions where there is a table of tracks",
        ),
    ] = None,
    effects: OwnEffects = None,
    jobs: Annotated[int, typer.Option(min=1, help="Processes.", show_default="one per core")] = default_jobs(),
) -> None:
    """Position, velocity and spin with standard deviations, one row per stamp.

    They are the true ones where the model file holds measurement effects; the stamps stay as they are written.

    From detections, smoother and online rest on every camera's pixels at its own stamp, and stamps are true times: less
    the cameras' time offsets. The others use positions that are roughly triangulated.

    Example: ballfg estimate data/aimy --method smoother --out states.csv
    """
    from ballfg.estimation import estimate_tracks
    from ballfg.tracks import TableWriter

    statuses: Counter[str] = Counter()
    rows = hits = 0
    with TableWriter(out) as table:
        check_out(out, dataset)
        opened = open_inputs if (source or source_of(dataset)) is Source.POSITIONS else open_sighted
        inputs = opened(dataset, model, effects)
        count = len(inputs.dataset)
        estimates = estimate_tracks(inputs.estimator(method.value), inputs.dataset, count, jobs)
        for result in progress(estimates, count, "tracks estimated"):
            table.write(_columns(result))
            statuses[result.status.value] += 1
            rows, hits = rows + len(result.times), hits + len(result.hits)
    print(f"{out}: {rows} states of {count} tracks by {method.value}; {hits} hits found")
    for line in status_lines(statuses):
        print(line)


def _columns(result: Estimate) -> dict[str, str | np.ndarray]:
    from ballfg.state import SIGMA_NAMES, STATE_NAMES

    columns: dict[str, str | np.ndarray] = {"trajectory": result.name, "t": result.times}
    columns |= dict(zip(STATE_NAMES, result.states.T, strict=True))
    columns |= dict(zip(SIGMA_NAMES, result.sigmas.T, strict=True))
    return columns
