"""Defines the app `ballfg-bench` and its entry point.

Commands import what they need inside: `ballfg-bench --help` must not wait for torch or GTSAM.
"""

import inspect
import os
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial, wraps
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ballfg.cli.inputs import CORES, Address, Cluster, Jobs, workers
from ballfg.cli.start import start
from ballfg.progress import print_notes

if TYPE_CHECKING:
    from ballfg.benchmarks.results import Results
    from ballfg.tracks import Dataset

MEASURED = Path("../shared/data")  # Folder of the measured sets unless BALLFG_DATA names another

app = typer.Typer(name="ballfg-bench", add_completion=False, pretty_exceptions_enable=False)

Names = list[str] | None
Paths = list[Path] | None
_data = partial(typer.Option, "--data")
Data = Annotated[Path | None, _data(help="Dataset of measured tracks; synthetic tracks by default.")]
Datasets = Annotated[Paths, _data(help="Dataset of measured tracks; may be repeated; synthetic tracks by default.")]
Beside = Annotated[Paths, _data(help="Dataset of measured tracks in addition; may be repeated.")]
Views = Annotated[
    Paths, typer.Option("--view", help="Dataset of one camera's detections of the same tracks; may be repeated.")
]
Planted = Annotated[
    Paths, _data(help="Dataset of measured tracks; may be repeated; by default the sets in $BALLFG_DATA.")
]
Timed = Annotated[Path | None, _data(help="Dataset whose tracks are timed in addition to the fixed problem.")]
Changes = Annotated[
    Names, typer.Option("--change", help="Name of the effect that is planted; may be repeated; all by default.")
]
Transfer = Annotated[Path | None, typer.Option(help="Dataset on which the models are judged without learning from it.")]
TransferTracks = Annotated[
    int | None, typer.Option(min=1, help="Number of tracks, the first ones, of the --transfer dataset; all by default.")
]
Methods = Annotated[Names, typer.Option("--method", help="Name of a compared method; may be repeated; all by default.")]
Out = Annotated[Path, typer.Option("--out", help="Folder for results.json and pictures.")]
Quick = Annotated[bool, typer.Option("--quick", help="A quick look at few tracks or runs, not a measurement.")]
Seed = Annotated[int, typer.Option("--seed", min=0, help="Random seed.")]


@dataclass(frozen=True)
class Run:
    """The options that benchmarks share."""

    out: Out = Path("results")
    quick: Quick = False
    seed: Seed = 0
    jobs: Jobs = CORES
    cluster: Cluster = None
    address: Address = None

    def results(self, command: str, data: Sequence[Path] = (), more: Sequence[str] = ()) -> "Results":
        """Empty results that name the command, with `more` words after the datasets; of paths the folder's name."""
        import torch

        from ballfg.benchmarks.results import Results

        torch.set_num_threads(1)
        words = ["ballfg-bench", command, *(word for one in data for word in ("--data", one.resolve().name)), *more]
        return Results(" ".join([*words, *(["--quick"] if self.quick else []), "--seed", str(self.seed)]), self.seed)

    @contextmanager
    def folder(self) -> Iterator[Path]:
        """The output folder, made if it does not exist; no other run writes there until the block ends."""
        from ballfg.files.whole_folder import reserved

        if self.out.exists() and not self.out.is_dir():
            raise ValueError(f"--out must be a folder; {self.out} is a file. Choose another name.")
        self.out.mkdir(parents=True, exist_ok=True)
        with reserved(self.out, "--out"):
            yield self.out

    @contextmanager
    def working(self) -> Iterator[tuple[Path, int]]:
        """The output folder as workers find it, and their number."""
        with workers(self.cluster, self.address, self.jobs) as processes, self.folder() as folder:
            yield self.shared(folder), processes

    def shared(self, folder: Path) -> Path:
        """The folder as workers find it: those of a cluster share it, and were started anywhere."""
        return folder if self.cluster is None else folder.resolve()

    def finish(self, results: "Results", pictures: Sequence[Path] = ()) -> None:
        """Print the table, write `results.json`, say where everything is."""
        from ballfg.benchmarks.conclusions import print_table

        print_table(results.rows)
        path = results.write(self.out)
        print(f"\n{path}: {len(results.rows)} rows")
        for picture in pictures:
            print(self.out / picture.name)


