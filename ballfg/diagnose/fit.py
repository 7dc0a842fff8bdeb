"""The joint fit of a declared model: first states stretch by stretch, coefficients and group spins over all of them.

Gauss-Newton with Levenberg's damping and Huber's weights; the scale of the noise is estimated along each axis from what
is left. Coefficients have the priors that their effects declare, so that what the data cannot tell stays put.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.diagnose.sensitivity import Predicted, Sensitivity, predict, sensitivity
from ballfg.diagnose.stretches import Stretches
from ballfg.diagnose.system import System
from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.spin_embedding import SOFT_SPEED
from ballfg.state import SPIN, STATE_DIM, VELOCITY

Array = NDArray[np.float64]

HUBER = 3.0
"""Norm of a whitened position residual (three coordinates) beyond which a sample counts less."""
LABEL_CAUCHY = 3.0
"""Scale of the robust weight of a spin label, in its standard deviations: labels were seen to contradict the flight."""
LAUNCHER_SPIN_SIGMA = 150.0
"""rad/s, prior of the spin that a launcher setting of typical size means, per axis, about zero."""
MOST_STEPS = 25
"""Gauss-Newton steps of one minimisation."""
SCALE_ROUNDS = 3
"""Noise and weights are settled after so many minimisations."""
TOLERANCE = 1e-5
"""A minimisation ends when the objective falls by less than this share and this number."""
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e6


@dataclass(frozen=True)
class Unknowns:
    """Everything that a fit estimates.

    Attributes:
        starts: (n, 9) first states.
        values: coefficients by parameter name.
        launcher: (s, 3) rad/s per unit of each launcher setting: spin about forward, across and up.
    """

    starts: Array
    values: dict[str, float]
    launcher: Array


@dataclass(frozen=True)
class Noise:
    """Scale of the noise: of the stated position noise per axis (3,), of spin labels, of unlabelled spins in rad/s."""

    position: Array = field(default_factory=lambda: np.ones(3))
    label: float = 20.0
    spin: float = 60.0


@dataclass(frozen=True)
class Problem:
    """What is fitted to what.

    Attributes:
        model: with every effect that has a coefficient among `free`.
        stretches: the data.
        free: declared coefficients to estimate, by parameter name, with their priors.
        shared: whether what all stretches share is estimated; else only first states are, as when a fit is judged on
            other tracks.
    """

    model: BallModel
    stretches: Stretches
    free: Mapping[str, Coefficient]
    shared: bool = True

    @property
    def centres(self) -> Array:
        """(q,) prior means: the model's own values."""
        parameters = dict(self.model.named_parameters())
        return np.array([float(parameters[name].detach()) for name in self.free])

    @property
    def precisions(self) -> Array:
        """(q,) of the priors of coefficients."""
        return np.array([c.sigma**-2 for c in self.free.values()])

    @property
    def launcher_precision(self) -> Array:
        """(s,) of the priors of launcher settings, each for all three axes."""
        typical = (self.stretches.settings**2).mean(axis=0)
        return np.asarray(np.where(typical > 0.0, typical, 1.0) / LAUNCHER_SPIN_SIGMA**2)


@dataclass(frozen=True)
class Fit:
    """A minimum.

    Attributes:
        problem: what was fitted.
        unknowns: the estimates.
        noise: as estimated with them.
        predicted: at the minimum.
        cost: objective: half the sum of robust losses and prior terms, at that noise.
        steps: Gauss-Newton steps taken in total.
    """

    problem: Problem
    unknowns: Unknowns
    noise: Noise
    predicted: Predicted
    cost: float
    steps: int

    @property
    def sigmas(self) -> Array:
        """(n, k, 3) m, stated noise times its estimated scale; infinite where there is no sample."""
        return np.asarray(self.problem.stretches.sigmas.numpy() * self.noise.position)

    @property
    def whitened(self) -> Array:
        """(n, k, 3) position residuals over their noise; zero where there is no sample."""
        return whitened_positions(self.problem, self.noise, self.predicted)

    @property
    def robust(self) -> Robust:
        """Weights and losses at the minimum."""
        return robust(self.problem, self.unknowns, self.noise, self.predicted)


def launch_axes(starts: Array) -> Array:
    """(n, 3, 3) columns forward (horizontally), across (z x forward) and up of launches (n, 9)."""
    x, y = starts[:, VELOCITY.start], starts[:, VELOCITY.start + 1]
    length = np.sqrt(x**2 + y**2 + SOFT_SPEED**2)
    x, y, zero = x / length, y / length, np.zeros_like(x)
    return np.stack(
        (np.stack((x, y, zero), -1), np.stack((-y, x, zero), -1), np.stack((zero, zero, zero + 1.0), -1)), axis=-1
    )


