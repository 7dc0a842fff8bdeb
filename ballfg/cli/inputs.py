"""What estimate and predict share: opening a dataset, a model and an estimator from the command line's words."""

from __future__ import annotations

import os
import sys
from collections import Counter
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

if TYPE_CHECKING:
    from ballfg.dynamics import BallModel
    from ballfg.dynamics.surfaces import Surfaces
    from ballfg.estimate import Estimator, Settings
    from ballfg.tracks import Dataset

OwnEffects = Annotated[
    list[Path] | None,
    typer.Option("--effects", help="Python file with effects of your own, to run and know; may be repeated."),
]
"""The option of every command that reads or names effects."""
DATASET_TABLES = ("tracks", "labels", "detections", "truth")
"""Names, without their endings, of the tables that a dataset's folder holds."""


@dataclass(frozen=True)
class Inputs:
    """A dataset and how to look at it."""

    dataset: Dataset
    model: BallModel
    surfaces: Surfaces
    settings: Settings

    def estimator(self, method: str) -> Estimator:
        """The estimator of a name. Raises: ValueError: if there is none of that name."""
        from ballfg.estimate import make_estimator

        return make_estimator(method, self.model, self.surfaces, self.settings)


def know_effects(files: Iterable[Path] | None) -> None:
    """Registers the effects that files define, so that model files and options can name them."""
    from ballfg.dynamics import load_effects

    for file in files or ():
        load_effects(file)


def open_inputs(dataset: Path, model: Path | None, effects: Iterable[Path] | None = None) -> Inputs:
    """Open and check everything before any work starts; what was repaired is said on stderr."""
    import torch

    from ballfg.dynamics import load_model, nominal_model
    from ballfg.estimate import dataset_settings, dataset_surfaces
    from ballfg.tracks import read_dataset

    torch.set_num_threads(1)  # the batches are small: threads cost more than they bring
    know_effects(effects)
    data = read_dataset(dataset)
    for note in data.notes:
        print(f"note: {note}", file=sys.stderr)
    radius = data.info.ball.radius
    ball = nominal_model(radius) if model is None else load_model(model, radius=radius)
    return Inputs(data, ball, dataset_surfaces(data), dataset_settings(data, ball))


def check_out(out: Path, dataset: Path) -> None:
    """A result must not take the place of the measurements.

    Raises: ValueError: if `out` is a table of the dataset.
    """
    if out.stem in DATASET_TABLES and out.resolve().parent == dataset.resolve():
        raise ValueError(f"out must not be a table of the dataset itself; got {out}. Choose another name.")


def status_lines(statuses: Counter[str]) -> Iterator[str]:
    """How many tracks ended how, most first."""
    for text, number in statuses.most_common():
        yield f"  {number} track{'s' if number > 1 else ''}: {text}"


def default_jobs() -> int:
    """One process per core that this process may use."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
