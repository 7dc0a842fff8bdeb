"""Implements `ballfg estimate`, which estimates the states of every track of a dataset."""

from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli import inputs
from ballfg.cli.outcome import Outcome
from ballfg.progress import counted, print_doubts, progress

if TYPE_CHECKING:
    import numpy as np

    from ballfg.dynamics import BallModel
    from ballfg.estimation import Status
    from ballfg.estimation.estimator import Estimator
    from ballfg.tracks import Track


def estimate(
    dataset: Annotated[
        Path,
        typer.Argument(
            help="Folder with dataset.yaml and tracks, or detections and cameras.", callback=inputs.check_dataset
        ),
    ],
    out: inputs.OutTable,
    method: inputs.MethodName = "smoother",
    solver: inputs.SolverName = None,
    model: inputs.ModelFile = None,
    group: inputs.GroupName = None,
    ball: inputs.BallName = None,
    source: inputs.SourceName = None,
    effects_file: inputs.EffectsFiles = None,
    observations_file: inputs.ObservationsFiles = None,
    jobs: inputs.Jobs = inputs.CORES,
    cluster: inputs.Cluster = None,
    address: inputs.Address = None,
) -> None:
    """Position, velocity and spin with standard deviations, one row per stamp.

    Measurement effects of the model file are removed from the states; the stamps stay as they are written.

    From detections, the smoother and the online estimator use every camera's pixels at its own stamp; the stamps of the
    table are then true times, with the cameras' time offsets subtracted. The other methods use roughly triangulated
    positions. For a ball that one camera saw, gravity and a bounce on the table give the depth; only the smoother
    takes it. A network that knows where it was trained adds the column outside: 0 there, 1 far from it.

    A track that no motion explains has its measured positions with wide sigmas. Where there are such tracks, the table
    is written whole, they are listed, and the exit status is 3.

    Example: ballfg estimate data/aimy --method smoother --out states.csv
    """
    from ballfg.estimation.batch import map_tracks
    from ballfg.tracks import TableWriter

    outcome = Outcome()
    rows = hits = flying = 0
    with TableWriter(out, name="out") as table, inputs.workers(cluster, address, jobs) as workers:
        inputs.know(observations=observations_file)
        inputs.check_out(out, dataset)
        opened = inputs.open_source(source, dataset, model, effects_file, ball=ball)
        print_doubts(inputs.filtered(opened.dataset))
        count = len(opened.dataset)
        work = partial(_estimated, opened.model, opened.estimator(method, solver, group))
        results = map_tracks(work, opened.dataset, count, workers)
        for result in progress(results, count, "tracks estimated"):
            for columns in result.columns:
                table.write(columns)
            outcome.add(result.name, result.status, result.notes, result.outside)
            rows, hits, flying = rows + result.rows, hits + result.hits, flying + result.flying
    if flying < rows:
        print_doubts([f"{100 * flying // rows} % of the samples are flight; the rest is held, rolls, rests or is lost"])
    print(f"{out}: {counted(rows, 'state')} of {counted(count, 'track')} by {method}; {counted(hits, 'hit')} found")
    outcome.print()
    outcome.print_outside()
    outcome.end()


@dataclass(frozen=True)
class _Estimated:
    """The parts of an estimate that the table and the last lines need: a tenth of it, for other processes."""

    name: str
    columns: "list[dict[str, str | np.ndarray]]"
    status: "Status"
    notes: tuple[str, ...]
    outside: float | None
    rows: int
    hits: int
    flying: int


def _estimated(model: "BallModel", estimator: "Estimator", track: "Track") -> _Estimated:
    from ballfg.estimation.flights.estimates import in_sections
    from ballfg.estimation.out_of_distribution import out_of_distribution
    from ballfg.estimation.result import Label

    columns, shares, notes, rows, hits, flying = [], list[float](), list[str](), 0, 0, 0
    status = None
    for part in in_sections(estimator, track):
        share = out_of_distribution(model, part.states)
        own: dict[str, str | np.ndarray] = {"trajectory": part.name, **part.columns}
        own |= part.correlations if track.rough else {}
        columns.append(own if share is None else own | {"outside": share})
        shares += [] if share is None else [float(share.sum())]
        notes += part.notes
        rows += len(part.times)
        hits += len(part.hits)
        flying += int((part.labels == Label.FLIGHT).sum())
        status = part.status if status is None or part.status.failed else status
    outside = sum(shares) / rows if shares else None
    assert status is not None
    return _Estimated(part.name, columns, status, tuple(notes), outside, rows, hits, flying)
