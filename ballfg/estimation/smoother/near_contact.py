"""Stamps so close to a contact that the sample may lie on either side of it."""

import math
from dataclasses import replace

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.integrate import fly
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.plausible import possible
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation import Contact
from ballfg.state import VZ, Z

FAR = 4.0
"""Standard deviations of a contact's time beyond which a stamp is taken to lie on one side of it."""
LEAST_SPEED = 1e-3
"""m/s, least vertical speed in the uncertainty of a contact's time."""


def with_other_sides(estimate: Estimate, model: BallModel, surfaces: Surfaces) -> Estimate:
    """The estimate, its covariances with the chance that a ball is on the other side of a near contact.

    Args: estimate: without it.  model: the ball.  surfaces: what it may bounce on.
    """
    if estimate.status.failed:  # its states do not know of contacts
        return replace(estimate, other_sides=np.zeros_like(estimate.covariances))
    others = other_sides(estimate.times, estimate.states, estimate.covariances, estimate.contacts, model, surfaces)
    return replace(estimate, covariances=estimate.covariances + others, other_sides=others)


def other_sides(
    times: Array,
    states: Array,
    covariances: Array,
    contacts: tuple[Contact, ...],
    model: BallModel,
    surfaces: Surfaces,
    *,
    at_end: bool = True,
) -> Array:
    """What the covariances lack for the chance that a ball is on the other side of a near contact.

    A state within the uncertainty of a contact's time is on the side that the estimate took with probability p and
    on the other with 1 - p. With the jump d between the sides, the covariance about the estimate is larger by p (1 - p)
    d d^T. The contact's time is known to sigma_z / |v_z|, often 0.1 ms: few stamps are concerned. The last sample may
    lie just after a contact that nothing has shown yet.

    Args:
        times: (n,) s.
        states: (n, 9).
        covariances: (n, 9, 9).
        contacts: with the times that the estimate gives them.
        model: the ball.
        surfaces: what it may bounce on.
        at_end: whether the track ends with the last sample; else later ones have shown what comes.
    Returns: (n, 9, 9), to be added; zero far from contacts.
    """
    lacking = np.zeros_like(covariances)
    for contact in contacts:
        for k, beyond in ((contact.interval, contact.interval + 1), (contact.interval + 1, contact.interval)):
            sigma = float(np.sqrt(covariances[k, Z, Z])) / max(abs(float(states[k, VZ])), LEAST_SPEED)
            margin = (contact.time - times[k]) * np.sign(beyond - k) / sigma
            if margin < FAR:
                other = _carried(model, states[beyond], times[k] - times[beyond])
                if possible(other):  # back over a long gap, drag would have been push
                    lacking[k] += _mixture(margin, other - states[k])
    if not at_end:
        return lacking
    last = torch.from_numpy(states[-1])
    height = float(surfaces.height_below(last))
    margin = (
        float(model.gap(last, height).detach()) / float(np.sqrt(covariances[-1, Z, Z]))
        if np.isfinite(height)
        else np.inf
    )
    if margin < FAR and last[VZ] < 0.0:
        with torch.no_grad():
            other = model.after_bounce(last).numpy()
        if possible(other):
            lacking[-1] += _mixture(margin, other - states[-1])
    return lacking


def _mixture(margin: float, jump: Array) -> Array:
    """(9, 9) what the other side adds; on the wrong side of its own contact a state has even chances."""
    chance = 0.5 * math.erfc(max(margin, 0.0) / math.sqrt(2.0))
    return np.asarray(chance * (1.0 - chance) * np.outer(jump, jump))


def _carried(model: BallModel, state: Array, dt: float) -> Array:
    """(9,) a state carried over dt s of free flight: the other side's motion, at this side's stamp."""
    with torch.no_grad():
        return np.asarray(fly(model, torch.from_numpy(state[None]), torch.tensor([dt], dtype=torch.float64))[0])
