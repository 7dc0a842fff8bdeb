"""`ballfg estimate`: the states of every track of a dataset."""

from __future__ import annotations

import enum
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli.inputs import (
    CORES,
    Jobs,
    ModelFile,
    OutTable,
    OwnEffects,
    Source,
    check_out,
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
    dataset: Annotated[Path, typer.Argument(help="Folder with dataset.yaml and tracks, or detections and cameras.")],
    out: OutTable,
    method: Annotated[Method, typer.Option(help="Estimator.")] = Method.SMOOTHER,
    model: ModelFile = None,
    source: Annotated[
        Source | None,
        typer.Option(
            "--from",
            help="Input: positions of tracks, or camera detections (detections.csv with cameras.yaml).",
            show_default="positions where there is a table of tracks",
        ),
    ] = None,
    effects: OwnEffects = None,
    jobs: Jobs = CORES,
) -> None:
    """Position, velocity and spin with standard deviations, one row per stamp.

    Measurement effects of the model file are removed from the states; the stamps stay as they are written.

    From detections, the smoother and the online estimator use every camera's pixels at its own stamp; the stamps of the
    table are then true times, with the cameras' time offsets subtracted. The other methods use roughly triangulated
    positions.

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
