"""The commands that write, on inputs so small that each takes milliseconds."""

from __future__ import annotations

import csv
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from unittest.mock import patch

import cv2
import numpy as np
import torch
import yaml

import tests.learning.run.falling_ball  # noqa: F401 - registers its kind
from ballfg.cli.main import run
from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.dynamics.networks.architecture import Architecture
from ballfg.dynamics.networks.learned import LearnedModel, build
from ballfg.learning.config.training import OptimizerConfig, TrainConfig
from ballfg.learning.run.run_folder import Checkpoint, RunProgress, read_checkpoint, write_checkpoint
from ballfg.learning.run.training import run_training
from ballfg.learning.sequence.data import LauncherSettings
from ballfg.learning.sequence.predictor import SequenceArchitecture, SequencePredictor
from ballfg.tracks import read_dataset
from ballfg.vision.calibration.table_points import table_points
from ballfg.vision.camera_file import read_cameras, write_cameras
from tests.cli.test_calibrate_cameras import CENTRES, standing
from tests.faults.folders import nothing
from tests.faults.kills import Scenario, succeed
from tests.vision.filming import level

TRACKS = ("--tracks", 2, "--settings", "topspin=1,sidespin=1,speed=9")
OFFERED = "Replace it with --force"


def ballfg(*words: object) -> Callable[[Path], None]:
    """A command; in a word, `@` is the folder in which it works."""

    def work(folder: Path) -> None:
        run([str(word).replace("@", str(folder)) for word in words])

    return work


def prepared(*commands: Callable[[Path], None]) -> Callable[[Path], None]:
    """Several commands, one after the other, each of which must succeed."""

    def prepare(folder: Path) -> None:
        for command in commands:
            succeed(command, folder)

    return prepare


def dataset(name: str) -> Callable[[Path], object]:
    """Reads a dataset to its last track."""
    return lambda folder: list(read_dataset(folder / name))


def file(name: str) -> Callable[[Path], object]:
    """Reads a file."""

    def read(folder: Path) -> bytes:
        if not (folder / name).exists():
            raise FileNotFoundError(name)
        return (folder / name).read_bytes()

    return read


# --- simulate, render, example, import -----------------------------------------------------------------------------

OLD = ballfg("simulate", "--out", "@/shots", *TRACKS, "--seed", 1)
OLD_PARQUET = ballfg("simulate", "--out", "@/shots", *TRACKS, "--seed", 1, "--format", "parquet")
FILMED = ("--shots", 1, "--rate", 20, "--size", "64x48", "--no-distractors")
CAPTURE = "trajectory,t,x,y,z\n" + "".join(
    f"{shot},{0.01 * k:.2f},{0.05 * k:.4f},{0.1 * shot},{1.0 + 0.02 * k - 4.9 * (0.01 * k) ** 2:.6f}\n"
    for shot in range(2)
    for k in range(30)
)


def capture(folder: Path) -> None:
    """A table of two shots as another program writes it."""
    (folder / "capture.csv").write_text(CAPTURE)


IMPORT = (
    "import", "@/capture.csv", "--out", "@/mine", "--length", "m", "--time", "s", "--up", "z", "--ball", "table-tennis",
    "--table-height", 0,
)  # fmt: skip


# --- cameras -------------------------------------------------------------------------------------------------------


RIG = [level("left", -0.7, 2.5, 1.0, 0.5), level("right", 0.8, 2.5, 1.0, 0.5)]


def filmed(folder: Path) -> None:
    """A rig and what it saw of a throw."""
    write_cameras(folder / "cameras.yaml", RIG)
    with (folder / "seen.csv").open("w", newline="") as table:
        writer = csv.writer(table)
        writer.writerow(("t", "camera", "u", "v"))
        for t in np.arange(0.0, 0.3, 0.01):
            place = np.array([[-0.8 + 3.2 * t, 0.1 * t, 0.9 + 1.8 * t - 4.905 * t**2]])
            for one in RIG:
                writer.writerow((t, one.name, *one.project(place)[0]))


