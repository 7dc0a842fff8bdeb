"""Writes and reads the checkpoint of a training, a folder of tensors and YAML, for an exact continuation."""

import hashlib
from collections.abc import Container, Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Self

import yaml
from pydantic import ValidationError
from safetensors.torch import save
from torch import Tensor

from ballfg.checks import one_line
from ballfg.dynamics.coefficient import todays_name
from ballfg.files.strict_yaml import read_yaml
from ballfg.files.weights import read_tensors
from ballfg.files.whole_folder import whole_folder
from ballfg.learning.evaluation import Plain

NAME = "checkpoint"
STATE = "state.yaml"
DIGESTS = "digests"  # In `state.yaml`: the SHA-256 of every file of tensors
TENSORS = ("weights", "optimizer", "memory", "best")  # One file `<name>.safetensors` each


class RunProgress(Plain):
    """Numbers of finished epochs, of the best epoch, of steps skipped in a row up to now, of tracks; the data."""

    epoch: int
    best_epoch: int
    best_rmse: float | None  # m, RMSE of the best weights on the validation tracks; null: none was judged
    skipped_in_row: int
    train: int
    validation: int
    data: str | None = None  # Digest of the datasets' files (`data_digest`); None: earlier versions did not keep it


@dataclass(frozen=True)
class Checkpoint:
    """A run after an epoch: the module now and at the best epoch, its optimizer (`moments`), memory of the trainee.

    There is no random state: random numbers derive from seed, epoch and track.
    """

    progress: RunProgress
    weights: dict[str, Tensor]
    best: dict[str, Tensor]
    optimizer: dict[str, Tensor] = field(default_factory=dict)
    memory: dict[str, Tensor] = field(default_factory=dict)

    def renamed(self, known: Container[str]) -> Self:
        """This checkpoint with tensors under the names of today; known: those of the module."""

        def today(tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
            split = ((name.partition("/"), tensor) for name, tensor in tensors.items())
            return {todays_name(name, known) + slash + moment: tensor for (name, slash, moment), tensor in split}

        return replace(self, weights=today(self.weights), best=today(self.best), optimizer=today(self.optimizer))


def write_checkpoint(folder: Path, checkpoint: Checkpoint) -> None:
    """Replace the checkpoint in the folder of a run. At every moment the old or the new one exists as a whole."""
    with whole_folder(folder / NAME, earlier=("*",)) as part:
        for name in TENSORS:
            tensors: dict[str, Tensor] = getattr(checkpoint, name)
            owned = {key: tensor.detach().contiguous().clone() for key, tensor in tensors.items()}
            (part / f"{name}.safetensors").write_bytes(save(owned))
        state = checkpoint.progress.model_dump() | {DIGESTS: _digests(part)}
        (part / STATE).write_text(yaml.safe_dump(state, sort_keys=False), encoding="utf-8")


def read_checkpoint(folder: Path) -> Checkpoint | None:
    """The checkpoint of a run that goes on; None if it stopped before the first.

    Raises: ValueError: if it is damaged.
    """
    path = folder / NAME
    if not path.exists():
        return None
    try:
        content: Any = read_yaml(path / STATE)
        digests = content.pop(DIGESTS, None) if isinstance(content, dict) else None
        tensors = {name: read_tensors(path / f"{name}.safetensors") for name in TENSORS}
        progress = RunProgress.model_validate(content)
        if digests is not None and digests != _digests(path):  # checkpoints of earlier versions have none
            raise ValueError(f"the tensors are not those that {STATE} states: a file is damaged")
        return Checkpoint(progress, **tensors)
    except ValidationError as error:
        reason = f"{STATE}: {error.errors()[0]['msg']}"
    except (OSError, ValueError) as error:
        reason = one_line(error)
    raise ValueError(f"{path}: not a whole checkpoint ({reason}). Start a new run.")


def _digests(folder: Path) -> dict[str, str]:
    files = {name: folder / f"{name}.safetensors" for name in TENSORS}
    return {name: hashlib.sha256(file.read_bytes()).hexdigest() for name, file in files.items()}
