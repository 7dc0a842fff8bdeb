"""Tests the 48 frames of spin labels, with other axes or signs, a change too large for a score test.

Spins are estimated from the flights alone, without labels and with the declared coefficients, because coefficients
fitted to wrong labels would be wrong too. The frames in which the labels agree best with these spins are then fitted in
full.
"""

from dataclasses import replace

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.diagnosis.fit.fit import fit_problem
from ballfg.diagnosis.fit.problem import LABEL_LOSS, Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.dynamics.effects.measurement import signed_permutations
from ballfg.state import SPIN

UNLABELLED_SPIN = 200.0
"""rad/s, prior of a spin about zero without labels."""
FRAMES = 48
"""Number of exchanges and reversals of axes, including the identity."""
FRAMES_FITTED = 2
"""Number of frames that are fitted in full."""


def frame_hypotheses(before: Fit, general: Hypothesis) -> list[Hypothesis]:
    """The frames that agree best with the flights.

    Args: before: the fit so far.  general: the hypothesis of any other frame.
    """
    spins, covariances, labels = _spins_without_labels(before)
    frames = signed_permutations().numpy()[1:]
    costs = [_disagreement(labels, spins, covariances, frame, before.noise.label) for frame in frames]
    best = frames[np.argsort(costs)[:FRAMES_FITTED]].reshape(-1, 9).tolist()
    shapes = [dict(zip(general.coefficients, frame, strict=True)) for frame in best]
    return [Hypothesis(general.effect, shape, (), FRAMES - 1) for shape in shapes]


def _spins_without_labels(before: Fit) -> tuple[Array, Array, Array]:
    """(n, 3) spins from the flights alone, their covariances (n, 3, 3) and labels (n, 3), of labelled stretches."""
    problem = before.problem
    labelled = problem.stretches.take(problem.stretches.labelled)
    bare = replace(labelled, labels=torch.full_like(labelled.labels, torch.nan), settings=0.0 * labelled.settings)
    starts = before.unknowns.starts[problem.stretches.labelled]
    unknowns = replace(before.unknowns, starts=starts, values=problem.declared)
    alone = replace(problem, stretches=bare, shared=False)
    result = fit_problem(alone, unknowns, replace(before.noise, spin=np.full(3, UNLABELLED_SPIN)), settle_noise=False)
    covariances = np.linalg.inv(result.linearised.start_information)[:, SPIN, SPIN]
    return result.unknowns.starts[:, SPIN], np.asarray(covariances), labelled.labels.numpy()


def _disagreement(labels: Array, spins: Array, covariances: Array, frame: Array, noise: float) -> float:
    """Robust squared distance between spins and labels in a frame (3, 3)."""
    covariance = frame @ covariances @ frame.T + noise**2 * np.eye(3)
    apart = labels - spins @ frame.T
    square = (apart * np.linalg.solve(covariance, apart[..., None])[..., 0]).sum(axis=-1)
    robust = 2.0 * LABEL_LOSS.value(np.sqrt(square)) + np.linalg.slogdet(covariance)[1]
    return float(robust.sum())
