"""All steps of a calibration so far, in one JSON file: what it needs to continue to the same numbers."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from pydantic import BaseModel, ConfigDict, ValidationError

from ballfg.dynamics import model_to_dict
from ballfg.learning.calibration.calibrate import Problem, Step
from ballfg.learning.run.run_folder import STEPS, write_json


class Checkpoint(BaseModel):
    """All that a run needs to continue to the same numbers."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    data: str
    """Digest of the dataset's content."""
    model: dict[str, Any]
    """Content of the model file that the run started from."""
    steps: tuple[Step, ...]
    """Done so far."""


def write_checkpoint(folder: Path, problem: Problem, steps: Sequence[Step]) -> None:
    """Replace the checkpoint by one with these steps."""
    checkpoint = Checkpoint(data=problem.split.digest, model=model_to_dict(problem.model), steps=tuple(steps))
    write_json(folder / STEPS, checkpoint.model_dump(mode="json"))


def read_checkpoint(folder: Path, problem: Problem) -> list[Step]:
    """The steps of an earlier run; none if it stopped before the first.

    Raises: ValueError: a damaged checkpoint, or one of another dataset, another model.
    """
    path = folder / STEPS
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
