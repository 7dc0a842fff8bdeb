"""A minimised graph, and where it says that the contacts are."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.plausible import measured_only
from ballfg.estimation.result import Status
from ballfg.estimation.segmentation import Contact
from ballfg.estimation.smoother.motion import contacts_by_interval
from ballfg.estimation.smoother.problem import Events, TrackProblem, contact_batches
from ballfg.factors.dynamics import DynamicsFactors
from ballfg.factors.graph import BallGraph, Convergence, Minimum
from ballfg.factors.linear.covariance import Covariances
from ballfg.state import STATE_DIM

ROUGH = 1e-2
"""Posterior standard deviations. Where contacts and hits lie shows at minima that are known to this; only the last one
is found to the optimizer's own tolerance."""
BROKEN = 8.0
"""Norm of a whitened dynamics residual (9 dimensions) beyond which its interval hides a hit; chance: one in 1e9."""


@dataclass(frozen=True)
class Solution:
    """A minimised graph and the events it was built on."""

    events: Events
    graph: BallGraph
    minimum: Minimum
    rival: Array | None = None
    """(3,) rad/s, first spin of another minimum that is nearly as low, where one was found."""


def places_of(contacts: tuple[Contact, ...]) -> tuple[tuple[int, float], ...]:
    """Interval and height of each."""
    return tuple((c.interval, c.height) for c in contacts)


def timed_contacts(times: Array, solution: Solution) -> tuple[Contact, ...]:
    """The contacts with the times that the estimate gives them; unchanged where it gives none."""
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
    """The interval whose dynamics factor is broken most, if any is; intervals with a hit have theirs in the noise."""
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
    """How the estimate of a track ended.

    Args: linked: intervals between samples over which the motion of the ball is followed.
    """
    if minimum.convergence is Convergence.NOT_FINITE or minimum.step is None:
        return Status.FAILED
    if linked < 1:
        return Status.NO_VELOCITY
    at_minimum = minimum.convergence in (Convergence.CONVERGED, Convergence.AT_KINK)
    return Status.OK if at_minimum else Status.NOT_CONVERGED


def prior_covariances(problem: TrackProblem) -> Covariances:
    """What is known of each state by itself, where the graph could not be solved."""
    coefficients = problem.coefficient_sigmas
    _, states = measured_only(problem.track.positions, problem.sigma, problem.settings)
    return Covariances(states, np.diag(coefficients**2), np.zeros((len(states), STATE_DIM, len(coefficients))))
