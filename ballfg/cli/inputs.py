"""Opens the dataset, model and estimator that a command line names, for estimate and predict."""

import math
import sys
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Generic, Literal, TypeVar

import typer

from ballfg.machine import usable_cores
from ballfg.progress import print_doubts, print_notes, progress

if TYPE_CHECKING:
    from ballfg.dynamics import BallModel
    from ballfg.dynamics.surfaces import Surfaces
    from ballfg.estimation import Estimator, Settings
    from ballfg.estimation.observations.sighted_dataset import SightedDataset
    from ballfg.estimation.settings import Solver
    from ballfg.tracks import Ball, Dataset


def check_dataset(folder: Path) -> Path:
    """Refuses a mistyped path at once: before the import of torch and GTSAM, which takes seconds."""
    if not folder.is_dir():
        from ballfg.tracks import read_dataset

        read_dataset(folder)  # raises: there is no such folder
    return folder


DatasetFolder = Annotated[
    Path, typer.Argument(help="Folder with dataset.yaml and tracks.csv or tracks.parquet.", callback=check_dataset)
]
DatasetFolders = Annotated[
    list[Path],
    typer.Argument(
        help="Folder with dataset.yaml and tracks.csv or tracks.parquet; further ones of the same ball in other rooms.",
        callback=lambda folders: [check_dataset(folder) for folder in folders],
    ),
]
EffectsFiles = Annotated[
    list[Path] | None,
    typer.Option("--effects-file", help="Trusted Python file that defines custom effects; may be repeated."),
]
ObservationsFiles = Annotated[
    list[Path] | None,
    typer.Option("--observations-file", help="Trusted Python file that defines custom observations; may be repeated."),
]
MethodName = Annotated[
    str,
    typer.Option(
        "--method",
        help="Estimator: smoother, online, ekf, sliding-window, or one that an installed package registers.",
    ),
]


SolverName = Annotated[
    Literal["ballfg", "gtsam"] | None,
    typer.Option("--solver", help="Solver of the factor graph.", show_default="gtsam for online, else ballfg"),
]
GroupName = Annotated[
    str | None,
    typer.Option(
        "--group",
        help="Group of the model, such as a launcher or a player, of tracks whose labels name none.",
        show_default="the mixture of all groups",
    ),
]
ModelFile = Annotated[
    Path | None, typer.Option("--model", help="Model file; by default the nominal model of the ball.")
]
BallName = Annotated[
    str | None,
    typer.Option("--ball", help="Known ball, or a ball file (YAML); by default the one that the dataset states."),
]
"""The option of commands that read a dataset. It must agree with the dataset's own ball."""
CORES = usable_cores()
Jobs = Annotated[int, typer.Option("--jobs", min=1, help="Number of processes.", show_default="one per core")]
Cluster = Annotated[
    str | None, typer.Option("--cluster", help="Compute on a cluster in place of processes: dask or ray.")
]
Address = Annotated[
    str | None,
    typer.Option("--address", help="Address of the cluster: of dask's scheduler, such as tcp://10.0.0.1:8786."),
]
Anyway = Annotated[
    bool, typer.Option("--anyway", help="Also if less than half of the samples fall like a ball: use the flights.")
]
OutTable = Annotated[Path, typer.Option("--out", help="Output table, .csv or .parquet.")]
Seed = Annotated[int, typer.Option("--seed", help="Random seed.")]
DATASET_TABLES = ("tracks", "labels", "detections", "truth")
"""Names, without their endings, of the tables in a dataset's folder."""


SourceName = Annotated[
    Literal["positions", "detections"] | None,
    typer.Option(
        "--from",
        help="Input: positions of tracks, or camera detections (detections.csv with cameras.yaml).",
        show_default="positions where there is a table of tracks",
    ),
]
D = TypeVar("D", bound="Dataset | SightedDataset")


@dataclass(frozen=True)
class Inputs(Generic[D]):
    """A dataset, of positions or of sightings, with model and surfaces, and the doubts that were printed."""

    dataset: D
    model: "BallModel"
    surfaces: "Surfaces"
    observed: float  # s from the start of each track that a noise estimate may use
    doubts: tuple[str, ...] = ()

    def in_flight(self, anyway: bool) -> "Inputs[D]":
        """The same of flights alone, after what is said about the rest; sightings stay as they are.

        Args: anyway: True for a dataset that hardly holds any flight.
        Raises: ValueError: for such a dataset otherwise.
        """
        from ballfg.tracks import Dataset

        if not isinstance(self.dataset, Dataset):
            return self
        found = flights_only(self.dataset, anyway)
        return replace(self, dataset=found.dataset, doubts=(*self.doubts, *found.lines))

    def changing(self) -> "Inputs[D]":
        """The same with the model itself, for work that changes it."""
        from ballfg.dynamics.compiled.kept_model import whole

        return replace(self, model=whole(self.model))

    def estimator(self, method: str, solver: "Solver | None" = None, group: str | None = None) -> "Estimator":
        """The estimator of a name, with the noise of the dataset.

        Args:
            method: its name.  solver: of its factor graph; None: the usual one.
            group: of tracks whose labels name none; None: unknown.
        Raises: ValueError: if there is no such estimator or group, or the solver cannot solve it.
        """
        from ballfg.estimation import Settings
        from ballfg.estimation.configure import fitted_settings, usual_noise
        from ballfg.estimation.registry import make_estimator

        # both refuse before any long work
        make_estimator(method, self.model, self.surfaces, Settings(solver=solver))
        Settings(spins=self.model.spins, group=group)
        print_doubts(usual_noise(self.dataset, self.model))
        settings = fitted_settings(self.dataset, self.model, self.observed, progress)
        spins = self.model.spins
        if group is not None:
            settings = replace(settings, spins=spins, group=group)
        elif spins is not None and settings.group is None and spins.by not in self.dataset.label_names:
            print_notes([f"no track names its group ({spins.by}): all get {spins.of_others}. --group NAME gives one"])
        return make_estimator(method, self.model, self.surfaces, replace(settings, solver=solver))