def whitened_spins(problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted) -> Array:
    """(n, 3) whitened residual of each spin against its label, or where there is none against its launcher."""
    labels, labelled = problem.stretches.labels.numpy(), problem.stretches.labelled
    local = problem.stretches.settings @ unknowns.launcher
    mean = (launch_axes(unknowns.starts) @ local[..., None])[..., 0]
    unlabelled = (mean - unknowns.starts[:, SPIN]) / noise.spin
    with np.errstate(invalid="ignore"):
        about = (labels - predicted.labels) / noise.label
    return np.where(labelled[:, None], about, unlabelled)


@dataclass(frozen=True)
class Robust:
    """Robust weights of samples (n, k) and of spins (n,), and the losses (n,) of stretches."""

    samples: Array
    spins: Array
    losses: Array


def robust(problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted) -> Robust:
    """Huber's weights for positions, Cauchy's for labels, at some unknowns."""
    length = np.linalg.norm(whitened_positions(problem, noise, predicted), axis=-1)
    weight = np.minimum(1.0, HUBER / np.maximum(length, HUBER))
    loss = np.where(length <= HUBER, 0.5 * length**2, HUBER * length - 0.5 * HUBER**2)
    spins, labelled = whitened_spins(problem, unknowns, noise, predicted), problem.stretches.labelled
    square = (spins**2).sum(axis=-1)
    spin_weight = np.where(labelled, 1.0 / (1.0 + square / LABEL_CAUCHY**2), 1.0)
    spin_loss = np.where(labelled, 0.5 * LABEL_CAUCHY**2 * np.log1p(square / LABEL_CAUCHY**2), 0.5 * square)
    return Robust(weight, spin_weight, loss.sum(axis=-1) + spin_loss)


def whitened_positions(problem: Problem, noise: Noise, predicted: Predicted) -> Array:
    """(n, k, 3) measured minus predicted over the noise; zero where there is no sample."""
    sigma = problem.stretches.sigmas.numpy() * noise.position
    return np.asarray((problem.stretches.positions.numpy() - predicted.positions) / sigma)


def assemble(
    problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted, derivative: Sensitivity
) -> System:
    """The whitened, robustly weighted rows; common columns are coefficients, then launcher settings."""
    stretches = problem.stretches
    n, k = stretches.times.shape
    sigma = stretches.sigmas.numpy() * noise.position
    whitened = whitened_positions(problem, noise, predicted)
    spins, labelled = whitened_spins(problem, unknowns, noise, predicted), stretches.labelled
    weights = robust(problem, unknowns, noise, predicted)
    root, spin_root = np.sqrt(weights.samples)[..., None], np.sqrt(weights.spins)[:, None]
    q = derivative.positions.shape[-1] - STATE_DIM
    rows = (derivative.positions * (root / sigma)[..., None]).reshape(n, 3 * k, -1)
    spin_rows = np.zeros((n, 3, STATE_DIM + q))
    spin_rows[:, range(3), range(SPIN.start, SPIN.stop)] = 1.0 / noise.spin
    by_label = derivative.labels / noise.label
    spin_rows = np.where(labelled[:, None, None], by_label, spin_rows) * spin_root[..., None]
    by_launcher = np.zeros((n, 3 * k + 3, unknowns.launcher.size))
    towards = -launch_axes(unknowns.starts)[:, :, None, :] * stretches.settings[:, None, :, None] / noise.spin
    by_launcher[:, 3 * k :] = np.where(labelled[:, None, None], 0.0, towards.reshape(n, 3, -1))
    both = np.concatenate((rows, spin_rows), axis=1)
    residual = np.concatenate(((whitened * root).reshape(n, -1), spins * spin_root), axis=1)
    return System(residual, both[..., :STATE_DIM], np.concatenate((both[..., STATE_DIM:], by_launcher), axis=-1))


def linearise(problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted) -> System:
    """The system at some unknowns."""
    derivative = sensitivity(
        problem.model, problem.stretches, unknowns.starts, unknowns.values, tuple(problem.free), by_start=True
    )
    return assemble(problem, unknowns, noise, predicted, derivative)


