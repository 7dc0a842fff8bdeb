"""Assembles the estimate of a long track from the common minimum of its sections."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.observations.observation import Unknowns
from ballfg.estimation.plausible import plausible
from ballfg.estimation.result import Estimate, Status, joined
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.settings import sample_sigmas
from ballfg.estimation.sides.monitor import Shared, widening_near_contacts, widening_near_hits
from ballfg.estimation.smoother.pieces.joining import Joined, joined_minimum, watched
from ballfg.estimation.smoother.pieces.reduction import Point, Reduction
from ballfg.estimation.smoother.pieces.section import Section, State
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.estimation.smoother.second_look.at_end import with_both_sides
from ballfg.estimation.smoother.second_look.low_hops import uncounted_note, with_low_hops
from ballfg.estimation.smoother.second_look.spin_ambiguity import rival_note
from ballfg.estimation.smoother.settle import Solution, timed_contacts
from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph, Convergence, Minimum
from ballfg.factors.linear.covariance import Covariances
from ballfg.state import STATE_DIM
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.estimation.smoother.smoother import Smoother


@dataclass(frozen=True)
class Smoothed:
    """A section of the estimate, with the section's n states.

    Attributes:
        values: at the minimum.  covariances: (n, 9, 9), and
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


def in_pieces(smoother: "Smoother", track: Track, length: int | None = None) -> Estimate | None:
    """The estimate of a long, prepared track; None if pieces cannot be joined: one has no finite explanation."""
    parts = sections(smoother, track, length)
    if parts is None:
        return None
    first = next(parts)
    return joined(first, track.times, chain((first,), parts), lambda known, own: own if own.failed else known)


def sections(smoother: "Smoother", track: Track, length: int | None = None) -> Iterator[Estimate] | None:
    """The estimate of a long track, section by section, with the whole's status; None as for `in_pieces`."""
    found = joined_minimum(smoother, track, length)
    return None if found is None else _sections(smoother, track, found)


def smoothed(smoother: "Smoother", task: tuple[State, Array, Point]) -> Smoothed:
    """A section of the estimate, from the joint covariance of its ends and the coefficients, and their target."""
    state, joint, target = task
    section, values = state.section, state.values
    problem = smoother.problem(section.track, section.segmentation)
    reduction = Reduction(section.linearized(section.own(problem), values), values)
    step = target.since(Point.of(values))
    values = values.retract(reduction.steps(step), step.coefficients)
    known = reduction.covariances(joint)
    covariances = np.ascontiguousarray(known.states[:, :STATE_DIM, :STATE_DIM])
    contacts = _contacts(problem, section, values)
    times = section.track.times[section.first : section.last + 1]
    own = slice(problem.width)
    cross = np.ascontiguousarray(known.cross[:, :STATE_DIM, own])
    shared = Shared(values.coefficients[own], known.coefficients[own, own], cross)
    sides = widening_near_contacts(times, values.states, covariances, contacts, problem.ball, shared)
    events = section.events.segmentation
    struck = np.setdiff1d(events.hits, [*events.restarts, *(c.interval + section.first for c in contacts)])
    struck = struck[(struck >= section.first) & (struck < section.last)] - section.first
    sides += widening_near_hits(times, values.states, covariances, struck, problem.ball, shared)
    near = np.flatnonzero(sides.any(axis=(1, 2)))
    # the covariance of its ends stands for the samples beyond them
    around = Covariances(section.padded(known.states), known.coefficients, section.padded(known.cross))
    found = problem.innovations(section.events, section.padded_values(values), around)
    innovations = {one.name: found[one.name][section.owns(np.asarray(one.state))] for one in problem.observations}
    return Smoothed(values, covariances, cross, {int(k): sides[k] for k in near}, innovations, contacts)


