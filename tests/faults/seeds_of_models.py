"""Good files of models, of trainings and of benchmarks."""

from __future__ import annotations

import json
import tempfile
from functools import cache
from pathlib import Path

import numpy as np
import torch
from safetensors.torch import save_file

from ballfg.benchmarks.diagnosis.record import Found, Ranked, Record as CaseRecord
from ballfg.benchmarks.dynamics.contenders import Fan, Record as ContenderRecord
from ballfg.benchmarks.dynamics.task import PathScore
from ballfg.benchmarks.results import Row
from ballfg.dynamics import Architecture, build, nominal_model, save_model
from ballfg.dynamics.networks.fading import Fading
from ballfg.dynamics.networks.spin_embedding import SpinEmbedding
from ballfg.dynamics.trained import Trained
from ballfg.learning.calibration.problem import Problem, Step, TrackFit, pose
from ballfg.learning.calibration.run import write_checkpoint as write_steps
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import TrackScore
from ballfg.learning.run.run_folder import Epoch, write_checkpoint, write_metrics
from ballfg.simulation import SimulationConfig
from ballfg.simulation.writing import write_simulation
from ballfg.tracks import read_dataset
from ballfg.tracks.noise import TrackNoise
from tests.learning.run.test_checkpoint import made as made_checkpoint


def write_model(folder: Path) -> None:
    (folder / "model.yaml").write_text(
        "flight:\n  gravity: {g: 9.81}\n  drag: {k: 0.13}\n  magnus: {k: 0.003}\n"
        "bounce:\n  restitution: {e: 0.92}\n  friction: {mu: 0.25}\nmeasurement: {}\nlearned: null\n"
        "variations:\n  flight.drag.k: {by: group, values: {topspin: 0.148, no_spin: 0.110}}\n"
        "  bounce.restitution.e: {by: track, values: {'001': 0.93, '025': 0.88}, line: true}\n"
    )


def write_noise(folder: Path) -> None:
    noise = TrackNoise(
        (0.003, 0.004, 0.005), (0.001, 0.0, 0.002), 0.02, 0.0, 10.0, 200.0, 0.5, 0.1, 0.0, 10.0, {"flight.drag.k": 0.01}
    )
    model = nominal_model()
    model.noise = noise
    save_model(model, folder / "model.yaml")


def write_learned(folder: Path) -> None:
    network = build(
        Architecture.of("mnn+gs", width_flight=6, width_contact=6, residual=True), radius=0.02, base=nominal_model()
    )
    network.fading = Fading.empty(4, 3, 0.02)
    network.trained = Trained(
        {"velocity": 0.2, "spin": 1.0}, 0.5, SpinEmbedding(("topspin", "side"), {"side": ("l", "r")})
    )
    save_model(network, folder / "model.yaml")


def write_training(folder: Path) -> None:
    (folder / "train.yaml").write_text(
        "kind: mnn+gs\ndata: [shots]\nseed: 3\nobserve: {seconds: 0.25}\noptimizer: {epochs: 3}\n"
        "architecture: {width_flight: 8, residual: true}\n"
    )


def write_calibration_config(folder: Path) -> None:
    (folder / "calibrate.yaml").write_text("kind: calibrate\ndata: shots\nseed: 3\n")


def write_conformal(folder: Path) -> None:
    from ballfg.estimation.conformal import ConformalScales

    table = np.full((3, 3), 1.1)
    ConformalScales("shots", 0.4, "smoother", np.array([12, 11, 10]), table, table, table, {"converged": 12}).save(
        folder / "scales.yaml"
    )


def write_ball(folder: Path) -> None:
    (folder / "squash.yaml").write_text(
        "name: squash\nradius: 0.02\nmass: 0.024\ninertia_factor: 0.6667\nsurface: court\n"
        "flight: {gravity: {}, drag: {k: 0.016}}\nbounce: {restitution: {e: 0.4}, friction: {mu: 0.5}}\n"
        "launcher: {duration: 1.0, speed_slow: 10, speed_fast: 25}\n"
    )