def _benchmark(command: Callable[..., None]) -> Callable[..., None]:
    """Makes a command of a function whose first parameter stands for the options of `Run`, which come last."""
    own, shared = (inspect.signature(one, eval_str=True).parameters for one in (command, Run))
    parameters = [p.replace(kind=p.KEYWORD_ONLY) for p in (*list(own.values())[1:], *shared.values())]

    @wraps(command)
    def typed(**given: Any) -> None:
        command(Run(**{name: given.pop(name) for name in shared}), **given)

    typed.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
    typed.__annotations__ = {p.name: p.annotation for p in parameters}
    return app.command()(typed)


@app.callback(invoke_without_command=True)
def _root(context: typer.Context) -> None:
    """Benchmarks of estimators, cameras, dynamics models, diagnosis and speed: tables, results.json, pictures."""
    if context.invoked_subcommand is None:
        typer.echo(context.get_help())


@_benchmark
def estimators(run: Run, data: Data = None) -> None:
    """Comparison of sliding window, EKF, RTS, online estimator and smoother on the same tracks.

    Without --data: synthetic tracks with known truth, by the paper's protocol and by a fair one. With --data: each
    estimator observes the first 0.25 s of each measured track and predicts the next 0.3 s.

    Example: ballfg-bench estimators --data data/aimy --out results/aimy
    """
    from ballfg.benchmarks.estimators.suite import FULL, QUICK, run_dataset, run_synthetic

    results, size = run.results("estimators", [] if data is None else [data]), QUICK if run.quick else FULL
    dataset = None if data is None else _open(data)  # before the folder: a wrong path leaves nothing behind
    with run.working() as (folder, processes):
        if dataset is None:
            pictures = run_synthetic(results, folder, size, processes)
        else:
            pictures = run_dataset(results, dataset, folder, size, processes)
        run.finish(results, pictures)


@_benchmark
def cameras(run: Run, data: Data = None, view: Views = None) -> None:
    """Tracking from rendered videos of three cameras: points, velocities and clocks against the truth.

    With --data and --view: states from the detections of one camera at a time, against the measured tracks; with two
    views also of two phones at the first two cameras, with clocks that drift apart.

    The recordings have one shutter or three, one ball or two, dropped frames, a clock that is late, and a camera that
    was turned after its calibration. The speed of the tracking is measured too. Rallies of one camera that pans and
    zooms follow, whose place nobody tells.

    Example: ballfg-bench cameras --out results/cameras
    """
    from ballfg.benchmarks.cameras.one_view import run_phones, run_views
    from ballfg.benchmarks.cameras.suite import FULL, QUICK, run_cameras
    from ballfg.estimation import read_sighted

    if (data is None) != (not view):
        raise ValueError("--data and --view must be given together: tracks, and what one camera saw of them")
    words = [word for one in view or () for word in ("--view", one.resolve().name)]
    results = run.results("cameras", [] if data is None else [data], words)
    if data is not None:
        truth, views = _open(data), [read_sighted(one) for one in view or ()]
        with run.folder():
            run_views(results, views, truth)
            if len(views) > 1:
                run_phones(results, (views[0].cameras[0], views[1].cameras[0]), truth)
            run.finish(results)
        return
    with run.working() as (folder, processes):
        run.finish(results, run_cameras(results, folder, QUICK if run.quick else FULL, processes))


@_benchmark
def dynamics(
    run: Run,
    data: Datasets = None,
    transfer: Transfer = None,
    transfer_tracks: TransferTracks = None,
    method: Methods = None,
) -> None:
    """Comparison of dynamics models that are trained on the same tracks and predict the same others.

    Without --data: 717 synthetic launcher tracks, whose truth no compared model holds. With --data: every second
    measured track is for training; of the others 0.25 s are observed and the next 0.3 s predicted. Several datasets
    train one model. Finished parts are kept in OUT/runs, so that a stopped run can be continued.

    Example: ballfg-bench dynamics --quick --out results/dynamics
    """
    from ballfg.benchmarks.dynamics.measured import Measured
    from ballfg.benchmarks.dynamics.suite import FULL, QUICK, run_dynamics

    if transfer is not None and not data:
        raise ValueError("--transfer needs a model trained on measured tracks; got no --data. Give it, once or more.")
    if transfer_tracks is not None and transfer is None:
        raise ValueError("--transfer-tracks is of --transfer; got none. Give it, or leave both out.")
    words = [] if transfer is None else ["--transfer", transfer.resolve().name]
    words += [] if transfer_tracks is None else ["--transfer-tracks", str(transfer_tracks)]
    words += [word for name in method or () for word in ("--method", name)]
    results = run.results("dynamics", data or [], words)
    other = None if transfer is None else _open(transfer)
    measured = Measured([_open(one) for one in data], other, transfer_tracks) if data else None
    with run.working() as (folder, processes):
        plan = QUICK if run.quick else FULL
        run.finish(results, run_dynamics(results, measured, folder, plan, processes, method))


