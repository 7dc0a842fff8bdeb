"""Trains through the estimator: observations, states, rollout, error, and the gradient all the way back.

The estimate is a function of the model, the launcher's embedding and the noise. Its derivative follows from the
implicit function theorem (`ballfg.learning.gradient.implicit`). Source: Q. Xiao, Z. Wu, M. Gombolay 2024, section III.
"""

from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from torch import Tensor

from ballfg.dynamics import AnalyticModel, BallModel, save_model
from ballfg.dynamics.motion.paths import paths
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.dynamics.trained import Trained
from ballfg.factors.graph import LevenbergMarquardt
from ballfg.factors.loss import Loss
from ballfg.learning.augment import augmentation
from ballfg.learning.config.training import LossConfig
from ballfg.learning.end_to_end.elsewhere import fading_of, noise_elsewhere, strength_abroad, training_states
from ballfg.learning.end_to_end.learnables import Learnables
from ballfg.learning.end_to_end.pretrain import Anchor
from ballfg.learning.end_to_end.solving import TRAINING, BatchSolver, Pose, Solved
from ballfg.learning.gradient.conjugate_gradients import ConjugateGradients, GaussNewtonFactors, NotAMinimum
from ballfg.learning.gradient.implicit import GradientMethod, ImplicitGradient, LinearSolver
from ballfg.learning.gradient.objective import BatchObjective, negative_log_likelihood
from ballfg.learning.run.run_folder import MODEL
from ballfg.learning.trainee import BatchLoss, Learned, PredictedShot, Trainee
from ballfg.learning.training_data import TrainingShot
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks.noise import TrackNoise

LOSS_UNIT: Final = 0.01  # m. Squared errors are divided by its square, so that losses are of order one
SOLUTION_TOLERANCE: Final = 1e-5
"""Relative error of the linear solution of each track: far below the scatter between batches."""
NOISE_WORDS: Final = {
    "acceleration": ("m/s²/√Hz", "acceleration that the model lacks"),
    "spin": ("rad/s/√s", "random change of the spin in flight"),
    "contact_velocity": ("m/s", "scatter of the velocity after a bounce"),
    "contact_tangential": ("m/s", "scatter along the surface in addition"),
    "contact_spin": ("rad/s", "scatter of the spin after a bounce"),
}
"""Unit and meaning of each learned number of the process noise."""
MakeSolver = Callable[[GaussNewtonFactors, Tensor], LinearSolver]
"""From the factorisations of a batch and the owners of its numbers (`ConjugateGradients`) to a solver."""
TRAINING_SOLVER: Final[MakeSolver] = partial(ConjugateGradients, tolerance=SOLUTION_TOLERANCE)
COEFFICIENT_STEP: Final = 20.0
"""With a learning rate of 2e-3 a coefficient moves by at most 0.04 standard deviations of its prior in a step."""
NOISE_STEP: Final = 10.0  # With a learning rate of 2e-3 a standard deviation changes by at most 2 % in a step
EMBEDDING_STEP: Final = 3.0  # The embedding's weights, of order one, move faster than a network's


@dataclass(frozen=True)
class ShotPrediction:
    """Predicted less measured positions of some tracks (t, k, 3) m, and the points that count (t, k); else zero."""

    error: Tensor
    counts: Tensor

    def finite(self) -> Tensor:
        """(t,) bool: all points of the track are finite."""
        return self.error.detach().isfinite().all(-1).all(-1)


