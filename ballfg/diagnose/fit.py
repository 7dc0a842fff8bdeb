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
from ballfg.state import SPIN, STATE_DIM

Array = NDArray[np.float64]

HUBER = 3.0
"""Norm of a whitened position residual (three coordinates) beyond which a sample counts less."""
LABEL_CAUCHY = 3.0
"""Scale of the robust weight of a spin label, in its standard deviations: labels were seen to contradict the flight."""
GROUP_SPIN_SIGMA = 150.0
"""rad/s, prior of the mean spin of a launcher group, per axis, about zero."""
MOST_STEPS = 25
"""Gauss-Newton steps of one minimisation."""
SCALE_ROUNDS = 3
"""Noise and weights are settled after so many minimisations."""
TOLERANCE = 1e-5
"""A minimisation ends when the objective falls by less than this share and this number."""
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e6
LEAST_GROUP = 3
"""Tracks that a launcher group must have to get a mean spin of its own."""


@dataclass(frozen=True)
class Unknowns:
    """Everything that a fit estimates.

    Attributes:
        starts: (n, 9) first states.
        values: coefficients by parameter name.
        spins: (g, 3) rad/s, mean spin of each launcher group.
    """

    starts: Array
    values: dict[str, float]
    spins: Array


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
    """

    model: BallModel
    stretches: Stretches
    free: Mapping[str, Coefficient]

    @property
    def centres(self) -> Array:
        """(q,) prior means: the model's own values."""
        parameters = dict(self.model.named_parameters())
        return np.array([float(parameters[name].detach()) for name in self.free])

    @property
    def precisions(self) -> Array:
        """(q,) of the priors."""
        return np.array([c.sigma**-2 for c in self.free.values()])


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
        return np.asarray((self.problem.stretches.positions.numpy() - self.predicted.positions) / self.sigmas)


def whitened_spins(problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted) -> tuple[Array, Array]:
    """(n, 3) whitened residual of each spin against its label or its group's mean, and (n,) whether it has a label."""
    labels = problem.stretches.labels.numpy()
    labelled = ~np.isnan(labels[:, 0])
    group = problem.stretches.group
    mean = np.where(group[:, None] >= 0, unknowns.spins[group], 0.0) if len(unknowns.spins) else 0.0
    unlabelled = (mean - unknowns.starts[:, SPIN]) / noise.spin
    with np.errstate(invalid="ignore"):
        about = (labels - predicted.labels) / noise.label
    return np.where(labelled[:, None], about, unlabelled), labelled


def robust(whitened: Array, spins: Array, labelled: NDArray[np.bool_]) -> tuple[Array, Array, float]:
    """Weights (n, k) of samples, (n,) of spins, and the sum of the losses."""
    length = np.linalg.norm(whitened, axis=-1)
    weight = np.minimum(1.0, HUBER / np.maximum(length, HUBER))
    loss = np.where(length <= HUBER, 0.5 * length**2, HUBER * length - 0.5 * HUBER**2)
    square = (spins**2).sum(axis=-1)
    spin_weight = np.where(labelled, 1.0 / (1.0 + square / LABEL_CAUCHY**2), 1.0)
    spin_loss = np.where(labelled, 0.5 * LABEL_CAUCHY**2 * np.log1p(square / LABEL_CAUCHY**2), 0.5 * square)
    return weight, spin_weight, float(loss.sum() + spin_loss.sum())


def assemble(
    problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted, derivative: Sensitivity
) -> System:
    """The whitened, robustly weighted rows; common columns are coefficients, then group spins."""
    stretches = problem.stretches
    n, k = stretches.times.shape
    sigma = stretches.sigmas.numpy() * noise.position
    whitened = (stretches.positions.numpy() - predicted.positions) / sigma
    spins, labelled = whitened_spins(problem, unknowns, noise, predicted)
    weight, spin_weight, _ = robust(whitened, spins, labelled)
    root, spin_root = np.sqrt(weight)[..., None], np.sqrt(spin_weight)[:, None]
    q, g = derivative.positions.shape[-1] - STATE_DIM, len(unknowns.spins)
    rows = (derivative.positions * (root / sigma)[..., None]).reshape(n, 3 * k, -1)
    spin_rows = np.zeros((n, 3, STATE_DIM + q))
    spin_rows[:, range(3), range(SPIN.start, SPIN.stop)] = 1.0 / noise.spin
    by_label = derivative.labels / noise.label
    spin_rows = np.where(labelled[:, None, None], by_label, spin_rows) * spin_root[..., None]
    by_group = np.zeros((n, 3 * k + 3, 3 * g))
    for i in np.flatnonzero(~labelled & (stretches.group >= 0)) if g else ():
        by_group[i, 3 * k + np.arange(3), 3 * stretches.group[i] + np.arange(3)] = -1.0 / noise.spin
    both = np.concatenate((rows, spin_rows), axis=1)
    residual = np.concatenate(((whitened * root).reshape(n, -1), spins * spin_root), axis=1)
    return System(residual, both[..., :STATE_DIM], np.concatenate((both[..., STATE_DIM:], by_group), axis=-1))


def linearise(problem: Problem, unknowns: Unknowns, noise: Noise, predicted: Predicted) -> System:
    """The system at some unknowns."""
    derivative = sensitivity(
        problem.model, problem.stretches, unknowns.starts, unknowns.values, tuple(problem.free), by_start=True
    )
    return assemble(problem, unknowns, noise, predicted, derivative)


def start_from(problem: Problem, label_noise: float, spin_prior: float) -> tuple[Unknowns, Noise]:
    """Where a fit starts that knows nothing better."""
    groups = int(problem.stretches.group.max(initial=-1)) + 1
    values = dict(zip(problem.free, problem.centres.tolist(), strict=True))
    unknowns = Unknowns(problem.stretches.starts.numpy().copy(), values, np.zeros((groups, 3)))
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
    whitened = (problem.stretches.positions.numpy() - predicted.positions) / (
        problem.stretches.sigmas.numpy() * noise.position
    )
    spins, labelled = whitened_spins(problem, unknowns, noise, predicted)
    cost = robust(whitened, spins, labelled)[2]
    values = np.array([unknowns.values[name] for name in problem.free])
    cost += 0.5 * float((problem.precisions * (values - problem.centres) ** 2).sum())
    cost += 0.5 * float((unknowns.spins**2).sum()) / GROUP_SPIN_SIGMA**2
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


def _moved(problem: Problem, unknowns: Unknowns, system: System, damping: float) -> Unknowns:
    """The unknowns after a damped Gauss-Newton step; coefficients stay within their bounds."""
    q, g = len(problem.free), len(unknowns.spins)
    values = np.array([unknowns.values[name] for name in problem.free])
    precision = np.concatenate((problem.precisions, np.full(3 * g, GROUP_SPIN_SIGMA**-2)))
    pull = precision * np.concatenate((problem.centres - values, -unknowns.spins.ravel()))
    eliminated = system.eliminated(damping)
    step = eliminated.common_step(precision, pull, damping) if q + 3 * g else np.zeros(0)
    low = np.array([c.low for c in problem.free.values()])
    high = np.array([c.high for c in problem.free.values()])
    moved = np.clip(values + step[:q], low, high)
    starts = unknowns.starts + eliminated.start_step(np.concatenate((moved - values, step[q:])))
    return Unknowns(starts, dict(zip(problem.free, moved.tolist(), strict=True)), unknowns.spins + step[q:].reshape(g, 3))


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
