"""Who takes part in the comparison of dynamics: what every contender must do, and the two that need no training."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final, Protocol

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.benchmarks.dynamics_task import Task
from ballfg.dynamics import BallModel, Surfaces, nominal_model, rollout
from ballfg.estimate import Settings, Smoother, Status
from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION
from ballfg.tracks import Track

Array = NDArray[np.float64]

BLOCK: Final = 64
"""Tracks that are rolled out together."""
TIMED: Final = 20
"""Tracks whose predictions are timed one by one."""
NO_NOISE: Final = ProcessNoise(acceleration=0.005, spin=0.05, contact_velocity=0.001, contact_spin=0.2)
"""For the truth, which has no process noise: a fiftieth of what models start from, as little as stays well conditioned;
a fifth of it changes the errors by less than 1 %."""


class Contender(Protocol):
    """A trained method, or one that needs no training.

    Attributes:
        name: the method in `results.json`.
        parameter_count: numbers that were learned, 0 for none.
        training_seconds: s, wall clock; 0 where nothing was learned.
    """

    name: str
    parameter_count: int
    training_seconds: float

    def predict(self, seen: Sequence[Track], times: Sequence[Array]) -> list[Array]:
        """Positions at all stamps of some tracks, from their observed parts.

        Args:
            seen: the observed samples with their labels: nothing later is in reach.
            times: (n,) s for each track, the stamps of the whole track; the first ones are those of the observed part.
        Returns: (n, 3) m for each track; NaN at observed stamps for a method that predicts only what comes after.
        """


@dataclass
class GraphContender:
    """A dynamics model in the factor graph: smooth the observed part, roll out from its first state.

    Attributes:
        name, parameter_count, training_seconds: as of any contender.
        model: the dynamics.
        surfaces: on what it bounces.
        settings: of the smoother.
        label: gives a track the spin label that its launcher settings mean, if the method knows that.
        failures: how many estimates did not converge so far.
    """

    name: str
    model: BallModel
    surfaces: Surfaces
    settings: Settings
    label: Callable[[Track], Track]
    parameter_count: int = 0
    training_seconds: float = 0.0
    failures: int = 0

    def predict(self, seen: Sequence[Track], times: Sequence[Array]) -> list[Array]:
        """Positions (n, 3) m at all stamps of each track."""
        smoother = Smoother(self.model, self.surfaces, self.settings)
        starts = np.zeros((len(seen), 9))
        for i, track in enumerate(seen):
            estimate = smoother.estimate(self.label(track))
            self.failures += estimate.status is not Status.OK
            starts[i] = estimate.states[0]
        return self.roll(starts, [stamps - stamps[0] for stamps in times])

    @torch.no_grad()
    def roll(self, starts: Array, times: Sequence[Array]) -> list[Array]:
        """Positions (n, 3) m of each ball at its times (n,) s since its start, from first states (m, 9)."""
        paths: list[Array] = []
        for first in range(0, len(starts), BLOCK):
            block = times[first : first + BLOCK]
            longest = max(map(len, block))
            padded = torch.from_numpy(np.stack([np.pad(t, (0, longest - len(t)), mode="edge") for t in block]))
            start = torch.from_numpy(starts[first : first + BLOCK])
            states = rollout(self.model, start, padded, self.surfaces).numpy()
            paths += [path[: len(t), POSITION].copy() for path, t in zip(states, block, strict=True)]
        return paths


def label_of(task: Task) -> Callable[[Track], Track]:
    """What turns launcher settings into spin labels for a method that does not learn it."""
    return _as_it_is if task.launcher is None else task.launcher.label


def _as_it_is(track: Track) -> Track:
    return track


@dataclass(frozen=True)
class Job:
    """One contender to be made.

    Attributes:
        task: what it learns from and is judged by.
        method: its name in `METHODS`.
        seed: of its training.
        folder: its own, for what training writes; it may hold an unfinished training to go on with.
        quick: train just enough to see that everything works.
    """

    task: Task
    method: str
    seed: int
    folder: Path
    quick: bool


@dataclass(frozen=True)
class Method:
    """A row of the comparison.

    Attributes:
        make: trains it, or goes on with its training.
        recipe: how it is trained, quickly or not, in words that change whenever that does.
        trained: whether a seed makes a difference; if not it runs once.
        needs_truth: whether it takes part on simulated tracks only.
    """

    make: Callable[[Job], Contender]
    recipe: Callable[[bool], str]
    trained: bool = True
    needs_truth: bool = False


def nominal_contender(job: Job) -> GraphContender:
    """The nominal analytic model: what one has before any data."""
    task = job.task
    model = nominal_model(task.info.ball.radius)
    return GraphContender(job.method, model, task.surfaces, task.settings, label_of(task))


def truth_contender(job: Job) -> GraphContender:
    """The true dynamics, with next to no process noise: what noise and spread of the launches leave unknown.

    Raises: ValueError: if the task is of measured tracks, whose truth nobody knows.
    """
    task = job.task
    if task.truth is None:
        raise ValueError(
            f"method '{job.method}' needs simulated tracks; got measured ones ({task.case}). Leave it out."
        )
    settings = replace(task.settings, process=NO_NOISE)
    return GraphContender(job.method, task.truth, task.surfaces, settings, label_of(task))
