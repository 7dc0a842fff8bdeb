"""The estimate of a long track, from the minimum that its sections have together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation import Contact
from ballfg.estimation.smoother.grip import rival_note
from ballfg.estimation.smoother.near_contact import other_sides
from ballfg.estimation.smoother.pieces.chain import Point
from ballfg.estimation.smoother.pieces.joining import Joined, joined_minimum, moved, watched
from ballfg.estimation.smoother.pieces.reduction import Reduction
from ballfg.estimation.smoother.pieces.section import State
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.estimation.smoother.solution import Solution, timed_contacts
from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, Convergence, Minimum
from ballfg.factors.linear.covariance import Covariances
from ballfg.state import SPIN, STATE_DIM
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.estimation.smoother.smoother import Smoother


@dataclass(frozen=True)
class Smoothed:
    """A section of the estimate, with n states: those of the section.

    Attributes:
        values: at the minimum.
        covariances: (n, 9, 9), and
        cross: (n, 9, p) with the coefficients, as in an `Estimate`.
        others: by the index of a state near a contact (9, 9), as `Estimate.other_sides`.
        innovations: of the section's measurements, by name of the observation.
        contacts: counted from the section's first sample.
    """

    values: Values
    covariances: Array
    cross: Array
    others: Mapping[int, Array]
    innovations: Mapping[str, Array]
    contacts: tuple[Contact, ...]


def in_pieces(smoother: Smoother, track: Track, length: int | None = None) -> Estimate | None:
    """The estimate of a long track.

    Args: smoother: of the track.  track: prepared.  length: samples of a piece, about.
    Returns: None where pieces cannot be joined, because no finite motion explains one of them.
    """
    found = joined_minimum(smoother, track, length)
    if found is None:
        return None
    end = found.found
    tasks = [
        (state, joint, end.chain.target(k))
        for k, (state, joint) in enumerate(zip(end.states, end.chain.covariances(), strict=True))
    ]
    return _assembled(smoother, track, found, tasks)


def smoothed(smoother: Smoother, task: tuple[State, Array, Point]) -> Smoothed:
    """A section of the estimate.

    Args:
        smoother: of the track.
        task: the section, the joint covariance of its ends and the coefficients, and where the last step leads them.
    """
    state, joint, target = task
    section, values = state.section, state.values
    problem = smoother.problem(section.track, section.segmentation)
    reduction = Reduction(section.linearized(problem, values), values)
    values = moved(reduction, values, target)
    known = reduction.covariances(joint)
    covariances = np.ascontiguousarray(known.states[:, :STATE_DIM, :STATE_DIM])
    contacts = _contacts(problem, state, values)
    times = section.inside(section.track.times)
    world = smoother.model, smoother.surfaces
    sides = other_sides(times, values.states, covariances, contacts, *world, at_end=section.ends)
    near = np.flatnonzero(sides.any(axis=(1, 2)))
    innovations = _innovations(problem, state, values, known)
    cross = np.ascontiguousarray(known.cross[:, :STATE_DIM, : problem.width])
    return Smoothed(values, covariances, cross, {int(k): sides[k] for k in near}, innovations, contacts)


def _contacts(problem: TrackProblem, state: State, values: Values) -> tuple[Contact, ...]:
    """The section's contacts with the times that the estimate gives them."""
    section = state.section
    graph = BallGraph(tuple(section.own(problem)))
    minimum = Minimum(section.padded_values(values), 0.0, None, Convergence.CONVERGED, 0)
    found = timed_contacts(section.track.times, Solution(section.events, graph, minimum))
    return tuple(replace(contact, interval=contact.interval - section.first) for contact in found)


def _innovations(problem: TrackProblem, state: State, values: Values, known: Covariances) -> dict[str, Array]:
    """Of the section's own measurements. What is known of its ends stands in for the samples beyond them."""
    section = state.section
    around = Covariances(section.padded(known.states), known.coefficients, section.padded(known.cross))
    found = problem.innovations(section.padded_values(values), around)
    return {one.name: found[one.name][section.owns(np.asarray(one.state))] for one in problem.observations}


def _assembled(smoother: Smoother, track: Track, found: Joined, tasks: list[tuple[State, Array, Point]]) -> Estimate:
    """The estimate from all sections; each state is told by the section that begins with it, or holds it inside."""
    n, end = len(track), found.found
    first = end.states[0].section
    problem = smoother.problem(first.track, first.segmentation)
    own = slice(0, problem.width)
    states, covariances = np.empty((n, STATE_DIM)), np.empty((n, STATE_DIM, STATE_DIM))
    cross, others = np.empty((n, STATE_DIM, problem.width)), np.zeros((n, STATE_DIM, STATE_DIM))
    innovations: dict[str, list[Array]] = {one.name: [] for one in problem.observations}
    contacts: list[Contact] = []
    coefficients = np.zeros(0)
    for begin, last, part in zip(
        found.cuts[:-1], found.cuts[1:], watched(partial(smoothed, smoother), tasks, "smoothed"), strict=True
    ):
        inside = slice(begin, last + 1)
        states[inside], covariances[inside], cross[inside] = part.values.states, part.covariances, part.cross
        for k, side in part.others.items():
            others[begin + k] += side
        for name, whitened in part.innovations.items():
            innovations[name].append(whitened)
        contacts += [replace(contact, interval=contact.interval + begin) for contact in part.contacts]
        coefficients = part.values.coefficients
    for k in sorted({k for c in contacts for k in (c.interval, c.interval + 1)} | {n - 1}):
        covariances[k] += others[k]
    known, rest = end.chain.coefficient_covariance, slice(problem.width, len(coefficients))
    at_minimum = end.convergence in (Convergence.CONVERGED, Convergence.AT_KINK)
    minimum = Minimum(Values(states, coefficients), end.error, None, end.convergence, end.rounds)
    rival = Solution(first.events, BallGraph(()), minimum, found.rival)
    return Estimate(
        name=track.name,
        times=track.times,
        states=states,
        covariances=covariances,
        other_sides=others,
        status=Status.OK if at_minimum else Status.NOT_CONVERGED,
        innovations={name: np.concatenate(parts) for name, parts in innovations.items()},
        coefficient_names=tuple(smoother.settings.coefficients),
        coefficients=coefficients[own],
        coefficient_covariance=known[own, own],
        cross_covariances=cross,
        unknown_names=problem.unknowns.names,
        unknowns=problem.unknowns.origins + coefficients[rest],
        unknown_covariance=known[rest, rest],
        contacts=tuple(contacts),
        hits=found.segmentation.hits,
        quality=found.segmentation.quality,
        error=end.error,
        iterations=end.rounds,
        world=smoother.world,
        notes=smoother.doubts(track) + rival_note(rival, covariances[0, SPIN, SPIN]),
    )
