"""Assembles the estimate of a long track from the common minimum of its sections."""

from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from itertools import chain
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.plausible import plausible
from ballfg.estimation.result import Estimate, Status, joined, opening
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.settings import sample_sigmas
from ballfg.estimation.sides.monitor import widened_near_contacts
from ballfg.estimation.smoother.pieces.joining import Joined, joined_minimum, watched
from ballfg.estimation.smoother.pieces.reduction import Point, Reduction
from ballfg.estimation.smoother.pieces.section import Section, State, events_of
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


def smoothed(smoother: "Smoother", task: tuple[State, Array, Point]) -> Estimate:
    """A section of the estimate, from the joint covariance of its ends and the coefficients, and their target.

    Its last state is the first of the next section. The covariances are without `other_sides`.
    """
    state, joint, target = task
    section, values = state.section, state.values
    problem = smoother.problem(section.track, section.segmentation)
    reduction = Reduction(section.linearized(section.own(problem), values), values)
    step = target.since(Point.of(values))
    values = values.retract(reduction.steps(step), step.coefficients)
    known = reduction.covariances(joint)
    covariances = np.ascontiguousarray(known.states[:, :STATE_DIM, :STATE_DIM])
    contacts = _contacts(problem, section, values)
    inside, own = slice(section.first, section.last + 1), slice(problem.width)
    events = events_of(section.segmentation, section.first, section.last + 1)
    # the covariance of its ends stands for the samples beyond them
    around = Covariances(section.padded(known.states), known.coefficients, section.padded(known.cross))
    found = problem.innovations(section.events, section.padded_values(values), around)
    innovations = {one.name: found[one.name][section.owns(np.asarray(one.state))] for one in problem.observations}
    estimate = Estimate(
        name=section.track.name,
        times=section.track.times[inside],
        states=values.states,
        covariances=covariances,
        status=Status.OK,
        innovations=innovations,
        coefficient_names=tuple(smoother.settings.coefficients),
        coefficients=values.coefficients[own],
        coefficient_covariance=known.coefficients[own, own],
        cross_covariances=np.ascontiguousarray(known.cross[:, :STATE_DIM, own]),
        unknown_names=problem.unknowns.names,
        unknowns=problem.unknowns.origins + values.coefficients[problem.width :],
        contacts=contacts,
        hits=events.hits,
        quality=events.quality,
    )
    return replace(widened_near_contacts(estimate, problem.ball, events.restarts), covariances=covariances)


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
    targets = (found.chain.target(k) for k in range(len(found.states)))
    tasks = list(zip(found.states, found.chain.covariances(), targets, strict=True))
    before, known = np.zeros((STATE_DIM, STATE_DIM)), found.chain.coefficient_covariance
    at_minimum = found.convergence in (Convergence.CONVERGED, Convergence.AT_KINK)
    bounds = zip(found.cuts[:-1], found.cuts[1:], strict=True)
    for (first, last), part in zip(bounds, watched(partial(smoothed, smoother), tasks, "smoothed"), strict=True):
        count = last - first + (last == len(track) - 1)
        section, width = opening(part, count), len(part.coefficients)
        others = section.other_sides.copy()
        others[0] += before
        before = part.other_sides[-1]
        section = replace(
            section,
            status=Status.OK if at_minimum else Status.NOT_CONVERGED,
            coefficient_covariance=known[:width, :width],
            unknown_covariance=known[width:, width:],
            error=found.error,
            iterations=found.rounds,
            world=smoother.world,
            notes=(*doubts, *rival_note(found.rival, part.states[0], part.covariances[0])) if first == 0 else (),
        )
        stated = None if track.sigmas is None else track.sigmas[first : first + count]
        measured = Track(section.times, track.positions[first : first + count], stated)
        section = plausible(section, measured, sample_sigmas(smoother.settings, count, stated), smoother.settings)
        section = replace(section, covariances=section.covariances + others, other_sides=others)
        if last == len(track) - 1:
            ending = track.between(float(track.times[first]), float(track.times[last]))
            section = with_both_sides(smoother, smoother.problem(ending), section)
        yield with_low_hops(section, [one for h in hops if (one := h.select(first, first + count))], smoother.model)