def flights_only(data: "Dataset", anyway: bool) -> Any:
    """What flies in a dataset (`InFlight`), after what is said about the rest; errors as of `Inputs.in_flight`."""
    from ballfg.estimation.flights.dataset import in_flight

    found = in_flight(data)
    print_doubts(found.lines)
    found.check(data.path, anyway)
    return found


def filtered(data: "Dataset | SightedDataset") -> tuple[str, ...]:
    """Sentences on a filter that smoothed the positions of a dataset, and on samples of other balls."""
    from ballfg.estimation.configure import TRACKS_FOR_TABLE
    from ballfg.estimation.flights.dataset import in_flight
    from ballfg.tracks import Dataset

    return in_flight(data, TRACKS_FOR_TABLE).filtered if isinstance(data, Dataset) else ()


def know(effects: Iterable[Path] | None = None, observations: Iterable[Path] | None = None) -> None:
    """Registers the classes in files: effects for model files and options, observations for tables of datasets."""
    for file in effects or ():
        from ballfg.dynamics import load_effects

        load_effects(file)
    for file in observations or ():
        from ballfg.estimation.observations.registry import load_observations

        load_observations(file)


def open_inputs(
    dataset: Path,
    model: Path | None,
    effects_files: Iterable[Path] | None = None,
    observed: float = math.inf,
    ball: str | None = None,
) -> "Inputs[Dataset]":
    """Opens and checks everything before any work; repairs are reported on stderr.

    Args:
        observed: s from the start of each track that a noise estimate may use.
        ball: name of the dataset's known ball; None: any ball.
    """
    from ballfg.estimation import dataset_surfaces
    from ballfg.estimation.batch import start_early
    from ballfg.estimation.reading import with_readings
    from ballfg.parallel.parts import jobs_here
    from ballfg.tracks import read_dataset

    know(effects_files)
    data = with_readings(read_dataset(dataset))
    found, doubts = _opened(data, model, ball)
    start_early(len(data), jobs_here())
    return Inputs(data, found, dataset_surfaces(data), observed, doubts)


def open_source(
    source: str | None,
    dataset: Path,
    model: Path | None,
    effects_files: Iterable[Path] | None = None,
    observed: float = math.inf,
    ball: str | None = None,
) -> Inputs[Any]:
    """`open_inputs`, also for the sightings of a dataset."""
    if not is_sighted(source, dataset):
        return open_inputs(dataset, model, effects_files, observed, ball)
    from ballfg.estimation import dataset_surfaces, read_sighted

    know(effects_files)
    data = read_sighted(dataset)
    return Inputs(data, open_model(data, model, ball), dataset_surfaces(data), math.inf)


def is_sighted(source: str | None, dataset: Path) -> bool:
    """True for detections; without a source, where there is no table of positions but one of detections."""
    from ballfg.estimation.reading import has_positions

    return not has_positions(dataset) if source is None else source == "detections"


def open_model(data: "Dataset | SightedDataset", model: Path | None, ball: str | None = None) -> "BallModel":
    """The model of a file, or the nominal one; prints notes on data and model on stderr.

    Args: ball: name of the data's known ball, or a ball file, whose model is then the nominal one; None: any ball.
    Raises: ValueError: if that name is unknown, or the data's radius and mass differ from that ball's.
    """
    return _opened(data, model, ball)[0]


