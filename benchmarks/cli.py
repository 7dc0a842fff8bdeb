"""The app `ballfg-bench` and its entry point.

Commands import what they need inside: `ballfg-bench --help` must not wait for torch or GTSAM.
"""

from __future__ import annotations

import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli.errors import guarded
from ballfg.cli.inputs import default_jobs

if TYPE_CHECKING:
    from ballfg.benchmarks.results import Results
    from ballfg.tracks import Dataset

app = typer.Typer(
    name="ballfg-bench",
    help="Estimators, dynamics models and the diagnosis, measured: a table, results.json, pictures.",
    add_completion=False,
    pretty_exceptions_enable=False,
)

Data = Annotated[Path | None, typer.Option("--data", help="Dataset of measured tracks; synthetic ones without it.")]
Datasets = Annotated[
    list[Path] | None,
    typer.Option("--data", help="Dataset of measured tracks, several times for several; synthetic ones without it."),
]
MeasuredBeside = Annotated[
    list[Path] | None, typer.Option("--data", help="Dataset of measured tracks beside the simulated ones; repeatable.")
]
Transfer = Annotated[Path | None, typer.Option(help="Dataset that the models are judged on without learning from it.")]
TransferTracks = Annotated[int | None, typer.Option(min=1, help="Only so many of its first tracks.")]
Out = Annotated[Path, typer.Option("--out", help="Folder for results.json and pictures.")]
Quick = Annotated[bool, typer.Option("--quick", help="Fewer tracks or runs: a look, not a measurement.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Of every random choice.")]
Jobs = Annotated[int | None, typer.Option("--jobs", min=1, help="Processes; one per core without it.")]


