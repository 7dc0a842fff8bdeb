"""What a diagnosis fits: the unknowns, their priors and losses, and the linearised rows at some unknowns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from ballfg.diagnosis.fit.sensitivity import Predicted, Sensitivity, sensitivity
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.diagnosis.fit.system import System
from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.networks.spin_embedding import SOFT_SPEED
from ballfg.state import SPIN, STATE_DIM, VELOCITY

Array = NDArray[np.float64]

HUBER = 3.0
"""Norm of a whitened position residual (three coordinates) beyond which a sample counts less."""
LABEL_CAUCHY = 3.0
"""Scale of the robust weight of a spin label, in its standard deviations: labels were seen to contradict the flight."""
LAUNCHER_SPIN_SIGMA = 150.0
"""rad/s, prior of the spin that a launcher setting of typical size means, per axis, about zero."""


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


def weighted_residual(
    problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted, weights: Robust
) -> Array:
    """(n, m) whitened residuals of positions and spins, with the roots of some weights."""
    positions = whitened_positions(problem, noise, predicted) * np.sqrt(weights.samples)[..., None]
    spins = whitened_spins(problem, unknowns, noise, predicted) * np.sqrt(weights.spins)[:, None]
    return np.concatenate((positions.reshape(len(spins), -1), spins), axis=1)


def assemble(
    problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted, derivative: Sensitivity
) -> System:
    """The whitened, robustly weighted rows; common columns are coefficients, then launcher settings."""
    stretches = problem.stretches
    n, k = stretches.times.shape
    sigma = stretches.sigmas.numpy() * noise.position
    labelled = stretches.labelled
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
    residual = weighted_residual(problem, unknowns, noise, predicted, weights)
    return System(residual, both[..., :STATE_DIM], np.concatenate((both[..., STATE_DIM:], by_launcher), axis=-1))


def linearise(problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted) -> System:
    """The system at some unknowns."""
    derivative = sensitivity(
        problem.model, problem.stretches, unknowns.starts, unknowns.values, tuple(problem.free), by_start=True
    )
    return assemble(problem, unknowns, noise, predicted, derivative)


def common_precision(problem: Problem) -> Array:
    """(q + 3 s,) precisions of the priors of all common columns."""
    return np.concatenate((problem.precisions, np.repeat(problem.launcher_precision, 3)))