def write_checkpoint_folder(folder: Path) -> None:
    write_checkpoint(folder, made_checkpoint(2))
    epochs = [Epoch(k, 1.0, 0.1, None, 1e-3, 2.0, 0, 0, 0, 1.5) for k in range(3)]
    write_metrics(folder / "metrics.csv", epochs)


def write_calibration_steps(folder: Path) -> None:
    """The checkpoint of a calibration, whose problem the reader poses too."""
    problem = posed()
    size, scores = len(problem.chosen.names), [None] * len(problem.split.judge)
    judged = {"rmse": 0.02, "covered": 0.9, "prediction_nis": 3.1, "log_score": 2.0, "nis": 3.0}
    scores[0] = TrackScore(name=problem.split.judge[0], samples=9, **judged)
    first, *others = problem.split.fit
    row = (0.1,) * size
    steps = [
        Step(number=0, mean=row, scores=tuple(scores)),
        Step(
            number=1, mean=row, sigma=row, spread=row, next_track=row, moved=2.5, skipped=((first, "failed"),),
            fits=tuple(TrackFit(name=name, values=row, sigmas=row) for name in others), scores=tuple(scores),
        ),
    ]  # fmt: skip
    write_steps(folder, problem, steps)


@cache
def posed() -> Problem:
    """A small calibration: simulated tracks, the same each time."""
    with tempfile.TemporaryDirectory() as folder:
        write_simulation(Path(folder) / "shots", SimulationConfig(6, rate=60.0, seed=5))
        return pose(read_dataset(Path(folder) / "shots"), nominal_model(), CalibrationConfig())


def write_sequence(folder: Path) -> None:
    from ballfg.learning.sequence.predictor import SequenceArchitecture

    model = SequenceArchitecture("lstm", 8).empty(0, 5)
    (folder / "config.yaml").write_text("kind: lstm\nwidth: 8\npoints: 5\nlabels: []\ncategories: {}\n")
    save_file(
        {name: torch.zeros_like(value) for name, value in model.state_dict().items()}, folder / "weights.safetensors"
    )


def write_records(folder: Path) -> None:
    """Finished parts of benchmarks; their digests are "d"."""
    contender_record().save(folder / "contender.json")
    CaseRecord(
        "d", "explained", (Found("flight.wind", ("a",), 1e-9, 40.0, {"x": (1.0, 0.1), "y": (0.5, None)}),),
        ((Ranked("flight.wind", 0.5, 1e-9, 40.0, "taken"), Ranked("b", 0.1, 0.2, None, "left")),),
        {"before": 20.0, "after": 4.0}, {"stamps": 0.4}, 40, 20, 12.5,
    ).save(folder / "case.json")  # fmt: skip
    (folder / "results.json").write_text(json.dumps({"rows": [vars(row) for row in timed_rows()]}))


def contender_record() -> ContenderRecord:
    """A finished contender."""
    fan = Fan({0: [(0.0, 0.0, 0.0)] * 3, 10: [(1.0, 1.0, 1.0)] * 3}, {-5: [(1.0, 1.0, 1.0)] * 2})
    score = PathScore((0.5, 10), (None, 0), (0.1, None, 0.2), (True, False, True))
    return ContenderRecord("d", "mnn", 1, 500, 12.5, 0.002, 1, (score, score), fan)


def timed_rows() -> list[Row]:
    """Times beside a control."""
    return [
        Row("fair", "smoother", "update_time", "ms", 0.5, None, None, 20),
        Row("fair", "control", "banded_time", "ms", 2.0, 1.9, 2.1, 20),
    ]


def write_report(folder: Path) -> None:
    """The numbers alone: no reader looks at the page, and to draw it takes seconds."""
    from ballfg.diagnosis.report.report import MODEL, PAGE, PROGRAM, REPORT, content
    from tests.diagnosis.made_diagnosis import found

    whole = content(found()) | {"program": PROGRAM, "files": sorted((MODEL, PAGE, REPORT))}
    (folder / REPORT).write_text(json.dumps(whole), encoding="utf-8")