def _contacts(problem: TrackProblem, section: Section, values: Values) -> tuple[Contact, ...]:
    """The section's contacts with their estimated times."""
    graph = BallGraph(tuple(section.own(problem)))
    minimum = Minimum(section.padded_values(values), 0.0, None, Convergence.CONVERGED, 0)
    found = timed_contacts(section.track.times, Solution(section.events, graph, minimum))
    return tuple(replace(contact, interval=contact.interval - section.first) for contact in found)


def _sections(smoother: "Smoother", track: Track, found: Joined) -> Iterator[Estimate]:
    """The estimates of the sections, in order. The last state of each is the first of the next one."""
    hops = smoother.low_hops(track, found.segmentation)
    doubts = (*smoother.doubts(track), *uncounted_note(hops, track.times))
    beginning = found.states[0].section
    unknowns = smoother.problem(beginning.track, beginning.segmentation).unknowns  # those of all sections
    targets = (found.chain.target(k) for k in range(len(found.states)))
    tasks = list(zip(found.states, found.chain.covariances(), targets, strict=True))
    before = np.zeros((STATE_DIM, STATE_DIM))
    bounds = zip(found.cuts[:-1], found.cuts[1:], strict=True)
    for (first, last), part in zip(bounds, watched(partial(smoothed, smoother), tasks, "smoothed"), strict=True):
        count = last - first + (last == len(track) - 1)
        others = np.zeros((count, STATE_DIM, STATE_DIM))
        others[0] = before
        for k in (k for k in part.others if k < count):
            others[k] += part.others[k]
        before = part.others.get(count, np.zeros((STATE_DIM, STATE_DIM)))
        notes: tuple[str, ...] = ()
        if first == 0:
            minimum = Minimum(part.values, found.error, None, found.convergence, found.rounds)
            solution = Solution(beginning.events, BallGraph(()), minimum, found.rival)
            notes = (*doubts, *rival_note(solution, part.covariances[0]))
        section = replace(_section(smoother, track, unknowns, found, part, others, first), notes=notes)
        if last == len(track) - 1:
            ending = track.between(float(track.times[first]), float(track.times[last]))
            section = with_both_sides(smoother, smoother.problem(ending), section)
        yield with_low_hops(section, [one for h in hops if (one := h.select(first, first + count))], smoother.model)


def _section(
    smoother: "Smoother", track: Track, unknowns: Unknowns, found: Joined, part: Smoothed, others: Array, first: int
) -> Estimate:
    """The estimate of the section from sample `first` on, without notes."""
    events, count = found.segmentation, len(others)
    coefficients, known = part.values.coefficients, found.chain.coefficient_covariance
    width = len(coefficients) - len(unknowns.names)
    own, rest = slice(0, width), slice(width, len(coefficients))
    at_minimum = found.convergence in (Convergence.CONVERGED, Convergence.AT_KINK)
    inside = slice(first, first + count)
    stated = None if track.sigmas is None else track.sigmas[inside]
    measured = Track(track.times[inside], track.positions[inside], stated)
    estimate = Estimate(
        name=track.name,
        times=measured.times,
        states=part.values.states[:count],
        covariances=part.covariances[:count],
        status=Status.OK if at_minimum else Status.NOT_CONVERGED,
        innovations=part.innovations,
        coefficient_names=tuple(smoother.settings.coefficients),
        coefficients=coefficients[own],
        coefficient_covariance=known[own, own],
        cross_covariances=part.cross[:count],
        unknown_names=unknowns.names,
        unknowns=unknowns.origins + coefficients[rest],
        unknown_covariance=known[rest, rest],
        contacts=part.contacts,
        hits=events.hits[(events.hits >= first) & (events.hits < first + count)] - first,
        quality=events.quality[inside],
        error=found.error,
        iterations=found.rounds,
        world=smoother.world,
    )
    sigma = sample_sigmas(smoother.settings, count, stated)
    estimate = plausible(estimate, measured, sigma, smoother.settings)
    return replace(estimate, covariances=estimate.covariances + others, other_sides=others)
