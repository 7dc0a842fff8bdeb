"""Estimates many shots together, each starting from its last estimate."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Smoother
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.smoother.problem import effective_sigmas
from ballfg.estimation.smoother.settle import Earlier, Solution
from ballfg.factors.batch import Values
from ballfg.factors.graph import Convergence, LevenbergMarquardt
from ballfg.learning.augment import apply, rotate, undo
from ballfg.learning.end_to_end.learnables import Learnables
from ballfg.learning.training_data import TrainingShot
from ballfg.state import POSITION, SPIN, VELOCITY
from ballfg.tracks import Track
from ballfg.tracks.track import SPIN_LABELS

TRAINING = LevenbergMarquardt(tolerance=1e-4)
"""Posterior standard deviations to the minimum: the gradient is off by as little, far less than batches scatter."""
ACCEPTED = (Convergence.CONVERGED, Convergence.AT_KINK)


@dataclass(frozen=True)
class Pose:
    """The frame of a shot: turned about z by `angle` rad (), then shifted by `shift` m (2,)."""

    angle: Tensor
    shift: Tensor

    def positions(self, positions: Array) -> Array:
        """(n, 3) m in that frame."""
        return apply(torch.from_numpy(positions), self.angle, self.shift).numpy()

    def track(self, track: Track) -> Track:
        """A track in that frame, including its spin label."""
        labels = track.labels
        if track.spin_label is not None:
            spin = rotate(torch.from_numpy(track.spin_label), self.angle)
            labels = {**labels, **dict(zip(SPIN_LABELS, spin.tolist(), strict=True))}
        rotation = torch.stack([rotate(axis, self.angle) for axis in torch.eye(3, dtype=torch.float64)], dim=-1)
        shift = torch.cat((self.shift, self.shift.new_zeros(1)))
        turned = tuple(observation.turned(rotation, shift) for observation in track.observations)
        return replace(track, positions=self.positions(track.positions), labels=labels, observations=turned)

    def states(self, states: Array, *, back: bool = False) -> Array:
        """(n, 9) in that frame; with `back`, from that frame to the original one."""
        given, angle = torch.from_numpy(states), -self.angle if back else self.angle
        moved = (undo if back else apply)(given[:, POSITION], self.angle, self.shift)
        return torch.cat((moved, rotate(given[:, VELOCITY], angle), rotate(given[:, SPIN], angle)), dim=-1).numpy()


@dataclass(frozen=True)
class Solved:
    """An estimate of a shot by its number, with the positions (n, 3) m of the whole track as seen in it."""

    number: int
    solution: Solution
    positions: Array


class WarmStarts:
    """The last estimate of each shot, seen from where it was measured: states, coefficients, contacts.

    The tracker's biases start from zero again: the objective is a parabola in them.
    """

    def __init__(self) -> None:
        self._last: dict[int, tuple[Array, Array, tuple[Contact, ...]]] = {}

    def get(self, number: int, pose: Pose | None) -> tuple[Values, tuple[Contact, ...]] | None:
        """Values to start from and contacts; None for a shot that was never solved."""
        if number not in self._last:
            return None
        states, coefficients, contacts = self._last[number]
        return Values(states if pose is None else pose.states(states), coefficients), contacts

    def keep(self, number: int, solution: Solution, pose: Pose | None) -> None:
        """Remember a converged estimate."""
        values = solution.minimum.values
        states = values.states if pose is None else pose.states(values.states, back=True)
        self._last[number] = (states, values.coefficients, solution.events.contacts)

    def forget(self, number: int) -> None:
        """Forgets the last estimate of a shot."""
        self._last.pop(number, None)

    def tensors(self) -> dict[str, Tensor]:
        """Everything, by name."""
        found = {}
        for number, (states, coefficients, contacts) in sorted(self._last.items()):
            rows = [(float(c.interval), c.time, c.height) for c in contacts]
            found[f"{number}.states"] = torch.from_numpy(states.copy())
            found[f"{number}.coefficients"] = torch.from_numpy(coefficients.copy())
            found[f"{number}.contacts"] = torch.tensor(rows, dtype=torch.float64).reshape(-1, 3)
        return found

    def take(self, tensors: Mapping[str, Tensor]) -> None:
        """Restores the values of `tensors`."""
        for name in tensors:
            number, _, part = name.partition(".")
            if part == "states":
                rows = tensors[f"{number}.contacts"].tolist()
                contacts = tuple(Contact(int(i), time, height) for i, time, height in rows)
                coefficients = tensors[f"{number}.coefficients"].numpy()
                self._last[int(number)] = (tensors[name].numpy(), coefficients, contacts)


@dataclass
class BatchSolver:
    """Solves shots, given by number, with the present parameters."""

    shots: Sequence[TrainingShot]
    learnables: Learnables
    optimizer: LevenbergMarquardt = TRAINING
    warm: WarmStarts = field(default_factory=WarmStarts)

    def __call__(self, numbers: Sequence[int], poses: Mapping[int, Pose]) -> tuple[list[Solved], list[tuple[str, str]]]:
        """Estimates of some shots, in other poses if given; name and reason of each failure to converge."""
        smoothers: dict[tuple[int, Surfaces, bool], Smoother] = {}
        solved, failed = [], []
        for number in numbers:
            pose, positions = poses.get(number), self.shots[number].track.positions
            solution = self._solution(number, pose, smoothers)
            minimum = solution.minimum
            if minimum.convergence in ACCEPTED and minimum.step is not None:
                self.warm.keep(number, solution, pose)
                solved.append(Solved(number, solution, positions if pose is None else pose.positions(positions)))
            else:
                self.warm.forget(number)
                failed.append((self.shots[number].name, minimum.convergence.value))
        return solved, failed

    def _solution(
        self, number: int, pose: Pose | None, smoothers: dict[tuple[int, Surfaces, bool], Smoother]
    ) -> Solution:
        shot = self.shots[number]
        key = id(shot.settings), shot.surfaces, pose is not None
        if key not in smoothers:
            # hits were searched once, in the shots: an unexplained motion of a model in training is no hit
            settings = replace(self.learnables.noise.settings(shot.settings), find_events=False)
            if pose is not None:
                x, y, z = settings.memory
                settings = replace(settings, memory=(np.hypot(x, y) / np.sqrt(2.0),) * 2 + (z,))
            smoothers[key] = Smoother(self.learnables.model, shot.surfaces, settings, self.optimizer)
        smoother = smoothers[key]
        track, segmentation = shot.seen, shot.segmentation
        sigma = effective_sigmas(track, segmentation, smoother.settings)
        if pose is not None:
            track = pose.track(track)
            sigma[:, :2] = np.sqrt(np.square(sigma[:, :2]).mean(axis=1, keepdims=True))  # a turn mixes x and y
        warm = self.warm.get(number, pose)
        if warm is None:
            return smoother.settle(smoother.problem(track, segmentation, sigma))
        values, contacts = warm
        problem = smoother.problem(track, replace(segmentation, contacts=contacts), sigma)
        return smoother.settle(problem, Earlier(replace(values, biases=problem.start(values.states).biases)))