class EndToEnd(Trainee):
    """Learns a model, an embedding and noise from shots.

    Args:
        shots: all of them; batches are numbers of shots.
        method: of the gradient through the estimate.
        augment: True to rotate and shift shots in training.
        optimizer: solves the estimates, with its tolerance.
        linear_solver: for the Hessians of a batch.
        anchor: distance of the model from the analytic one; None if it is not part of the loss.
        coefficient_step, noise_step: scales of the learning rate, `COEFFICIENT_STEP` and `NOISE_STEP`.
        fades, held_out: shots that trained and that did not, for the use of the model in other rooms.
        untrained: the same shots with the model that one has without a training; None if there is no other.
    """

    def __init__(
        self,
        shots: Sequence[TrainingShot],
        learnables: Learnables,
        loss: LossConfig,
        *,
        method: GradientMethod = ImplicitGradient(),  # noqa: B008 - it has no state
        seed: int = 0,
        augment: bool = False,
        optimizer: LevenbergMarquardt = TRAINING,
        linear_solver: MakeSolver = TRAINING_SOLVER,
        anchor: Anchor | None = None,
        coefficient_step: float = COEFFICIENT_STEP,
        noise_step: float = NOISE_STEP,
        fades: Sequence[int] = (),
        held_out: Sequence[int] = (),
        untrained: "EndToEnd | None" = None,
    ) -> None:
        self.module = self.learnables = learnables
        self.shots, self.settings, self.seed, self.augment = shots, loss, seed, augment
        self.solver = BatchSolver(shots, learnables, optimizer)
        self.method, self.linear_solver, self.anchor = method, linear_solver, anchor
        self.coefficient_step, self.noise_step = coefficient_step, noise_step
        self.fades, self.held_out, self.untrained = tuple(fades), tuple(held_out), untrained
        self.before = self._numbers()
        self.point_loss = Loss() if loss.position_scale is None else Loss("huber", loss.position_scale / LOSS_UNIT)

    def groups(self) -> list[dict[str, Any]]:
        """Noise, embedding, coefficients and the rest of the model, each with its scale on the learning rate."""
        declared = self.learnables.model.declared_coefficients()
        scales = {f"model.{name}": self.coefficient_step * c.sigma for name, c in declared.items()}
        return self.learnables.groups(scales | {"noise.": self.noise_step, "embedding.": EMBEDDING_STEP, "model.": 1.0})

    def after_step(self) -> None:
        """Clip coefficients and noise to their bounds."""
        self.learnables.bound()

    def loss(self, tracks: Sequence[int], epoch: int) -> BatchLoss:
        """The loss on some tracks, its gradient computed already.

        `total` is linear in the parameters and has the value and the derivative of the loss; the likelihood contributes
        its derivative by the noise alone. Tracks without a gradient are thus found here and left out.
        """
        poses = {n: Pose(*augmentation(self.seed, epoch, n)) for n in tracks} if self.augment else {}
        solved, failed = self.solver(tracks, poses)
        while solved:
            try:
                return self._with_gradient(solved, failed, epoch)
            except NotAMinimum as error:
                wrong = set(error.tracks)
                for k in wrong:
                    self.solver.warm.forget(solved[k].number)
                    failed.append((self.shots[solved[k].number].name, str(error)))
                solved = [s for k, s in enumerate(solved) if k not in wrong]
        return BatchLoss.none(failed)

    def _with_gradient(self, solved: Sequence[Solved], failed: Sequence[tuple[str, str]], epoch: int) -> BatchLoss:
        graphs, minima = [s.solution.graph for s in solved], [s.solution.minimum.values for s in solved]
        objective = BatchObjective(graphs, minima)
        layout, leaves = objective.layout, self.learnables.leaves()
        roots = [s.solution.minimum.step.root for s in solved if s.solution.minimum.step is not None]
        factors = GaussNewtonFactors(roots)
        point = self.method(
            lambda: layout.pack(minima),
            lambda at: objective.gradient(at, self.learnables.noise.noise()),
            self.linear_solver(factors, layout.owners()),
            leaves,
        )
        first = layout.unpack(point)[0][list(layout.starts), :STATE_DIM]
        prediction = self.predict(solved, first, epoch)
        wild = (~prediction.finite()).nonzero()[:, 0].tolist()
        if wild:
            raise NotAMinimum("the predicted track is not finite", wild)
        total = self._outer(prediction).sum()
        if self.settings.likelihood > 0.0:
            unlikely = negative_log_likelihood(graphs, minima, factors, self.learnables.noise.noise())
            total = total + self.settings.likelihood * unlikely.sum()
        if self.anchor is not None:
            total = total + self.settings.anchor * len(solved) * self.anchor()
        gradients = torch.autograd.grad(total, leaves, allow_unused=True)
        surrogate = total.detach()
        for leaf, gradient in zip(leaves, gradients, strict=True):
            if gradient is not None:
                surrogate = surrogate + ((leaf - leaf.detach()) * gradient).sum()
        return _batch_loss(surrogate, prediction, failed)

    def judge(self, tracks: Sequence[int]) -> BatchLoss:
        """The loss of predictions to the full horizon, without gradient and augmentation."""
        solved, failed = self.solver(tracks, {})
        if not solved:
            return BatchLoss.none(failed)
        with torch.no_grad():
            prediction = self._judged(solved)
            good = prediction.finite()
            names = [self.shots[s.number].name for s, ok in zip(solved, good.tolist(), strict=True) if not ok]
            failed += [(name, "the predicted track is not finite") for name in names]
            prediction = ShotPrediction(prediction.error[good], prediction.counts[good])
            return _batch_loss(self._outer(prediction).sum(), prediction, failed)

    def shown(self, track: int) -> PredictedShot | None:
        """A track as it is judged: the rollout from its estimated first state, beside the usable samples."""
        solved, _ = self.solver([track], {})
        if not solved:
            return None
        shot, one, prediction = self.shots[track], solved[0], self._judged(solved)
        counted = prediction.counts[0, : len(one.positions)].numpy()
        measured = np.asarray(one.positions)[counted]
        times = (shot.track.times - shot.track.times[shot.observed - 1])[: len(counted)][counted]
        error = prediction.error[0, : len(counted)].numpy()[counted]
        return PredictedShot(shot.name, times, measured, measured + error)

    @torch.no_grad()
    def _judged(self, solved: Sequence[Solved]) -> ShotPrediction:
        """Predictions to the full horizon from the estimated first states."""
        states = [torch.from_numpy(s.solution.minimum.values.states[0]) for s in solved]
        return self.predict(solved, torch.stack(states), None)

    def without_training(self, tracks: Sequence[int]) -> BatchLoss | None:
        """The loss of the analytic model on tracks, where a network is trained."""
        return None if self.untrained is None else self.untrained.judge(tracks)

    def learned(self) -> Sequence[Learned]:
        """Declared coefficients and, where it is learned, the noise."""
        now = self._numbers()
        return [Learned(name, value, now[name][0], unit, words) for name, (value, unit, words) in self.before.items()]

    def _numbers(self) -> dict[str, tuple[float, str, str]]:
        """Value, unit and meaning of each number that is learned, by name."""
        parameters, noise = dict(self.learnables.model.named_parameters()), self.learnables.noise
        found = {
            name: (float(parameters[name].detach()), "" if c.unit == "1" else c.unit, "coefficient of the model")
            for name, c in self.learnables.model.declared_coefficients().items()
            if parameters[name].requires_grad
        }
        if not noise.learned:
            return found
        found |= {name: (value, *NOISE_WORDS[name]) for name, value in noise.values().items()}
        found["position noise"] = (noise.position_scale(), "", "as a multiple of what the dataset states")
        spin, launched = self._spin_noise()
        words = "scatter of the spin about the launcher's setting" if launched else "uncertainty of spin labels"
        found["spin noise"] = (spin, "rad/s", words)
        return found

    def _spin_noise(self) -> tuple[float, bool]:
        """rad/s, present noise of the first spin, and whether it is that about a launcher's setting."""
        settings, scale = self.shots[0].settings, self.learnables.noise.spin_scale()
        if settings.launcher is None:
            return settings.spin_label_noise * scale, False
        return settings.launcher.sigma * scale, True

    def predict(self, solved: Sequence[Solved], first: Tensor, epoch: int | None) -> ShotPrediction:
        """Rollouts over the whole tracks from their first states.

        Args: solved: t estimates.  first: (t, 9) SI units.  epoch: of the horizon; None: the full horizon.
        """
        longest = max(len(self.shots[s.number].track) for s in solved)
        error = first.new_zeros((len(solved), longest, 3))
        counts = torch.zeros((len(solved), longest), dtype=torch.bool)
        groups: defaultdict[Surfaces, list[int]] = defaultdict(list)
        for k, one in enumerate(solved):
            groups[self.shots[one.number].surfaces].append(k)
            shot = self.shots[one.number]
            times, last = shot.track.times, shot.track.times[shot.observed - 1]
            horizon = self.settings.horizon_at(2**62 if epoch is None else epoch, float(times[-1] - last))
            counts[k, : len(times)] = torch.from_numpy(shot.usable & (times <= last + horizon + 1e-9))
        for surfaces, members in groups.items():
            rows = torch.tensor(members)
            difference = self._roll([solved[k] for k in members], first[rows], counts[rows], surfaces)
            error = error.index_put((rows[:, None], torch.arange(difference.shape[1])), difference)
        return ShotPrediction(error, counts)

    def _roll(self, solved: Sequence[Solved], first: Tensor, counts: Tensor, surfaces: Surfaces) -> Tensor:
        """(t, k, 3) m, predicted less measured positions; zero at points that do not count."""
        needed = int(counts.any(0).nonzero().max()) + 1
        times, measured = torch.zeros(len(solved), needed, dtype=torch.float64), first.new_zeros(len(solved), needed, 3)
        for k, one in enumerate(solved):
            stamps = torch.from_numpy(self.shots[one.number].track.times)[:needed]
            times[k, : len(stamps)] = stamps - stamps[0]
            times[k, len(stamps) :] = times[k, len(stamps) - 1]
            measured[k, : len(stamps)] = torch.from_numpy(one.positions[:needed])
        end = times.gather(1, counts[:, :needed].long().cumsum(1).argmax(1, keepdim=True))
        states = paths(self.learnables.model, first, torch.minimum(times, end), surfaces)
        return torch.where(counts[:, :needed, None], states[..., POSITION] - measured, 0.0)

    def _outer(self, prediction: ShotPrediction) -> Tensor:
        """(t,) mean loss over the points of each track."""
        square = (prediction.error / LOSS_UNIT).square().sum(-1)
        return self.point_loss.of_square(square).sum(-1) / prediction.counts.sum(-1)

    def memory(self) -> dict[str, Tensor]:
        """Warm starts of the estimates."""
        return self.solver.warm.tensors()

    def remember(self, memory: dict[str, Tensor]) -> None:
        """Restore warm starts."""
        self.solver.warm.take(memory)

    def trained_model(self) -> BallModel:
        """The model with the noise and the launcher that were learned with it, and what it needs in other rooms."""
        elsewhere, noise = self._faded(), self.learnables.noise
        spin, launched = self._spin_noise()
        self.learnables.model.trained = Trained(
            process_noise={**vars(noise.start), **noise.values()},
            position_scale=noise.position_scale(),
            launcher=self.learnables.embedding,
            spin_noise=spin if noise.learned or launched else None,
            rooms=tuple(dict.fromkeys(self.shots[number].room for number in self.fades)) if elsewhere else (),
            elsewhere=elsewhere,
        )
        if noise.learned and isinstance(self.learnables.model, LearnedModel) and self.learnables.model.base is not None:
            self.learnables.model.base.noise = None  # it would take precedence over the learned one
        return self.learnables.model

    def _faded(self) -> TrackNoise | None:
        """Let the correction of a residual network fade outside of the shots that trained.

        Returns: the noise in their rooms; None where nothing fades.
        """
        model = self.learnables.model
        if not (self.fades and isinstance(model, LearnedModel) and isinstance(model.base, AnalyticModel)):
            return None
        model.fading = None
        solved, _ = self.solver(self.fades, {})
        states = training_states(model, self.shots, solved)
        if not states:
            return None
        model.fading = fading_of(model, states)
        noise = noise_elsewhere(model.base, [self.shots[number] for number in self.fades])
        if noise is not None:
            share = strength_abroad(model, noise, [self.shots[number] for number in self.held_out])
            model.fading.abroad = torch.tensor(share, dtype=torch.float64)
        return noise

    def export(self, folder: Path) -> Path:
        """Write the trained model. Returns: its file, for `--model` of other commands."""
        save_model(self.trained_model(), folder / MODEL)
        return folder / MODEL


def _batch_loss(total: Tensor, prediction: ShotPrediction, failed: Sequence[tuple[str, str]]) -> BatchLoss:
    squared = float(prediction.error.detach().square().sum())
    return BatchLoss(total, len(prediction.error), squared, int(prediction.counts.sum()), tuple(failed))
