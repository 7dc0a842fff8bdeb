"""Checks, prepares and writes the folder of a run: config, versions, rows of `metrics.csv`, checkpoints.

The checkpoint of a training is a folder of tensors and YAML, for an exact continuation.
"""

import csv
import hashlib
import io
import json
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Self

import yaml
from pydantic import ValidationError
from safetensors.torch import save
from torch import Tensor

from ballfg.checks import one_line, short_text, shown
from ballfg.dynamics.coefficient import todays_name
from ballfg.files.strict_yaml import read_yaml
from ballfg.files.weights import read_tensors
from ballfg.files.whole_file import write_text
from ballfg.files.whole_folder import reserved, whole_folder
from ballfg.learning.config.config_file import Config, read_config
from ballfg.learning.evaluation import Plain
from ballfg.machine import versions
from ballfg.tracks.info import INFO_FILE

CONFIG, VERSIONS, MODEL = "config.yaml", "versions.json", "model.yaml"
STEPS, REPORT, PICTURE = "checkpoint.json", "report.json", "calibration.png"
CHOICE = "choice.json"  # The comparison of `kind: auto`
CHECKPOINT, METRICS, CURVES, EVENTS = "checkpoint", "metrics.csv", "curves.png", "tensorboard"
PAGE = "training.html"
CALIBRATION = (CONFIG, VERSIONS, MODEL, STEPS, REPORT, PICTURE)  # Files of a calibration
TRAINING = (CONFIG, VERSIONS, MODEL, CHECKPOINT, METRICS, CURVES, EVENTS, PAGE)
"""Files and folders of a training; a learned model adds a folder of its own."""
STATE = "state.yaml"  # Of a checkpoint
DIGESTS = "digests"  # In `state.yaml`: the SHA-256 of every file of tensors
TENSORS = ("weights", "optimizer", "memory", "best")  # One file `<name>.safetensors` each
TABLES = ("tracks", "labels")  # Of a dataset
PACKAGES = ("ballfg", "gtsam", "torch", "numpy", "scipy", "safetensors")


def check(folder: Path, config: Config, *, resume: bool) -> None:
    """Check the folder before a run starts: it must hold no earlier run, or one with the same config to `resume`.

    Raises:
        ValueError: a file, or a folder with an earlier run; to resume, a config that would change the numbers.
        FileNotFoundError: no run to resume.
    """
    if resume:
        if not (folder / CONFIG).is_file():
            raise FileNotFoundError(f"--resume needs the folder of an earlier run; {folder} has no {CONFIG}.")
        earlier, now = (_flat(each.model_dump(mode="json")) for each in (read_config(folder / CONFIG), config))
        several = isinstance(earlier.get("data"), list) != isinstance(now["data"], list)
        for name in ("kind", *now):
            if (several and name == "data") or (name not in config.FREE_TO_CHANGE and earlier.get(name) != now[name]):
                raise ValueError(
                    f"a resumed run must keep its config; '{name}' was {shown(earlier.get(name))} and is "
                    f"{shown(now[name])}. Give {folder / CONFIG} as the config, or start a new run."
                )
        return
    if folder.exists() and not folder.is_dir():
        raise ValueError(f"out must be a folder; {folder} is a file. Choose another name.")
    there = [name for name in (*CALIBRATION, CHOICE, *TRAINING) if (folder / name).exists()]
    if there:
        raise ValueError(
            f"out must not hold an earlier run; {folder} has {there[0]}. Choose another folder, or continue that run "
            f"with --resume {folder}."
        )


@contextmanager
def running(folder: Path, config: Config, *, resume: bool) -> Iterator[None]:
    """Check the folder, and keep other runs from it until the block ends. A new folder that stays empty is removed.

    Raises: ValueError: another run is writing there; else as `check`.
    """
    check(folder, config, resume=resume)
    made = [path for path in (folder, *folder.parents) if not path.exists()]
    folder.mkdir(parents=True, exist_ok=True)
    try:
        with reserved(folder):
            check(folder, config, resume=resume)
            yield
    finally:
        for path in made:
            if path.is_dir() and not any(path.iterdir()):
                path.rmdir()


def data_digest(folders: Sequence[str]) -> str:
    """A hash of datasets: of their files `dataset.yaml`, `tracks` and `labels`."""
    digest = hashlib.sha256()
    for folder in map(Path, folders):
        for path in sorted(folder.iterdir()) if folder.is_dir() else ():
            if path.name == INFO_FILE or path.stem in TABLES:
                digest.update(f"{path.name} {path.stat().st_size} ".encode())
                with path.open("rb") as file:
                    digest.update(hashlib.file_digest(file, "sha256").digest())
    return digest.hexdigest()


