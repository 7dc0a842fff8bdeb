"""The joint fit of a declared model: first states stretch by stretch, coefficients and launcher over all of them.

Gauss-Newton with Levenberg's damping; the scale of the noise is estimated along each axis from what is left, and so is
the scatter of unlabelled spins about what the launcher tells. Coefficients have the priors that their effects declare,
so that what the data cannot tell stays put.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.diagnosis.fit.problem import (
    Fit,
    Noise,
    Problem,
    Robust,
    Unknowns,
    common_precision,
    linearise,
    robust,
    weighted_residual,
    whitened_spins,
)
from ballfg.diagnosis.fit.sensitivity import Predicted, predict
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.diagnosis.fit.system import System
from ballfg.dynamics.model import BallModel
from ballfg.state import SPIN, STATE_DIM

Array = NDArray[np.float64]

MOST_STEPS = 15
"""Gauss-Newton steps of one minimisation."""
SCALE_ROUNDS = 3
"""Noise and weights are settled after so many minimisations."""
FOLLOW_UPS = 1
"""Corrections of first states after each step; further ones gain nothing that the next step does not."""
TOLERANCE = 1e-5
"""A minimisation ends when the objective falls by less than this share."""
FIRST_DAMPING, LARGEST_DAMPING = 1e-4, 1e6
NORMAL_MEDIAN = 0.6745
"""Median of the absolute value of a standard normal number."""
LEAST_SPIN_SCATTER = 1.0
"""rad/s. Unlabelled spins are taken to scatter at least so much."""


def start_from(problem: Problem, label_noise: float, spin_prior: float) -> tuple[Unknowns, Noise]:
    """Where a fit starts that knows nothing better."""
    values = dict(zip(problem.free, problem.centres.tolist(), strict=True))
    unknowns = Unknowns(
        problem.stretches.starts.numpy().copy(), values, np.zeros((problem.stretches.settings.shape[1], 3))
    )
    return unknowns, Noise(label=label_noise, spin=spin_prior)


def fit(problem: Problem, unknowns: Unknowns, noise: Noise, *, settle_noise: bool = True) -> Fit:
    """Minimise over all unknowns, and settle the scale of the noise.

    Args:
        unknowns: where to start: every stretch must reach its contacts from there, as those of `followed` do, or the
            result is the start itself, its cost infinite.
        noise: scales to start from; kept as they are unless `settle_noise`.
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
    if not np.isfinite(cost):
        return Fit(problem, unknowns, noise, predicted, cost, steps)
    for _ in range(MOST_STEPS):
        problem = replace(problem, stretches=_with_contacts(problem.stretches, predicted))
        system = linearise(problem, unknowns, noise, predicted)
        weights = robust(problem, unknowns, noise, predicted)
        steps += 1
        improved, tries = False, 0
        while not improved and damping < LARGEST_DAMPING:
            moved = _moved(problem, unknowns, system, damping)
            moved, moved_predicted = _followed_up(problem, moved, noise, system, weights)
            moved_cost = objective(problem, moved, noise, moved_predicted)
            improved, tries = moved_cost < cost, tries + 1
            damping *= 10.0 if not improved else 0.1 if tries == 1 else 1.0
        if not improved:
            break
        gain, cost = cost - moved_cost, moved_cost
        unknowns, predicted = moved, moved_predicted
        if gain < TOLERANCE * max(1.0, cost):
            break
    return Fit(problem, unknowns, noise, predicted, cost, steps)


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
    return Unknowns(
        starts, dict(zip(problem.free, moved.tolist(), strict=True)), unknowns.launcher + step[q:].reshape(-1, 3)
    )


def _followed_up(
    problem: Problem, moved: Unknowns, noise: Noise, system: System, weights: Robust
) -> tuple[Unknowns, Predicted]:
    """First states brought after a step of all unknowns, and the prediction there.

    A step of coefficients times a step of states is what a linearised problem leaves out, and with many samples it is
    much: states take most of it up. No derivative is taken again; a stretch that does not gain stays where it was.
    """
    predicted = predict(problem.model, problem.stretches, moved.starts, moved.values)
    for _ in range(FOLLOW_UPS):
        losses = robust(problem, moved, noise, predicted).losses
        correction = system.start_correction(weighted_residual(problem, moved, noise, predicted, weights))
        closer = replace(moved, starts=moved.starts + correction)
        closer_predicted = predict(problem.model, problem.stretches, closer.starts, closer.values)
        gains = robust(problem, closer, noise, closer_predicted).losses < losses
        moved = replace(moved, starts=np.where(gains[:, None], closer.starts, moved.starts))
        predicted = _chosen(gains, closer_predicted, predicted)
    return moved, predicted


def _chosen(first: NDArray[np.bool_], one: Predicted, other: Predicted) -> Predicted:
    """Of each stretch (n,) either what `one` says or what `other` does."""
    return Predicted(
        np.where(first[:, None, None], one.positions, other.positions),
        np.where(first[:, None], one.labels, other.labels),
        np.where(first[:, None], one.contacts, other.contacts),
    )


def _with_contacts(stretches: Stretches, predicted: Predicted) -> Stretches:
    """The same with the contact times of a prediction as guesses; the old one stays for a contact it has not."""
    found = torch.from_numpy(predicted.contacts)
    return replace(stretches, contacts=torch.where(found.isnan(), stretches.contacts, found))


def followed(model: BallModel, stretches: Stretches, values: Mapping[str, float] | None = None) -> Stretches:
    """Those stretches whose contacts a model reaches from the first guess of their states.

    Args: values: coefficients by parameter name that differ from the model's own, as fitted.
    """
    predicted = predict(model, stretches, stretches.starts.numpy(), values or {})
    reached: NDArray[np.bool_] = np.asarray(np.isfinite(predicted.positions).all(axis=(1, 2)))
    return stretches.take(reached)


def _settled(result: Fit) -> Noise:
    """Noise from what is left: median absolute deviation per axis, with the degrees of freedom that states took."""
    used = result.problem.stretches.used.numpy()
    whitened = result.whitened
    taken = (STATE_DIM - 3) * len(used) / (3.0 * used.sum())
    spread = np.array([np.median(np.abs(whitened[..., a][used])) for a in range(3)]) / NORMAL_MEDIAN
    position = result.noise.position * spread / np.sqrt(1.0 - taken)
    return replace(result.noise, position=position, spin=_spin_scatter(result))


def _spin_scatter(result: Fit) -> float:
    """rad/s: root of the expected square of an unlabelled spin about what its launcher tells, one step of EM."""
    unlabelled = ~result.problem.stretches.labelled
    if not unlabelled.any():
        return result.noise.spin
    system = linearise(result.problem, result.unknowns, result.noise, result.predicted)
    by_start = system.by_start[unlabelled]
    covariance = np.linalg.inv(by_start.swapaxes(-1, -2) @ by_start)[:, SPIN, SPIN]
    about = whitened_spins(result.problem, result.unknowns, result.noise, result.predicted)[unlabelled]
    square = (about * result.noise.spin) ** 2 + np.diagonal(covariance, axis1=-2, axis2=-1)
    return max(float(np.sqrt(square.mean())), LEAST_SPIN_SCATTER)