@_benchmark
def loop(
    run: Run,
    data: Beside = None,
    reliability: Annotated[
        bool, typer.Option("--reliability", help="Test stated probabilities, on sets with effects of random size.")
    ] = False,
) -> None:
    """Test of the diagnosis: planted effects that it names, false alarms, and models that it repairs.

    The simulated datasets hold every catalogue effect in several sizes, pairs of effects, nothing that the model lacks,
    or physics of no catalogue. --data adds measured tracks,
    diagnosed with the nominal model and with gravity, drag and the bounce only. Finished parts are kept in OUT/runs, so
    that a stopped run can be continued. --reliability makes other sets, with up to three effects of random size, and
    compares the stated probability of each name with the share of right names.

    Example: ballfg-bench loop --data data/aimy --out results/loop
    """
    from ballfg.benchmarks.diagnosis.cases import FULL, QUICK
    from ballfg.benchmarks.diagnosis.suite import run_loop, run_reliability

    if reliability and data:
        raise typer.BadParameter("its sets are simulated. Leave out --data.", param_hint="--reliability")
    results = run.results("loop", data or [], ["--reliability"] if reliability else [])
    for one in data or []:
        _open(one)  # refuses a bad folder at once instead of hours later
    plan = QUICK if run.quick else FULL
    with run.working() as (folder, processes):
        pictures: list[Path] = []
        if reliability:
            run_reliability(results, folder, plan.reliability, processes)
        else:
            pictures = run_loop(results, list(map(run.shared, data or [])), folder, plan, processes)
        run.finish(results, pictures)


@_benchmark
def planted(run: Run, data: Planted = None, change: Changes = None) -> None:
    """Test of the diagnosis on measured tracks: effects planted in them that it names and measures.

    Each set is diagnosed as it was, and as another instrument, tracker or air would have made it: frame turned, clock
    or heights off by a share, stamps that jitter, errors that last, a rig that moves, labels in another frame, frames
    lost and counted through, wind. Counted are right names, and strengths that changed as planted. Finished diagnoses
    are kept in OUT/runs, so that a stopped run can be continued.

    Example: ballfg-bench planted --data data/ballgun --change frame_tilt --out results/planted
    """
    from ballfg.benchmarks.diagnosis.changes import CHANGES
    from ballfg.benchmarks.diagnosis.planted import QUICK_CHANGES, QUICK_TRACKS, SETS, run_planted

    if unknown := [name for name in change or () if name not in CHANGES]:
        known = ", ".join(CHANGES)
        raise typer.BadParameter(f"it is one of {known}; got {unknown[0]}. Choose one.", param_hint="--change")
    root = Path(os.environ.get("BALLFG_DATA", MEASURED))
    folders = data or [root / name for name in SETS if (root / name).is_dir()]
    if not folders:
        raise typer.BadParameter(f"there are no measured sets in {root}. Give --data.", param_hint="--data")
    words = [word for name in change or () for word in ("--change", name)]
    results = run.results("planted", data or [], words)
    for one in folders:
        _open(one)  # refuses a bad folder at once instead of hours later
    chosen, most = (change or QUICK_CHANGES, QUICK_TRACKS) if run.quick else (change or tuple(CHANGES), None)
    with run.working() as (folder, processes):
        pictures = run_planted(results, list(map(run.shared, folders)), folder, chosen, most, processes)
        run.finish(results, pictures)


