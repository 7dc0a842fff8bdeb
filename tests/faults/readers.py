"""Every reader of ballfg by name, as the commands call it: each reads a folder of `tests.faults.seeds`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from ballfg.benchmarks.diagnosis.record import Record as Case
from ballfg.benchmarks.dynamics.contenders import Record as Contender
from ballfg.benchmarks.speed.stopwatch import SlowerError, check_ratios
from ballfg.diagnosis.design.goal import reported_pairs
from ballfg.dynamics import load_model
from ballfg.estimation.conformal import load_conformal
from ballfg.estimation.observations.sighted_dataset import read_sighted
from ballfg.estimation.reading import with_readings
from ballfg.importing import Choices
from ballfg.importing.proposal import propose
from ballfg.learning.calibration.report import compare
from ballfg.learning.calibration.run import read_checkpoint as read_steps
from ballfg.learning.config.config_file import read_config
from ballfg.learning.run.run_folder import read_checkpoint, read_metrics
from ballfg.learning.sequence.predictor import SequencePredictor
from ballfg.live.sources.sender import Sender
from ballfg.pages.given import recognise
from ballfg.pages.show_page import show_page
from ballfg.pages.shown import collect
from ballfg.simulation.balls import ball_kind
from ballfg.simulation.scene.recording import earlier_files
from ballfg.tracks import read_dataset
from ballfg.vision import open_video, read_cameras
from ballfg.vision.calibration.table_points import read_table
from ballfg.vision.detection.detections import read_detections
from ballfg.vision.detection.video import read_stamps
from tests.estimation.observations.sighted_rig import RIG
from tests.faults.seeds_of_models import posed, timed_rows

Read = Callable[[Path, Path], object]
"""Reads a folder in which one file, the second argument, was damaged."""


@dataclass(frozen=True)
class Reader:
    """A reader.

    Attributes:
        name: of the folder of its files.
        read: all that a command would read of it.
        names_file: whether its messages have to name the file; lines of a stream have none.
    """

    name: str
    read: Read
    names_file: bool = True


def _dataset(folder: Path, file: Path) -> object:
    return list(with_readings(read_dataset(folder)))


def _report(folder: Path, file: Path) -> object:
    return show_page(collect(recognise([folder]))), reported_pairs(folder)


def _checkpoint(folder: Path, file: Path) -> object:
    return read_metrics(file) if file.suffix == ".csv" else read_checkpoint(folder)


def _cameras(folder: Path, file: Path) -> object:
    return [camera.project((1.0, 0.0, 0.9)) for camera in read_cameras(file)]


def _detections(folder: Path, file: Path) -> object:
    return read_stamps(file) if file.stem == "stamps" else read_detections(file, RIG)


def _live(folder: Path, file: Path) -> object:
    """A line that cannot be used is reported, never raised."""
    sender, arrivals = Sender(), []
    sender.waiting.extend((line.read, line.content) for line in sender.cut(file.read_bytes(), last=True))
    while sender.busy:
        arrivals += sender.take()
    wrong = [one.problem for one in arrivals if one.sample is None and not (one.problem and one.problem.isprintable())]
    if wrong:
        raise RuntimeError(f"a problem must be one line: {wrong[0]!r}")
    return arrivals


def _video(folder: Path, file: Path) -> object:
    video = (
        open_video(folder / "images", folder / "stamps.csv")
        if file.suffix not in (".mp4", ".avi")
        else open_video(file)
    )
    return video.sample(3), list(video.frames())


def _record(folder: Path, file: Path) -> object:
    if file.name == "results.json":
        try:
            return check_ratios(timed_rows(), file)
        except SlowerError as answer:
            return answer
    read = {"case": Case, "contender": Contender}[file.stem].read
    return read(file, "d")


def _steps(folder: Path, file: Path) -> object:
    """Steps from which the calibration could go on, and end."""
    problem = posed()
    steps, _ = read_steps(folder, problem)
    return [compare(step.scores, step.scores, step.scores, step.scores) for step in steps]


def _import(folder: Path, file: Path) -> object:
    return propose(folder / file.relative_to(folder).parts[0], Choices())


READERS = {
    reader.name: reader
    for reader in (
        Reader("dataset", _dataset),
        Reader("parquet_dataset", _dataset),
        Reader("sighted", lambda folder, file: list(read_sighted(folder))),
        Reader("model", lambda folder, file: load_model(folder / "model.yaml")),
        Reader("learned", lambda folder, file: load_model(folder / "model.yaml")),
        Reader("training", lambda folder, file: read_config(file)),
        Reader("calibration", lambda folder, file: read_config(file)),
        Reader("conformal", lambda folder, file: load_conformal(file)),
        Reader("ball", lambda folder, file: ball_kind(str(file))),
        Reader("table", lambda folder, file: read_table(file)),
        Reader("results", lambda folder, file: show_page(collect(recognise([file])))),
        Reader("report", _report),
        Reader("checkpoint", _checkpoint),
        Reader("sequence", lambda folder, file: SequencePredictor.load(folder)),
        Reader("cameras", _cameras),
        Reader("detections", _detections),
        Reader("live", _live, names_file=False),
        Reader("video", _video),
        Reader("noise", lambda folder, file: load_model(file)),
        Reader("steps", _steps),
        Reader("records", _record),
        Reader("scene", lambda folder, file: earlier_files(file)),
    )
}
IMPORT = Reader("import", _import)
"""Of every folder `import_...`; there is one file or folder in each."""


def reader_of(name: str) -> Reader:
    """The reader of a folder of seeds."""
    return IMPORT if name.startswith("import_") else READERS[name]
