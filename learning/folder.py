"""The folder of a run: its config, versions, checkpoint and results. No file appears before it is whole."""

from __future__ import annotations

import json
import os
import platform
from collections.abc import Sequence
from importlib import metadata
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError

from ballfg.dynamics import model_to_dict
from ballfg.learning.calibrate import Problem, Step
from ballfg.learning.config import FREE_TO_CHANGE, CalibrationConfig, read_config

CONFIG, VERSIONS, CHECKPOINT = "config.yaml", "versions.json", "checkpoint.json"
MODEL, REPORT, PICTURE = "model.yaml", "report.json", "calibration.png"
FILES = (CONFIG, VERSIONS, CHECKPOINT, MODEL, REPORT, PICTURE)
PACKAGES = ("ballfg", "gtsam", "torch", "numpy", "scipy")


class Checkpoint(BaseModel):
    """All that a run needs to continue to the same numbers."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    data: str
    """Digest of the dataset's content."""
    model: dict[str, Any]
    """Content of the model file that the run started from."""
    steps: tuple[Step, ...]
    """Done so far."""


def check_new(folder: Path) -> None:
    """Refuse a folder in which something would be lost. Raises: ValueError: a file, or a folder with an earlier run."""
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out must be a folder; {folder} is a file. Choose another name.")
    there = [name for name in FILES if (folder / name).exists()]
    if there:
        raise ValueError(
            f"out must not hold an earlier run; {folder} has {there[0]}. Choose another folder, or continue that run "
            f"with --resume {folder}."
        )


def check_resumable(folder: Path, config: CalibrationConfig) -> None:
    """Refuse to continue a run under another config.

    Raises: FileNotFoundError: no run in the folder. ValueError: a field differs that would change the numbers.
    """
    if not (folder / CONFIG).is_file():
        raise FileNotFoundError(f"--resume needs the folder of an earlier run; {folder} has no {CONFIG}.")
    earlier = read_config(folder / CONFIG)
    for name in CalibrationConfig.model_fields:
        old, new = getattr(earlier, name), getattr(config, name)
        if name not in FREE_TO_CHANGE and old != new:
            raise ValueError(
                f"a resumed run must keep its config; '{name}' was {old!r} and is {new!r}. "
                f"Give {folder / CONFIG} as the config, or start a new run."
            )


def start(folder: Path, config: CalibrationConfig) -> None:
    """Make the folder and write the resolved config and the versions, before the first step."""
    folder.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_text(folder / CONFIG, text)
    versions = {"python": platform.python_version()} | {name: metadata.version(name) for name in PACKAGES}
    write_json(folder / VERSIONS, versions)


def write_checkpoint(folder: Path, problem: Problem, steps: Sequence[Step]) -> None:
    """Replace the checkpoint by one with these steps."""
    checkpoint = Checkpoint(data=problem.split.digest, model=model_to_dict(problem.model), steps=tuple(steps))
    write_json(folder / CHECKPOINT, checkpoint.model_dump(mode="json"))


def read_checkpoint(folder: Path, problem: Problem) -> list[Step]:
    """The steps of an earlier run; none if it stopped before the first.

    Raises: ValueError: a damaged checkpoint, or one of another dataset, another model.
    """
    path = folder / CHECKPOINT
    if not path.is_file():
        return []
    try:
        checkpoint = Checkpoint.model_validate_json(path.read_bytes())
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{path}: not a checkpoint ({first['msg']}). Start a new run.") from None
    if checkpoint.data != problem.split.digest:
        raise ValueError(f"{path}: was made from another dataset than {problem.dataset.path}. Give the same --data.")
    if checkpoint.model != model_to_dict(problem.model):
        raise ValueError(f"{path}: was started from another model. Give the same model.")
    return list(checkpoint.steps)


def write_json(path: Path, content: Any) -> None:
    """Write JSON; floats read back bit for bit."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file; the final name appears only once the file is whole."""
    part = path.with_name(f".{path.name}.part")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)