@_benchmark
def intervals(
    run: Run,
    data: Datasets = None,
    tracks: Annotated[int | None, typer.Option(min=4, help="Number of tracks of each --data, the first ones.")] = None,
    trained: Annotated[
        bool, typer.Option("--trained", help="Train a network on each pair of --data and judge it on the others.")
    ] = False,
    diagnosed: Annotated[
        bool, typer.Option("--diagnosed", help="Predict new simulated tracks with the model of a diagnosis.")
    ] = False,
) -> None:
    """Coverage of 90 % prediction intervals, with the noise as usual and with the noise that tracks show.

    Of each track 0.25 s are seen and the next 0.3 s predicted. Without --data: simulated trackers with a memory and
    jittering stamps, and the true model. With --data: measured tracks and the nominal model; with --trained too:
    networks in rooms that had no part in their training.

    Example: ballfg-bench intervals --data data/aimy --data data/ballgun --out results/intervals
    """
    from ballfg.benchmarks.intervals import suite, trained as networks

    if diagnosed and data:
        raise typer.BadParameter("it is for simulated tracks. Leave out --data.", param_hint="--diagnosed")
    more = [*([] if tracks is None else ["--tracks", str(tracks)]), *(["--trained"] if trained else [])]
    more += ["--diagnosed"] if diagnosed else []
    results = run.results("intervals", data or [], more)
    if trained and tracks is not None:
        raise typer.BadParameter("networks are judged on all tracks. Leave it out.", param_hint="--tracks")
    datasets = [] if trained else [_open(one) for one in data or []]
    with workers(run.cluster, run.address, run.jobs) as processes:
        if trained:
            networks.run_trained(results, data or [], networks.QUICK if run.quick else networks.FULL, processes)
        else:
            plan = suite.QUICK if run.quick else suite.FULL
            suite.run_intervals(results, datasets, plan, processes, tracks, diagnosed)
    with run.folder():
        run.finish(results)


@app.command()
def speed(
    data: Timed = None,
    peers: Annotated[
        bool, typer.Option("--peers", help="Solve the same problems with ballfg, GTSAM and each --peer in turns.")
    ] = False,
    peer: Annotated[
        list[str] | None,
        typer.Option(help="LIBRARY=PATH_TO_PYTHON, for --peers: jaxls, theseus or pypose and an interpreter with it."),
    ] = None,
    gate: Annotated[
        Path | None, typer.Option(help="An earlier results.json; fail where something has become slower since.")
    ] = None,
    out: Out = Path("results"),
    quick: Quick = False,
    seed: Seed = 0,
) -> None:
    """Times of an estimate, an update and a prediction next to a control: one thread, warm, medians.

    The problem is fixed: 80 observations of a free flight. --data adds the time per track of a dataset. With --gate
    times are compared as multiples of the control, so that another machine's results.json serves too.

    Example: ballfg-bench speed --out results/speed
    """
    from ballfg.benchmarks.speed.peers.suite import run_peers
    from ballfg.benchmarks.speed.stopwatch import SlowerError, check_ratios
    from ballfg.benchmarks.speed.suite import FULL, QUICK, run_speed

    pairs = [word.partition("=") for word in peer or ()]
    if any(not (library and path) for library, _, path in pairs):
        raise typer.BadParameter("it is LIBRARY=PATH_TO_PYTHON.", param_hint="--peer")
    interpreters = {library: Path(path) for library, _, path in pairs}
    if peer and not peers:
        raise typer.BadParameter("it is for --peers. Give that too, or leave both out.", param_hint="--peer")
    if peers and data is not None:
        raise typer.BadParameter("peers solve the fixed problems only. Leave it out.", param_hint="--data")
    words = [*(["--peers"] if peers else []), *(word for name in interpreters for word in ("--peer", name))]
    run, size = Run(out, quick, seed), QUICK if quick else FULL
    results = run.results("speed", [] if data is None else [data], words)
    if gate is not None and not gate.is_file():
        raise typer.BadParameter(f"there is no file {gate}. Give an earlier results.json.", param_hint="--gate")
    if peers:
        run_peers(results, interpreters, size)
    else:
        run_speed(results, None if data is None else _open(data), size)
    with run.folder():
        run.finish(results)
    if gate is not None:
        try:
            print("\n" + "\n".join(check_ratios(results.rows, gate)))
        except SlowerError as error:
            print(f"ballfg: {error}", file=sys.stderr)
            raise typer.Exit(1) from None


def _open(data: Path) -> "Dataset":
    from ballfg.estimation.reading import with_readings
    from ballfg.tracks import read_dataset

    dataset = with_readings(read_dataset(data))
    print_notes(dataset.notes)
    return dataset


def run(arguments: Sequence[str] | None = None) -> None:
    """Runs `ballfg-bench` with the given arguments, by default the command line's, and exits.

    Raises: SystemExit: always; status 0, 2 on bad input, 130 after Ctrl-C.
    """
    start(app, "ballfg-bench", arguments)
