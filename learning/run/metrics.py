"""Holds the numbers of an epoch, one row of `metrics.csv`."""

import csv
import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass, fields
from pathlib import Path
from typing import Any

from ballfg.checks import one_line, short_text
from ballfg.files.whole_file import write_text


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
    table = csv.DictWriter(text, [field.name for field in fields(Epoch)], lineterminator="\n")
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