def surveyed(folder: Path) -> None:
    """Lenses and the pixels of the table's points."""
    rig = [standing(name) for name in CENTRES]
    write_cameras(folder / "lenses.yaml", rig, posed=False)
    table: dict[str, dict[str, list[float]]] = {}
    for one in rig:
        pixels = {name: one.project(place) for name, place in table_points().items() if one.in_view(place)}
        table[one.name] = {name: pixel.round(2).tolist() for name, pixel in pixels.items()}
    (folder / "table.yaml").write_text(yaml.safe_dump({"sigma": 0.3, "cameras": table}))


def resurveyed(folder: Path) -> None:
    """The pixels are known less well."""
    table = folder / "table.yaml"
    table.write_text(table.read_text().replace("sigma: 0.3", "sigma: 0.6"))


CALIBRATE = ("calibrate-cameras", "--intrinsics", "@/lenses.yaml", "--table", "@/table.yaml", "--out", "@/found.yaml")

# --- models, reports, training -------------------------------------------------------------------------------------


def learned(seed: int) -> LearnedModel:
    """A small network with random weights."""
    torch.manual_seed(seed)
    small = Architecture(kind="mnn+gs", width_flight=4, width_contact=4, depth=1, residual=True)
    return build(small, radius=0.02, base=nominal_model())


def save_learned(seed: int) -> Callable[[Path], None]:
    """Saves a learned model."""
    return lambda folder: save_model(learned(seed), folder / "model.yaml")


def report(found: bool) -> Callable[[Path], None]:
    """Writes one of two diagnoses; the second has a model for each of two rooms."""

    def work(folder: Path) -> None:
        from ballfg.diagnosis.report import report
        from tests.diagnosis.made_diagnosis import silent

        rooms = {"a": nominal_model(), "b": learned(1)} if found else None
        with patch.object(report, "page", return_value="a page"):  # drawing one takes seconds
            report.write_report(silent(), folder / "diagnosis", rooms)

    return work


def read_report(folder: Path) -> object:
    """What `ballfg show` reads of a diagnosis, and its model."""
    from ballfg.pages.given import recognise

    return recognise([folder / "diagnosis"]), load_model(folder / "diagnosis" / "model.yaml")


def checkpoint(epoch: int) -> Callable[[Path], None]:
    """Writes the checkpoint of an epoch."""
    tensors = {"weight": torch.full((3,), float(epoch))}
    progress = RunProgress(epoch=epoch, best_epoch=1, best_rmse=0.1, skipped_in_row=0, train=5, validation=2)
    return lambda folder: write_checkpoint(folder, Checkpoint(progress, tensors, tensors))


def sequence(seed: int) -> Callable[[Path], None]:
    """Writes a sequence model in the place of another."""

    def work(folder: Path) -> None:
        torch.manual_seed(seed)
        architecture = SequenceArchitecture("lstm", 8)
        SequencePredictor(architecture, LauncherSettings(), architecture.empty(0, 5)).save(folder / "model")

    return work


def pass_on(items: Iterable[list[int]], _total: int, _what: str) -> Iterator[list[int]]:
    """A watch that shows nothing."""
    return iter(items)


def train(folder: Path) -> None:
    """A training of two epochs; the one that is there already is continued."""
    optimizer = OptimizerConfig(learning_rate=0.05, batch=4, epochs=2, schedule="constant")
    config = TrainConfig(kind="falling-balls", seed=3, data="plain", optimizer=optimizer)
    run_training(config, folder / "run", resume=(folder / "run" / "config.yaml").exists(), watch=pass_on)


