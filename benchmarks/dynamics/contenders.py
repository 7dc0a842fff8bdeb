"""Defines the contenders of the dynamics comparison, the paths that each predicts for one launch, and their records."""

import hashlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from importlib import metadata
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.task import PathScore, Task
from ballfg.benchmarks.results import Kept
from ballfg.dynamics import BallModel, Surfaces, nominal_model
from ballfg.dynamics.coefficient import coefficient_sigmas
from ballfg.dynamics.motion.paths import paths
from ballfg.estimation import Estimate, Settings, Smoother, Status
from ballfg.factors.noise import ProcessNoise
from ballfg.prediction import Belief, Propagator
from ballfg.simulation import table_tennis
from ballfg.simulation.settings import SETTING_LEVELS
from ballfg.state import POSITION, SPIN, VELOCITY
from ballfg.tracks import Track

BLOCK: Final = 64  # Tracks that are rolled out together
NO_NOISE: Final = ProcessNoise(acceleration=0.005, spin=0.05, contact_velocity=0.001, contact_spin=0.2)
"""For the truth, which has no process noise: a fiftieth of what models start from, as little as stays well conditioned;
a fifth of it changes the errors by less than 1 %."""


@dataclass(frozen=True)
class Job:
    """One method to be made and judged."""

    tasks: tuple[Task, ...]  # what it learns from, all of it together, and is judged by, each by itself
    method: str  # its name in `METHODS`
    seed: int  # of its training
    folder: Path  # its own, for what training writes; it may hold an unfinished training to go on with
    quick: bool  # train just enough to see that everything works

    @property
    def measured(self) -> bool:
        """True if the tracks are measured ones."""
        return self.tasks[0].truth is None


def as_it_is(track: Track) -> Track:
    """The track itself."""
    return track


@dataclass
class GraphContender:
    """A dynamics model in the factor graph: smooth the observed part, predict the rest.

    Attributes:
        model: the dynamics.  surfaces: on what it bounces.  settings: of the smoother.
        label: gives a track the spin label that its launcher settings mean, if the method knows that.
        onward: predict as `ballfg predict` does: the observed part is the smoothed one, the rest is rolled out from
            its last state, with the coefficients that the settings let each track have. False: the whole path is rolled
            out from the first state.
        parameter_count: numbers that were learned, 0 for none.  training_seconds: s, wall clock; 0 without a training.
        failures: number of estimates that did not converge so far.
    """

    model: BallModel
    surfaces: Surfaces
    settings: Settings
    label: Callable[[Track], Track] = as_it_is
    onward: bool = False
    parameter_count: int = 0
    training_seconds: float = 0.0
    failures: int = 0

    def predict(self, seen: Sequence[Track], times: Sequence[Array]) -> list[Array]:
        """Positions (n, 3) m at all stamps of some tracks, from their observed parts with their labels.

        Args: times: (n,) s for each track, the stamps of the whole track, first those of the observed part.
        """
        smoother = Smoother(self.model, self.surfaces, self.settings)
        estimates = [smoother.estimate(self.label(track)) for track in seen]
        self.failures += sum(estimate.status is not Status.OK for estimate in estimates)
        if self.onward:
            return list(self._onward(estimates, times))
        starts = np.stack([estimate.states[0] for estimate in estimates])
        return self.roll(starts, [stamps - stamps[0] for stamps in times])

    def _onward(self, estimates: Sequence[Estimate], times: Sequence[Array]) -> Iterator[Array]:
        """Smoothed positions where a track was observed, then those that follow from its last state."""
        propagator = Propagator(self.surfaces, self.settings.process)
        for first in range(0, len(estimates), BLOCK):
            block = estimates[first : first + BLOCK]
            rests = [t[len(e.times) :] for e, t in zip(block, times[first : first + BLOCK], strict=True)]
            belief = Belief.of(self.model, [e.last for e in block], self.settings.coefficients)
            states = propagator.rollout(belief, _padded(rests)).states
            for estimate, path, rest in zip(block, states, rests, strict=True):
                yield np.concatenate((estimate.states[:, POSITION], path[: len(rest), POSITION]))

    @torch.no_grad()
    def roll(self, starts: Array, times: Sequence[Array]) -> list[Array]:
        """Positions (n, 3) m of each ball at its times (n,) s since its start, from first states (m, 9)."""
        found: list[Array] = []
        for first in range(0, len(starts), BLOCK):
            block = times[first : first + BLOCK]
            start = torch.from_numpy(starts[first : first + BLOCK])
            states = paths(self.model, start, torch.from_numpy(_padded(block)), self.surfaces).numpy()
            found += [path[: len(t), POSITION].copy() for path, t in zip(states, block, strict=True)]
        return found


