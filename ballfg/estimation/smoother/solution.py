"""A solution holds a minimised graph with its events and the estimated times of its contacts."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.plausible import measured_only
from ballfg.estimation.result import Status
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.smoother.motion import contacts_by_interval
from ballfg.estimation.smoother.problem import Events, TrackProblem, contact_batches
from ballfg.factors.dynamics import DynamicsFactors
from ballfg.factors.graph import BallGraph, Convergence, Minimum
from ballfg.factors.linear.covariance import Covariances
from ballfg.state import STATE_DIM

ROUGH = 1e-2
"""Posterior standard deviations. Minima of this accuracy show the places of contacts and hits; only the last one is
found to the optimizer's own tolerance."""
BROKEN = 8.0
"""Norm of a whitened dynamics residual (9 dimensions) beyond which its interval hides a hit; chance: one in 1e9."""


@dataclass(frozen=True)
class Solution:
    """A minimised graph and its events."""

    events: Events
    graph: BallGraph
    minimum: Minimum
    rival: Array | None = None
    """(3,) rad/s, first spin of another minimum that is nearly as low, if any."""


def places_of(contacts: tuple[Contact, ...]) -> tuple[tuple[int, float], ...]:
    """Interval and height of each contact."""
    return tuple((c.interval, c.height) for c in contacts)


def timed_contacts(times: Array, solution: Solution) -> tuple[Contact, ...]:
    """The contacts with their estimated times; unchanged without an estimate."""
    grouped = contacts_by_interval(solution.events.contacts)
    timed: list[Contact] = []
    for batch in contact_batches(solution.graph):
        for interval, elapsed in zip(
            batch.variables[:, 0].tolist(), batch.contact_times(solution.minimum.values), strict=True
        ):
            for contact, tau in zip(grouped[interval], elapsed.tolist(), strict=True):
                time = float(times[interval] + tau) if np.isfinite(tau) else contact.time
                timed.append(Contact(interval, time, contact.height))
    return tuple(sorted(timed, key=lambda c: c.time))


def worst_break(solution: Solution) -> int | None:
    """The interval with the largest broken dynamics residual, if any; a hit widens the noise of its interval."""
    worst, where = BROKEN, None
    for batch, rows in zip((b for b in solution.graph.batches if len(b)), solution.minimum.linearized, strict=True):
        if isinstance(batch, DynamicsFactors):
            with np.errstate(over="ignore"):  # broken without measure
                norm = np.linalg.norm(rows.residual, axis=-1)
            norm[np.isin(batch.variables[:, 0], solution.events.segmentation.hits)] = 0.0
            if not norm.max() <= worst:
                worst, where = norm.max(), int(batch.variables[norm.argmax(), 0])
    return where


def status_of(minimum: Minimum, linked: int) -> Status:
    """The status of a track's estimate.

    Args: linked: intervals between samples over which the motion of the ball is followed.
    """
    if minimum.convergence is Convergence.NOT_FINITE or minimum.step is None:
        return Status.FAILED
    if linked < 1:
        return Status.NO_VELOCITY
    at_minimum = minimum.convergence in (Convergence.CONVERGED, Convergence.AT_KINK)
    return Status.OK if at_minimum else Status.NOT_CONVERGED


def prior_covariances(problem: TrackProblem) -> Covariances:
    """Covariance of each state by itself, for a graph that could not be solved."""
    coefficients = problem.coefficient_sigmas
    _, states = measured_only(problem.track.positions, problem.sigma, problem.settings)
    return Covariances(states, np.diag(coefficients**2), np.zeros((len(states), STATE_DIM, len(coefficients))))
