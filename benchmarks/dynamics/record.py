"""Keeps the record of a finished contender, its errors on every validation track, as a JSON file."""

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata

from ballfg.benchmarks.dynamics.contenders import Fan
from ballfg.benchmarks.dynamics.task import PathScore, Task
from ballfg.benchmarks.resumable import Kept


@dataclass(frozen=True)
class Record(Kept):
    """A finished contender.

    Attributes:
        method, seed: which contender.  parameters: numbers learned.  training_time: s, wall clock.
        inference_time: s, median over single tracks.  not_converged: estimates among the validation tracks.
        scores: one a validation track.  fan: paths for the picture; None for methods that have no dynamics.
    """

    what = "a finished run"
    method: str
    seed: int
    parameters: int
    training_time: float
    inference_time: float
    not_converged: int
    scores: tuple[PathScore, ...]
    fan: Fan | None


def task_digest(task: Task, recipe: str) -> str:
    """Digest of the task and the training, which together with method and seed determine a contender's errors."""
    digest = hashlib.sha256(repr((metadata.version("ballfg"), task.case, recipe, task.settings)).encode())
    for part in (task.train, task.validation):
        for shot in part:
            labels = sorted(shot.track.labels.items())
            digest.update(repr((shot.track.name, shot.observed, shot.judged, labels)).encode())
            for values in (shot.track.times, shot.track.positions, shot.reference, shot.bounces, shot.apexes):
                digest.update(values.tobytes())
        digest.update(b"|")
    return digest.hexdigest()


def job_digest(task: Task, tasks: Sequence[Task], recipe: str) -> str:
    """Digest of the settings that determine the errors on one of several tasks of a common training.

    Args: task: that is judged by.  tasks: that are learned from, where they hold shots for it.
    """
    own = task_digest(task, recipe)
    others = [task_digest(other, recipe) for other in tasks if other.train and other is not task]
    return hashlib.sha256("|".join([own, *others]).encode()).hexdigest() if others else own