def _padded(times: Sequence[Array]) -> Array:
    """(n, k) s: each ball's times, then the last of them again."""
    longest = max(map(len, times))
    return np.stack([np.pad(t, (0, longest - len(t)), mode="edge") for t in times])


def nominal_contender(job: Job, task: Task) -> GraphContender:
    """The nominal analytic model, as before any data, with the known spins of launcher settings."""
    label = as_it_is if task.launcher is None else task.launcher.labelled
    model = nominal_model(task.info.ball)
    return GraphContender(model, task.surfaces, task.settings, label, job.measured)


def adapting_contender(job: Job, task: Task) -> GraphContender:
    """The nominal model with coefficients that are estimated with each track, as `ballfg predict` has it."""
    contender = nominal_contender(job, task)
    return replace(contender, settings=replace(task.settings, coefficients=coefficient_sigmas(contender.model)))


def truth_contender(job: Job, task: Task) -> GraphContender:
    """The true dynamics, with next to no process noise: what noise and spread of the launches leave unknown."""
    if task.truth is None:
        raise ValueError(
            f"method '{job.method}' needs simulated tracks; got measured ones ({task.case}). Leave it out."
        )
    settings = replace(task.settings, process=NO_NOISE)
    return replace(nominal_contender(job, task), model=task.truth, settings=settings)


SPEED_LEVEL: Final = 11  # The launcher's middle velocity level
DURATION: Final = 1.2  # s that are shown
RATE: Final = 120.0
"""Hz, of the paths and of the short straight track that tells a contender the direction of the launch."""
STRAIGHT: Final = 12  # Samples of that track
DIGITS: Final = 5  # Resolution of a kept coordinate in m, 0.01 mm


Point = tuple[float, float, float]


@dataclass(frozen=True)
class Fan:
    """Paths from one launch."""

    topspin: dict[int, list[Point]]  # by level, m, without sidespin, to `DIGITS`
    sidespin: dict[int, list[Point]]  # by level, m, without topspin


def _paths(contender: GraphContender, setting: str) -> dict[int, list[Point]]:
    """The paths by the levels of one setting, the other one being zero."""
    levels, start = SETTING_LEVELS[setting], _launch()
    states = np.tile(start, (len(levels), 1))
    for row, level in zip(states, levels, strict=True):
        row[SPIN] = _spin(contender, start, {setting: float(level)})
    times = np.arange(round(DURATION * RATE) + 1) / RATE
    paths = contender.roll(states, [times] * len(levels))
    return {level: np.round(path, DIGITS).tolist() for level, path in zip(levels, paths, strict=True)}


def _launch() -> Array:
    """(9,) the launcher's first state at the middle velocity level, without spread and spin."""
    kind = table_tennis()
    still = {name: 0.0 for name in ("position_spread", "speed_spread", "aim_spread", "spin_spread")}
    launcher, middle = kind.launcher.with_fields(still), np.array([[0, 0, SPEED_LEVEL]])
    return launcher.launch(middle, kind.surfaces.table_height, np.random.default_rng(0))[0].numpy()


def _spin(contender: GraphContender, start: Array, settings: dict[str, float]) -> Array:
    """(3,) rad/s, the spin that launcher settings mean to the contender for a launch."""
    times = np.arange(STRAIGHT) / RATE
    positions = start[POSITION] + times[:, None] * start[VELOCITY]
    labels = {"topspin": 0.0, "sidespin": 0.0, "speed": float(SPEED_LEVEL)} | settings
    launch = contender.label(Track(times, positions, labels=labels, name="launch"))
    label = contender.settings.spin_label(launch)
    return np.zeros(3) if label is None else label.spin


def fan_of(contender: GraphContender) -> Fan:
    """The paths of all levels of topspin, and of all levels of sidespin, from the launcher's middle shot."""
    return Fan(_paths(contender, "topspin"), _paths(contender, "sidespin"))


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