def _opened(
    data: "Dataset | SightedDataset", model: Path | None, ball: str | None
) -> "tuple[BallModel, tuple[str, ...]]":
    """The same, with the doubts that were printed."""
    from ballfg.deferred import on_one_thread
    from ballfg.dynamics.compiled.kept_model import ready_file
    from ballfg.dynamics.nominal import TOLERANCE, inertia_factor, mismatch, nominal_note, ready_nominal
    from ballfg.estimation.configure import table_note
    from ballfg.estimation.reading import unused_model
    from ballfg.tracks import Dataset

    file, own = ball is not None and Path(ball).is_file(), data.ball
    named, usual = (own, None) if ball is None else _named(ball)
    if mismatch(own, named) > TOLERANCE:
        raise ValueError(
            f"--ball {ball} has a radius of {named.radius:g} m and {named.mass:g} kg; {data.path} states "
            f"{own.radius:g} m and {own.mass:g} kg. Leave --ball out, or correct ball in dataset.yaml."
        )
    on_one_thread()
    found: BallModel = usual if file and usual is not None else ready_nominal(own)
    if model is not None:
        inertia = inertia_factor(data.ball)
        found = ready_file(model, radius=data.ball.radius, inertia_factor=inertia, room=data.info.name)
    doubts = _doubts_of(data, found, model)
    print_doubts(doubts)
    notes = [*data.notes, *filter(None, [table_note(data)])]
    if found.spins is not None and isinstance(data, Dataset):
        notes += found.spins.unknown(map(data.labels_of, data.names))
    if model is None and not file:
        notes += [note for note in (nominal_note(data.ball), *unused_model(data.path, data.ball)) if note]
    print_notes(notes)
    return found, doubts


def _named(ball: str) -> "tuple[Ball, BallModel]":
    """A ball and its model: a known one by its name, or that of a ball file."""
    from ballfg.dynamics.nominal import ready_nominal

    if Path(ball).is_file():
        from ballfg.simulation.balls import ball_kind

        kind = ball_kind(ball)
        return kind.ball, kind.model
    from ballfg.dynamics.known_balls import KNOWN_BALLS, known_ball

    known = KNOWN_BALLS[known_ball(ball)].ball
    return known, ready_nominal(known)


def _doubts_of(data: "Dataset | SightedDataset", model: "BallModel", file: Path | None) -> tuple[str, ...]:
    """What is not sure about a dataset, and how far it lies outside of what a model was fitted on."""
    from ballfg.estimation.flights.dataset import LOOKED_AT

    doubts = data.info.doubts
    if (own := model.learned_from) is not None:
        doubts += (f"{file} learned from a ball with a radius of {own:g} m; this one has {model.radius:g} m",)
    if model.domain is None or data.rough:
        return doubts
    return (*doubts, *model.domain.doubts(islice(iter(data), LOOKED_AT), file))


def model_alone(model: Path | None, ball: str | None) -> "tuple[BallModel, Settings]":
    """A model without a dataset, and its settings: of a file, else the nominal one.

    Args: ball: name of the known ball that gives radius and inertia, or a ball file; None: table tennis.
    """
    from ballfg.dynamics.compiled.kept_model import ready_file
    from ballfg.estimation import Settings

    loaded = known = _named(ball or "table_tennis")[1]
    if model is not None:
        loaded = ready_file(model, radius=None if ball is None else known.radius, inertia_factor=known.inertia_factor)
    settings = Settings.for_measured(loaded)
    if loaded.trained is not None:
        from ballfg.estimation.configure import learned_process

        settings = Settings(position_scale=loaded.trained.position_scale, process=learned_process(loaded.trained))
    if loaded.noise is None:
        return loaded, settings
    from ballfg.estimation.noise.parameters import with_noise

    return loaded, with_noise(settings, loaded.noise)


def check_out(out: Path, dataset: Path) -> None:
    """Refuses a result in the place of measurements.

    Raises: ValueError: if `out` is, or leads to, a table of this dataset or of another one, that of an observation too.
    """
    from ballfg.estimation.observations.registry import OBSERVATIONS
    from ballfg.tracks.info import INFO_FILE

    place = out.resolve()
    tables = {*DATASET_TABLES, *(Path(kind.file).stem for kind in OBSERVATIONS.values() if kind.file is not None)}
    own = place.parent == dataset.resolve()
    if place.stem in tables and (own or (place.parent / INFO_FILE).is_file()):
        whose = "the dataset itself" if own else "a dataset"
        raise ValueError(f"out must not be a table of {whose}; got {out}. Choose another name.")


def check_model_out(out: Path) -> None:
    """Refuses a model in the place of another file. Raises: ValueError: not .yaml, or a file that holds no model."""
    from ballfg.dynamics.model_file import SECTIONS
    from ballfg.files.strict_yaml import read_mapping

    if out.suffix not in (".yaml", ".yml"):
        raise ValueError(f"out must be a model file; got {out}. Let its name end in .yaml.")
    if out.exists() and not set(read_mapping(out)) <= set(SECTIONS):
        raise ValueError(f"out must be a model file; {out} holds something else. Choose another name.")


@contextmanager
def workers(cluster: str | None, address: str | None, jobs: int) -> Iterator[int]:
    """Runs the block's work on a cluster, or in `jobs` processes of this machine.

    Returns: the number of processes.
    Raises: ValueError, ConnectionError: as `ballfg.parallel.on_cluster`.
    """
    from ballfg.parallel.parts import using

    if cluster is None and address is None:
        with using(jobs):
            yield jobs
        return
    from ballfg.parallel import on_cluster

    with on_cluster(cluster, address) as found:
        print(f"{cluster} cluster: {found} workers", file=sys.stderr)
        yield max(2, found or 0)  # several processes, even for one worker beside this one