def start_from(problem: Problem, label_noise: float, spin_prior: float) -> tuple[Unknowns, Noise]:
    """Where a fit starts that knows nothing better."""
    values = dict(zip(problem.free, problem.centres.tolist(), strict=True))
    unknowns = Unknowns(problem.stretches.starts.numpy().copy(), values, np.zeros((problem.stretches.settings.shape[1], 3)))
    return unknowns, Noise(label=label_noise, spin=spin_prior)


def fit(problem: Problem, unknowns: Unknowns, noise: Noise, *, settle_noise: bool = True) -> Fit:
    """Minimise over all unknowns, and settle the scale of the noise.

    Args:
        unknowns: where to start.  noise: scales to start from; kept as they are unless `settle_noise`.
    """
    result = _minimise(problem, unknowns, noise, 0)
    for _ in range(SCALE_ROUNDS if settle_noise else 0):
        noise = _settled(result)
        result = _minimise(result.problem, result.unknowns, noise, result.steps)
    return result


def objective(problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted) -> float:
    """Half the robust sum of squares, priors included; infinite where a stretch misses a contact."""
    cost = float(robust(problem, unknowns, noise, predicted).losses.sum())
    values = np.array([unknowns.values[name] for name in problem.free])
    cost += 0.5 * float((problem.precisions * (values - problem.centres) ** 2).sum())
    cost += 0.5 * float((problem.launcher_precision[:, None] * unknowns.launcher**2).sum())
    return cost if np.isfinite(cost) else np.inf


def _minimise(problem: Problem, unknowns: Unknowns, noise: Noise, steps: int) -> Fit:
    predicted = predict(problem.model, problem.stretches, unknowns.starts, unknowns.values)
    cost, damping = objective(problem, unknowns, noise, predicted), FIRST_DAMPING
    for _ in range(MOST_STEPS):
        problem = replace(problem, stretches=_with_contacts(problem.stretches, predicted))
        system = linearise(problem, unknowns, noise, predicted)
        steps += 1
        improved = False
        while not improved and damping < LARGEST_DAMPING:
            moved = _moved(problem, unknowns, system, damping)
            moved_predicted = predict(problem.model, problem.stretches, moved.starts, moved.values)
            moved_cost = objective(problem, moved, noise, moved_predicted)
            improved = moved_cost < cost
            damping = damping / 10.0 if improved else damping * 10.0
        if not improved:
            break
        gain, cost = cost - moved_cost, moved_cost
        unknowns, predicted = moved, moved_predicted
        if gain < TOLERANCE * max(1.0, cost):
            break
    return Fit(problem, unknowns, noise, predicted, cost, steps)


def common_precision(problem: Problem) -> Array:
    """(q + 3 s,) precisions of the priors of all common columns."""
    return np.concatenate((problem.precisions, np.repeat(problem.launcher_precision, 3)))


def _moved(problem: Problem, unknowns: Unknowns, system: System, damping: float) -> Unknowns:
    """The unknowns after a damped Gauss-Newton step; coefficients stay within their bounds."""
    q = len(problem.free)
    values = np.array([unknowns.values[name] for name in problem.free])
    precision = common_precision(problem)
    pull = precision * np.concatenate((problem.centres - values, -unknowns.launcher.ravel()))
    eliminated = system.eliminated(damping)
    step = eliminated.common_step(precision, pull, damping) if problem.shared else np.zeros_like(pull)
    low = np.array([c.low for c in problem.free.values()])
    high = np.array([c.high for c in problem.free.values()])
    moved = np.clip(values + step[:q], low, high)
    starts = unknowns.starts + eliminated.start_step(np.concatenate((moved - values, step[q:])))
    return Unknowns(starts, dict(zip(problem.free, moved.tolist(), strict=True)), unknowns.launcher + step[q:].reshape(-1, 3))


def _with_contacts(stretches: Stretches, predicted: Predicted) -> Stretches:
    """The same with the contact times of a prediction as guesses."""
    return replace(stretches, contacts=torch.from_numpy(predicted.contacts))


def _settled(result: Fit) -> Noise:
    """Noise from what is left: median absolute deviation per axis, with the degrees of freedom that states took."""
    used = result.problem.stretches.used.numpy()
    whitened = result.whitened
    taken = (STATE_DIM - 3) * len(used) / (3.0 * used.sum())
    spread = np.array([np.median(np.abs(whitened[..., a][used])) for a in range(3)]) / 0.6745
    return replace(result.noise, position=result.noise.position * spread / np.sqrt(1.0 - taken))
