"""Writes a simulation as files: the dataset, the declared model, and the true states."""

import os
from collections.abc import Iterable, Iterator
from dataclasses import asdict
from pathlib import Path
from typing import Any, Final, Literal

import torch
import yaml

from ballfg.checks import shown
from ballfg.dynamics import save_model
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.model_file import model_to_dict
from ballfg.files.whole_folder import check_replaceable, whole_folder
from ballfg.progress import Watch, unwatched
from ballfg.simulation.config import SimulationConfig
from ballfg.simulation.motion import true_model
from ballfg.simulation.synthetic import SimulatedTrack, dataset_info, simulate
from ballfg.state import STATE_NAMES
from ballfg.tracks import TableWriter, Track, write_dataset
from ballfg.tracks.writing import DATASET_FILES, TRUTH_FILE, TRUTH_FILES

FileFormat = Literal["csv", "parquet"]
MODEL_FILE: Final = "model.yaml"
SIMULATION_FILES: Final = (*DATASET_FILES, *TRUTH_FILES)  # names, or patterns of names, of a simulated dataset's files


def write_simulation(
    folder: str | os.PathLike[str],
    config: SimulationConfig,
    file_format: FileFormat = "csv",
    *,
    force: bool = False,
    watch: Watch = unwatched,
) -> None:
    """Simulates tracks and writes them as a dataset, with their truth.

    The dataset's own files (`dataset.yaml`, `tracks`, `labels.csv`) and `model.yaml` hold the declared content.
    `truth.csv` or `truth.parquet` has the true state at each recorded stamp (`t`; `t_true` is its true time, if stamps
    are off), `truth.yaml` the whole configuration with the undeclared effects.

    Args:
        folder: new or empty; its parent must exist.
        file_format: "csv" or "parquet", for tracks and truth.
        force: replace an existing simulated dataset.
        watch: called with the simulated tracks.
    Raises:
        ValueError: other content in the folder, an unknown format, or effects that do not fit the model.
        FileNotFoundError: the folder's parent does not exist.
    """
    path = Path(folder)
    if file_format not in ("csv", "parquet"):
        raise ValueError(f"format must be 'csv' or 'parquet'; got {shown(file_format)}. Choose one of them.")
    with whole_folder(path, earlier=SIMULATION_FILES) as stage:
        check_replaceable(path, mark=TRUTH_FILE, what="a simulated dataset", force=force)
        with TableWriter(stage / f"truth.{file_format}") as truth:
            tracks = _with_truth(watch(simulate(config), config.tracks, "tracks simulated"), truth, config)
            write_dataset(stage, dataset_info(config), tracks, file_format)
        save_model(config.ball.model, stage / MODEL_FILE)
        text = yaml.safe_dump(truth_content(config), sort_keys=False)
        (stage / TRUTH_FILE).write_text(text, encoding="utf-8")


def truth_content(config: SimulationConfig) -> dict[str, Any]:
    """The content of `truth.yaml`: all settings of the tracks; undeclared effects have values and units."""
    kind, surfaces = config.ball, config.ball.surfaces
    return {
        "seed": config.seed,
        "tracks": config.tracks,
        "rate": config.rate,
        "ball": {"name": kind.name, "radius": kind.ball.radius, "mass": kind.ball.mass},
        "inertia_factor": kind.model.inertia_factor,
        "model": model_to_dict(kind.model),
        "undeclared": {effect.name: _effect_content(effect) for effect in config.undeclared},
        "measurement_noise": asdict(config.noise),
        "process_noise": asdict(config.process),
        "spin_labels": config.spin_labels,
        "settings": {name: list(levels) for name, levels in config.settings.items()},
        "surfaces": {
            "table_height": surfaces.table_height,
            "floor_height": surfaces.floor_height,
            "extent": None if surfaces.extent is None else list(surfaces.extent),
        },
        "launcher": asdict(kind.launcher),
    }


def _stamps_are_off(config: SimulationConfig) -> bool:
    """True if written stamps are not the true times: by jitter, or by a measurement effect such as a wrong clock."""
    times = torch.linspace(0.0, config.ball.launcher.duration, 10, dtype=torch.float64)
    with torch.no_grad():
        written = true_model(config.ball.model, config.undeclared).stamps(times)
    return config.noise.jitter > 0 or not torch.equal(written, times)


def _effect_content(effect: Effect) -> dict[str, Any]:
    units = {c.name: c.unit for c in effect.coefficients}
    return {"kind": effect.kind, "sentence": effect.sentence, "values": effect.values(), "units": units}


def _with_truth(tracks: Iterable[SimulatedTrack], table: TableWriter, config: SimulationConfig) -> Iterator[Track]:
    """The measured tracks; each one's truth is written to the table on its way."""
    with_true_times = _stamps_are_off(config)
    for simulated in tracks:
        columns: dict[str, Any] = {"trajectory": simulated.track.name, "t": simulated.track.times}
        if with_true_times:
            columns["t_true"] = simulated.true_times
        table.write(columns | dict(zip(STATE_NAMES, simulated.true_states.T, strict=True)))
        yield simulated.track