SCENARIOS = (
    Scenario("simulate", nothing, ballfg("simulate", "--out", "@/shots", *TRACKS), dataset("shots"), refused=OFFERED),
    Scenario(
        "simulate-again", prepared(OLD), ballfg("simulate", "--out", "@/shots", *TRACKS, "--force"), dataset("shots")
    ),
    Scenario(
        "simulate-csv-over-parquet",
        prepared(OLD_PARQUET),
        ballfg("simulate", "--out", "@/shots", *TRACKS, "--force"),
        dataset("shots"),
    ),
    Scenario(
        "simulate-parquet-over-csv",
        prepared(OLD),
        ballfg("simulate", "--out", "@/shots", *TRACKS, "--force", "--format", "parquet"),
        dataset("shots"),
    ),
    Scenario(
        "estimate",
        prepared(OLD),
        ballfg("estimate", "@/shots", "--out", "@/states.csv", "--jobs", 1),
        file("states.csv"),
    ),
    Scenario(
        "predict",
        prepared(OLD),
        ballfg("predict", "@/shots", "--observe", 0.3, "--out", "@/paths.parquet", "--jobs", 1),
        file("paths.parquet"),
    ),
    Scenario("import", prepared(capture), ballfg(*IMPORT), dataset("mine"), refused=OFFERED),
    Scenario(
        "import-again",
        prepared(capture, ballfg(*IMPORT, "--format", "parquet")),
        ballfg(*IMPORT, "--force"),
        dataset("mine"),
    ),
    Scenario(
        "example",
        nothing,
        ballfg("example", "--out", "@/example", "--tracks", 6),
        dataset("example/windy"),
        refused=OFFERED,
    ),
    Scenario(
        "example-again",
        prepared(ballfg("example", "--out", "@/example", "--tracks", 6, "--seed", 5)),
        ballfg("example", "--out", "@/example", "--tracks", 6, "--force"),
        dataset("example/windy"),
    ),
    Scenario(
        "render", nothing, ballfg("render", "--out", "@/scene", *FILMED), file("scene/scene.yaml"), refused=OFFERED
    ),
    Scenario(
        "render-again",
        prepared(ballfg("render", "--out", "@/scene", *FILMED, "--images")),
        ballfg("render", "--out", "@/scene", *FILMED, "--seed", 4, "--force"),
        lambda folder: read_cameras(folder / "scene" / "cameras.yaml"),
    ),
    Scenario(
        "track",
        prepared(filmed),
        ballfg("track", "@/seen.csv", "--cameras", "@/cameras.yaml", "--out", "@/tracked"),
        dataset("tracked"),
        refused=OFFERED,
    ),
    Scenario(
        "track-again",
        prepared(
            filmed,
            ballfg("track", "@/seen.csv", "--cameras", "@/cameras.yaml", "--out", "@/tracked", "--ball", "tennis"),
        ),
        ballfg("track", "@/seen.csv", "--cameras", "@/cameras.yaml", "--out", "@/tracked", "--force"),
        dataset("tracked"),
    ),
    Scenario(
        "calibrate-cameras",
        prepared(surveyed, ballfg(*CALIBRATE), resurveyed),
        ballfg(*CALIBRATE),
        lambda folder: read_cameras(folder / "found.yaml"),
        companions=("found_calibration.json", "found_calibration.png"),
    ),
    Scenario("learned-model", save_learned(1), save_learned(2), lambda folder: load_model(folder / "model.yaml")),
    Scenario("report", report(found=True), report(found=False), read_report),
    Scenario("checkpoint", checkpoint(1), checkpoint(2), read_checkpoint),
    Scenario("sequence-model", sequence(1), sequence(2), lambda folder: SequencePredictor.load(folder / "model")),
    Scenario(
        "train",
        nothing,
        train,
        lambda folder: read_checkpoint(folder / "run"),
        steps=True,
        varying=("run/metrics.csv", "run/training.html", "run/curves.png"),
    ),
)


def warm_up() -> None:
    """One thread, and no compilation or import that every copy of this process would do again."""
    torch.set_num_threads(1)
    cv2.setNumThreads(1)
