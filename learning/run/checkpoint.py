"""All that a training needs to continue to the same numbers: a folder of tensors and YAML, replaced as a whole."""

from __future__ import annotations

import os
import shutil
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import yaml
from pydantic import BaseModel, ConfigDict, ValidationError
from safetensors import SafetensorError
from safetensors.torch import load_file, save_file
from torch import Tensor

NAME = "checkpoint"
STATE = "state.yaml"
TENSORS = ("weights", "optimizer", "memory", "best")
"""One file `<name>.safetensors` each."""


class RunProgress(BaseModel):
    """How far a run is, in plain numbers."""

    model_config = ConfigDict(strict=True, frozen=True, extra="forbid")

    epoch: int
    """Epochs done."""
    best_epoch: int
    """The epoch with the best weights."""
    best_rmse: float | None
    """m, their RMSE on the validation tracks; null: none was judged."""
    skipped_in_row: int
    """Steps that were skipped in a row up to now."""
    train: int
    """Number of training tracks."""
    validation: int
    """Number of validation tracks."""


@dataclass(frozen=True)
class Checkpoint:
    """A run after an epoch. There is no random state: all chance derives from seed, epoch and track.

    Attributes:
        progress: how far it is.
        weights: the module's state.  best: the same at the best epoch.
        optimizer: `<parameter>/<moment>`.
        memory: what the model carries from one epoch to the next.
    """

    progress: RunProgress
    weights: dict[str, Tensor]
    best: dict[str, Tensor]
    optimizer: dict[str, Tensor] = field(default_factory=dict)
    memory: dict[str, Tensor] = field(default_factory=dict)


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint of a run. At every moment the old or the new one is there, whole.

    Args: folder: of the run.
    """
    part, old = folder / f".{NAME}.part", folder / f".{NAME}.old"
    if part.exists():
        shutil.rmtree(part)
    part.mkdir()
    for name in TENSORS:
        tensors: dict[str, Tensor] = getattr(checkpoint, name)
        save_file({key: tensor.detach().contiguous().clone() for key, tensor in tensors.items()}, _tensors(part, name))
    text = yaml.safe_dump(checkpoint.progress.model_dump(), sort_keys=False)
    (part / STATE).write_text(text, encoding="utf-8")
    for path in part.iterdir():
        _flush(path)
    _recover(folder)
    if (folder / NAME).exists():
        os.replace(folder / NAME, old)
    os.replace(part, folder / NAME)
    _recover(folder)


def read_checkpoint(folder: Path) -> Checkpoint | None:
    """The checkpoint of a run; None if it stopped before the first.

    Raises: ValueError: if it is damaged.
    """
    _recover(folder)
    path = folder / NAME
    if not path.exists():
        return None
    try:
        content: Any = yaml.safe_load((path / STATE).read_text(encoding="utf-8"))
        tensors = {name: load_file(_tensors(path, name)) for name in TENSORS}
        return Checkpoint(RunProgress.model_validate(content), **tensors)
    except ValidationError as error:
        reason = f"{STATE}: {error.errors()[0]['msg']}"
    except (OSError, UnicodeDecodeError, yaml.YAMLError, SafetensorError) as error:
        reason = " ".join(str(error).split())
    raise ValueError(f"{path}: not a whole checkpoint ({reason}). Start a new run.")


def _recover(folder: Path) -> None:
    """Clear the old checkpoint away; take it back where a crash came between the two steps of a replacement."""
    current, old = folder / NAME, folder / f".{NAME}.old"
    if not old.exists():
        return
    if current.exists():
        shutil.rmtree(old)
    else:
        os.replace(old, current)


def _tensors(folder: Path, name: str) -> Path:
    return folder / f"{name}.safetensors"


def _flush(path: Path) -> None:
    """Bring a file to the disk, so that a power cut does not leave a name without content."""
    handle = os.open(path, os.O_RDONLY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