@app.callback(invoke_without_command=True)
def _root(context: typer.Context) -> None:
    """Estimators, dynamics models and the diagnosis, measured: a table, results.json, pictures."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@app.command()
def estimators(
    data: Data = None, out: Out = Path("results"), quick: Quick = False, seed: Seed = 0, jobs: Jobs = None
) -> None:
    """Sliding window, EKF, RTS, online and smoother on the same tracks.

    Without --data: synthetic tracks with known truth, by the paper's protocol and by a fair one. With it: observe the
    first 0.25 s of each measured track, predict the next 0.3 s.

    Example: ballfg-bench estimators --data data/aimy --out results/aimy
    """
    from ballfg.benchmarks.estimators.suite import FULL, QUICK, run_dataset, run_synthetic

    results = _start("estimators", [] if data is None else [data], quick, seed)
    size, processes = QUICK if quick else FULL, jobs or default_jobs()
    if data is None:
        pictures = run_synthetic(results, _folder(out), size, processes)
    else:
        dataset = _open(data)
        pictures = run_dataset(results, dataset, _folder(out), size, processes)
    _finish(results, out, pictures)


@app.command()
def cameras(out: Out = Path("results"), quick: Quick = False, seed: Seed = 0, jobs: Jobs = None) -> None:
    """From rendered videos of three cameras to points, velocities and clocks, against the truth.

    Recordings with one shutter and with three, one ball and two, dropped frames, a clock that is late, a camera that
    was turned after its calibration; and what it costs.

    Example: ballfg-bench cameras --out results/cameras
    """
    from ballfg.benchmarks.cameras.suite import FULL, QUICK, run_cameras

    results = _start("cameras", [], quick, seed)
    pictures = run_cameras(results, _folder(out), QUICK if quick else FULL, jobs or default_jobs())
    _finish(results, out, pictures)


@app.command()
def dynamics(
    data: Datasets = None,
    transfer: Transfer = None,
    transfer_tracks: TransferTracks = None,
    out: Out = Path("results"),
    quick: Quick = False,
    seed: Seed = 0,
    jobs: Jobs = None,
) -> None:
    """Dynamics models: trained on the same tracks, predicting the same others; errors over tracks and of their apexes.

    Without --data: 717 synthetic launcher tracks, whose truth no compared model holds. With it: learn from every second
    measured track; of the others observe the first 0.25 s and predict the next 0.3 s. Several datasets train one model.
    What is finished is kept in OUT/runs, so that a run that was stopped goes on.

    Example: ballfg-bench dynamics --quick --out results/dynamics
    """
    from ballfg.benchmarks.dynamics.suite import FULL, QUICK, Measured, run_dynamics

    if transfer is not None and not data:
        raise ValueError("--transfer needs a model trained on measured tracks; got no --data. Give it, once or more.")
    if transfer_tracks is not None and transfer is None:
        raise ValueError("--transfer-tracks is of --transfer; got none. Give it, or leave both out.")
    words = [] if transfer is None else ["--transfer", transfer.resolve().name]
    words += [] if transfer_tracks is None else ["--transfer-tracks", str(transfer_tracks)]
    results = _start("dynamics", data or [], quick, seed, words)
    other = None if transfer is None else _open(transfer)
    measured = Measured([_open(one) for one in data], other, transfer_tracks) if data else None
    pictures = run_dynamics(results, measured, _folder(out), QUICK if quick else FULL, jobs or default_jobs())
    _finish(results, out, pictures)


@app.command()
def loop(
    data: MeasuredBeside = None, out: Out = Path("results"), quick: Quick = False, seed: Seed = 0, jobs: Jobs = None
) -> None:
    """The diagnosis: does it name what was planted, stay silent where nothing was, and mend the model?

    Simulated datasets with every catalogue effect in several sizes, with pairs of them, with nothing lacking, and with
    physics of no catalogue; next to the ideal test of each effect alone. --data adds measured tracks, diagnosed with
    the nominal model and with gravity, drag and the bounce only. What is finished is kept in OUT/runs, so that a run
    that was stopped goes on.

    Example: ballfg-bench loop --data data/aimy --out results/loop
    """
    from ballfg.benchmarks.diagnosis.suite import FULL, QUICK, run_loop

    results = _start("loop", data or [], quick, seed)
    for folder in data or []:
        _open(folder)  # a bad one is better known now than hours later
    pictures = run_loop(results, data or [], _folder(out), QUICK if quick else FULL, jobs or default_jobs())
    _finish(results, out, pictures)


@app.command()
def speed(data: Data = None, out: Out = Path("results"), quick: Quick = False, seed: Seed = 0) -> None:
    """What an estimate, an update and a prediction cost, next to a control; one thread, warm, medians.

    The problem is fixed: 80 observations of a free flight. --data adds the time per track of a dataset.

    Example: ballfg-bench speed --out results/speed
    """
    from ballfg.benchmarks.speed.suite import run_speed

    results = _start("speed", [] if data is None else [data], quick, seed)
    run_speed(results, None if data is None else _open(data), quick)
    _finish(results, _folder(out), [])


def _start(command: str, data: Sequence[Path], quick: bool, seed: int, more: Sequence[str] = ()) -> Results:
    """Empty results that name the command; of a dataset's path only the folder's name is kept.

    Args: more: words between the datasets and the rest.
    """
    import torch

    from ballfg.benchmarks.results import Results

    torch.set_num_threads(1)
    words = ["ballfg-bench", command]
    words += [word for one in data for word in ("--data", one.resolve().name)]
    words += more
    words += ["--quick"] if quick else []
    return Results(" ".join([*words, "--seed", str(seed)]), seed)


def _open(data: Path) -> Dataset:
    """A dataset; what was repaired in it is said on stderr."""
    from ballfg.tracks import read_dataset

    dataset = read_dataset(data)
    for note in dataset.notes:
        print(f"note: {note}", file=sys.stderr)
    return dataset


def _folder(out: Path) -> Path:
    if out.exists() and not out.is_dir():
        raise ValueError(f"--out must be a folder; {out} is a file. Choose another name.")
    out.mkdir(parents=True, exist_ok=True)
    return out


def _finish(results: Results, out: Path, pictures: Sequence[Path]) -> None:
    """Print the table, write `results.json`, say where everything is."""
    from ballfg.benchmarks.results import print_table

    print_table(results.rows)
    path = results.write(out)
    print(f"\n{path}: {len(results.rows)} rows")
    for picture in pictures:
        print(picture)


def run(arguments: Sequence[str] | None = None) -> None:
    """Runs `ballfg-bench` with the given arguments, by default the command line's, and exits.

    Raises: SystemExit: always; status 0, 2 on bad input, 130 after Ctrl-C.
    """
    command = typer.main.get_command(app)
    given = sys.argv[1:] if arguments is None else list(arguments)
    sys.exit(guarded(lambda: command.main(given, prog_name="ballfg-bench", standalone_mode=False)))
