"""Widens covariances to include both sides of a contact, at one stamp and in a whole estimate."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.integrate import fly
from ballfg.estimation.plausible import possible
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.result import Contact
from ballfg.state import STATE_DIM, VZ

FAR: Final = 4.0
"""Standard deviations of a contact's time beyond which a stamp lies on one side of it."""
LEAST_SPEED: Final = 1e-3
"""m/s, least vertical speed in the uncertainty of a contact's time."""
MORE: Final = 3.0
"""Factor on the chance of the less probable side in a covariance,"""
ENOUGH: Final = 0.3
"""up to this. With the chance itself the truth lies within the stated 30 of NEES in 99 of 100 states right after a
bounce, with more it does so in the remaining states too. Chosen on `tests.estimation.both_sides --seed 1`."""
SPREAD: Final = 0.01
"""Chance from which the other side's spread counts fully. A bounce scatters velocity and spin in five directions: a
mixture's covariance has only a share q of that spread, and each of them would add 1 / q to the NEES of a ball that is
on the less probable side after all."""


def widening(near: Array, far: Array, jump: Array, chance: float) -> Array:
    """(9, 9) difference from a covariance of one side of a contact to one that includes both; positive semidefinite.

    Args: near, far: (9, 9) covariances on the two sides.  jump: (9,) from the one to the other.
        chance: of the far side, at most a half.
    """
    share, whole = max(chance, min(MORE * chance, ENOUGH)), min(chance / SPREAD, 1.0)
    root = np.linalg.cholesky(near)  # far - near, in the directions in which it is positive
    half = np.linalg.solve(root, far - near)
    values, axes = np.linalg.eigh(np.linalg.solve(root, half.T))
    more = root @ axes[:, values > 0.0]
    excess = (more * values[values > 0.0]) @ more.T
    return np.asarray(whole * excess + share * np.outer(jump, jump))


@dataclass(frozen=True)
class Shared:
    """Coefficients (p,) estimated with n states, their covariance (p, p), and that with the states (n, 9, p)."""

    mean: Array
    covariance: Array
    cross: Array


def widened_near_contacts(estimate: Estimate, model: BallModel) -> Estimate:
    """The estimate with covariances widened for the chance of the other side of a near contact."""
    if estimate.status.failed:  # its states have no contacts
        return replace(estimate, other_sides=np.zeros_like(estimate.covariances))
    shared = Shared(estimate.coefficients, estimate.coefficient_covariance, estimate.cross_covariances)
    known = (estimate.times, estimate.states, estimate.covariances, estimate.contacts)
    others = widening_near_contacts(*known, model, shared)
    return replace(estimate, covariances=estimate.covariances + others, other_sides=others)


def widening_near_contacts(
    times: Array, states: Array, covariances: Array, contacts: Sequence[Contact], model: BallModel, shared: Shared
) -> Array:
    """(n, 9, 9) to be added near contacts for the chance that a ball is on the other side; zero far from them.

    The estimate fixes the order of contact and stamp. The gap between ball and surface at a stamp is known to a sigma,
    including that of the surface's height, and the contact's time to sigma / |v_z|: often 0.1 ms, so that few stamps
    are concerned.

    Args: times, states, covariances: (n,) s, (n, 9), (n, 9, 9).  contacts: with their estimated times.
        model: the ball, its coefficients in columns after the state.
    """
    lacking = np.zeros_like(covariances)
    sides = [(k, c.interval + (k == c.interval), c) for c in contacts for k in (c.interval, c.interval + 1)]
    if not sides:
        return lacking
    stamps, beyond = (np.array([side[i] for side in sides]) for i in (0, 1))
    sigmas = _gap_sigmas(states[stamps], covariances[stamps], shared, stamps, [c.height for _, _, c in sides], model)
    speeds = np.maximum(np.abs(states[stamps, VZ]), LEAST_SPEED)
    margins = np.array([(c.time - times[k]) * np.sign(b - k) for k, b, c in sides]) * speeds / sigmas
    for i in np.flatnonzero(margins < FAR):
        k, other = stamps[i], beyond[i]
        there = _carried(model, np.append(states[other], shared.mean), times[k] - times[other])
        if possible(there):  # back over a long gap, drag accelerates
            chance = 0.5 * math.erfc(max(float(margins[i]), 0.0) / math.sqrt(2.0))
            lacking[k] += widening(covariances[k], covariances[other], there - states[k], chance)
    return lacking


def _gap_sigmas(
    states: Array, covariances: Array, shared: Shared, stamps: Array, heights: Sequence[float], model: BallModel
) -> Array:
    """(m,) m, standard deviations of the gaps between balls and surfaces."""
    leaf = torch.from_numpy(np.column_stack((states, np.tile(shared.mean, (len(states), 1))))).requires_grad_(True)
    with torch.enable_grad():
        gaps = model.gap(leaf, torch.tensor(heights, dtype=torch.float64))
        (slopes,) = torch.autograd.grad(gaps.sum(), leaf)
    own, rest = slopes.numpy()[:, :STATE_DIM], slopes.numpy()[:, STATE_DIM:]
    variance = np.einsum("mi,mij,mj->m", own, covariances, own)
    variance += np.einsum("mi,ij,mj->m", rest, shared.covariance, rest)
    variance += 2.0 * np.einsum("mi,mij,mj->m", own, shared.cross[stamps], rest)
    return np.asarray(np.sqrt(np.maximum(variance, 0.0)))


def _carried(model: BallModel, state: Array, dt: float) -> Array:
    """(9,) a state carried over dt s of free flight: the other side's motion, at this side's stamp."""
    with torch.no_grad():
        after = fly(model, torch.from_numpy(state[None]), torch.tensor([dt], dtype=torch.float64))
    return np.asarray(after[0, :STATE_DIM])