def _flat(content: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested keys with dots."""
    flat: dict[str, Any] = {}
    for key, value in content.items():
        flat |= _flat(value, f"{prefix}{key}.") if isinstance(value, dict) else {f"{prefix}{key}": value}
    return flat


def start(folder: Path, config: Config) -> None:
    """Make the folder and write the resolved config and the versions, before the first step."""
    folder.mkdir(parents=True, exist_ok=True)
    text = yaml.safe_dump(config.model_dump(mode="json"), sort_keys=False, allow_unicode=True)
    write_text(folder / CONFIG, text)
    write_json(folder / VERSIONS, versions(PACKAGES))


def write_json(path: Path, content: Any) -> None:
    """Write JSON; floats are read back bit for bit."""
    write_text(path, json.dumps(content, indent=1, allow_nan=False) + "\n")


@dataclass(frozen=True)
class Epoch:
    """An epoch's numbers.

    Attributes:
        epoch: number, from 1; 0 is the model before the first step, which is judged only.
        loss: mean over the training tracks; None without a step.
        train_rmse: m, of predicted positions (norm of the error), with the weights of each step.
        validation_rmse: m, with the weights at the end; None where no track could be judged.
        learning_rate: of the last step, for a scale of 1.
        gradient_norm: of the mean loss of a batch before clipping, mean over steps.
        skipped: number of steps whose loss or gradient was not finite.
        failed, validation_failed: numbers of tracks that were left out because their estimate failed.
    """

    epoch: int
    loss: float | None
    train_rmse: float | None
    validation_rmse: float | None
    learning_rate: float
    gradient_norm: float | None
    skipped: int
    failed: int
    validation_failed: int
    seconds: float


def write_metrics(path: Path, epochs: Sequence[Epoch]) -> None:
    """Write the table; an empty cell stands for None. Floats are read back bit for bit."""
    text = io.StringIO()
    table = csv.DictWriter(text, [column.name for column in fields(Epoch)], lineterminator="\n")
    table.writeheader()
    for epoch in epochs:
        table.writerow(asdict(epoch))
    write_text(path, text.getvalue())


def read_metrics(path: Path) -> list[Epoch]:
    """The rows of a table. Raises: ValueError: if it is not one that `write_metrics` wrote."""
    try:
        with path.open(encoding="utf-8", newline="") as file:
            rows = [{name: _number(name, text) for name, text in row.items()} for row in csv.DictReader(file)]
        return [Epoch(**row) for row in rows]
    except (TypeError, ValueError, csv.Error) as error:
        raise ValueError(f"{path}: not a table of epochs ({short_text(one_line(error))}). Start a new run.") from None


def epoch_line(epoch: Epoch, last: int, seconds_left: float) -> str:
    """One line of text. Args: last: number of the last epoch.  seconds_left: s, estimated."""
    parts = [f"epoch {epoch.epoch}/{last}:"]
    if epoch.epoch:
        parts.append("no track learned from," if epoch.loss is None else f"loss {epoch.loss:.4g},")
        parts.append(f"train RMSE {_millimetres(epoch.train_rmse)},")
    parts.append(f"validation RMSE {_millimetres(epoch.validation_rmse)},")
    parts += [f"{epoch.skipped} steps skipped,"] if epoch.skipped else []
    parts += [f"{epoch.failed} tracks failed,"] if epoch.failed else []
    parts += [f"{epoch.validation_failed} validation tracks failed,"] if epoch.validation_failed else []
    parts.append(f"{epoch.seconds:.1f} s")
    return " ".join(parts) + (f", about {_duration(seconds_left)} left" if seconds_left else "")


def _number(name: str, text: str) -> Any:
    if name in ("epoch", "skipped", "failed", "validation_failed"):
        return int(text)
    return float(text) if text else None


def _millimetres(rmse: float | None) -> str:
    return "-" if rmse is None else f"{1e3 * rmse:.2f} mm"


def _duration(seconds: float) -> str:
    if seconds < 120.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60.0:.0f} min" if seconds < 7200.0 else f"{seconds / 3600.0:.1f} h"


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
    with whole_folder(folder / CHECKPOINT, earlier=("*",)) as part:
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
    path = folder / CHECKPOINT
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
