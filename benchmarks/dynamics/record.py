"""What is kept of a finished contender: its errors on every validation track, as a JSON file that a later run reads."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ballfg.benchmarks.dynamics.fan import Fan
from ballfg.benchmarks.dynamics.metrics import PathScore
from ballfg.benchmarks.dynamics.task import Task
from ballfg.benchmarks.record_file import read_record_file, write_record

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Record:
    """A finished contender.

    Attributes:
        digest: of the task and the size of the training: a record of another one does not count.
        method, seed: which contender.
        parameters: numbers learned.  training_time: s, wall clock.
        inference_time: s, median over single tracks.
        not_converged: estimates among the validation tracks.
        scores: one a validation track.
        fan: paths for the picture; None for methods that have no dynamics.
    """

    digest: str
    method: str
    seed: int
    parameters: int
    training_time: float
    inference_time: float
    not_converged: int
    scores: tuple[PathScore, ...]
    fan: Fan | None

    def save(self, path: Path) -> None:
        """Write the file; its name appears once it is whole."""
        content = vars(self) | {"scores": [_score_to_json(s) for s in self.scores]}
        content["fan"] = None if self.fan is None else self.fan.to_json()
        write_record(path, content)


def read_record(path: Path, digest: str) -> Record | None:
    """The record in a file; None if there is no file, or one of another task.

    Raises: ValueError: if the file is no record.
    """
    return read_record_file(path, digest, _record_from, "a finished run")


def _record_from(content: dict[str, Any]) -> Record:
    content["scores"] = tuple(_score_from_json(s) for s in content["scores"])
    content["fan"] = None if content["fan"] is None else Fan.from_json(content["fan"])
    return Record(**content)


def task_digest(task: Task, recipe: str) -> str:
    """Of everything that decides a contender's errors but its method and seed: the task, and how it is trained."""
    digest = hashlib.sha256(repr((metadata.version("ballfg"), task.case, recipe, task.settings)).encode())
    for part in (task.train, task.validation):
        for shot in part:
            digest.update(
                repr((shot.track.name, shot.observed, shot.judged, sorted(shot.track.labels.items()))).encode()
            )
            for values in (shot.track.times, shot.track.positions, shot.reference, shot.bounces, shot.apexes):
                digest.update(values.tobytes())
        digest.update(b"|")
    return digest.hexdigest()


def job_digest(task: Task, tasks: Sequence[Task], recipe: str) -> str:
    """Of what decides the errors on one of several tasks that are learned from together.

    Args: task: that is judged by.  tasks: that are learned from, where they hold shots for it.
    """
    own = task_digest(task, recipe)
    others = [task_digest(other, recipe) for other in tasks if other.train and other is not task]
    return hashlib.sha256("|".join([own, *others]).encode()).hexdigest() if others else own


def _score_to_json(score: PathScore) -> dict[str, Any]:
    """Plain numbers; null where there is none."""
    return {
        "track": [_number(score.track_sum), score.track_points],
        "rest": [_number(score.rest_sum), score.rest_points],
        "apex": [_number(e) for e in score.apex],
        "apex_ahead": score.apex_ahead.tolist(),
    }


def _score_from_json(content: dict[str, Any]) -> PathScore:
    numbers = _floats([content["track"][0], content["rest"][0], *content["apex"]])
    return PathScore(
        track_sum=float(numbers[0]),
        track_points=int(content["track"][1]),
        rest_sum=float(numbers[1]),
        rest_points=int(content["rest"][1]),
        apex=numbers[2:],
        apex_ahead=np.array(content["apex_ahead"], dtype=bool),
    )


def _number(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None


def _floats(values: Sequence[float | None]) -> Array:
    return np.array([np.nan if value is None else value for value in values], dtype=np.float64)
