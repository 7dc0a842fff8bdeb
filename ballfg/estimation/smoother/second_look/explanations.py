"""Asks how often a ball bounced that one camera saw, where each answer puts it at another distance.

Each start leads to an explanation of its own. Their evidence counts: the states integrated out, so that a bounce which
fixes the distance must fit better by what it narrows. What is nearly as probable stays in the covariances.
"""

import math
from collections.abc import Sequence
from dataclasses import replace
from typing import Final

import numpy as np

from ballfg.estimation.result import Estimate
from ballfg.estimation.sides.monitor import FAR
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.estimation.smoother.second_look.at_end import Solved
from ballfg.estimation.smoother.second_look.depths import log_prior_of_size, over_depths
from ballfg.estimation.smoother.second_look.gaps import APART, calmed, evidence, with_other_contacts
from ballfg.estimation.smoother.settle import Other, Solution, arrangement_of, spans_of, timed_contacts
from ballfg.estimation.smoother.smoother import Smoother

OPEN: Final = "how the ball bounced is not certain: covariances hold what is nearly as probable"
FEW_STEPS: Final = 10  # Largest number of linear solutions for a rival, before it is known to count

Weighed = tuple[float, Solved]
"""An explanation after its evidence, nats."""


def most_probable(smoother: Smoother, first: Solved, rivals: Sequence[TrackProblem]) -> Solved:
    """The most probable of a track's explanations; its solution's `others` are nearly as probable.

    Rivals are explained roughly, and those that may count are solved. Those with the same contacts and hits are one.

    Args: first: the problem of the likeliest start, with its solution.  rivals: of the other starts.
    """
    start, calm = arrangement_of(first[1].events), calmed(smoother, FEW_STEPS)
    best = {start: _weighed(smoother, first)}
    tried = [(rival, calm.settle(rival)) for rival in rivals]
    rough = [(_roughly(one) if one[1].events.contacts else math.inf, one) for one in tried]
    highest = best[start][0]
    for found, one in sorted(rough, key=lambda known: -known[0]):
        if found > highest - APART and arrangement_of(one[1].events) not in best:
            solved = one[0], smoother.settle(one[0])
            here = arrangement_of(solved[1].events)
            if here not in best:
                best[here] = _weighed(smoother, solved)
                highest = max(highest, best[here][0])
    (highest, (problem, solution)), *rest = sorted(best.values(), key=lambda known: -known[0])
    others = tuple(Other(*solved, highest - found) for found, solved in rest if found > highest - APART)
    return problem, replace(solution, others=others)


def _roughly(solved: Solved) -> float:
    """nats, the evidence of an explanation wherever its contacts and its distance are."""
    problem, solution = solved
    found = evidence(solved)
    return found + log_prior_of_size(problem, solution.minimum.values) if found > -math.inf else found


def _weighed(smoother: Smoother, solved: Solved) -> Weighed:
    """An explanation with the evidence of all its paths; without contacts, over all distances."""
    problem, solution = solved
    if solution.events.contacts:
        return _roughly(solved) + _log_chance_of_places(smoother, problem, solution), solved
    depths = over_depths(smoother, problem, solution)
    if depths is None:
        return _roughly(solved), solved
    return evidence(solved, depths.evidence), (problem, replace(solution, depths=depths))


def _log_chance_of_places(smoother: Smoother, problem: TrackProblem, solution: Solution) -> float:
    """nats, of contacts that lie among the samples on the same side of the first and the last interval.

    Of a bounce in these, one sample shows the one side, which explains nearly any time of it: beyond the interval the
    path would be another one.
    """
    known = smoother.optimizer.covariances(solution.graph, solution.minimum)
    if known is None:
        return -math.inf
    times, spans, total = problem.track.times, spans_of(problem, solution, known), 0.0
    edges = times[[0, 1, -2, -1]]
    for contact in timed_contacts(times, solution):
        begin, end = spans[contact.interval]
        sigma, place = max(end - begin, 1e-12) / (2.0 * FAR), int(np.clip(np.searchsorted(edges, contact.time), 1, 3))
        low, high = ((edge - contact.time) / sigma for edge in edges[place - 1 : place + 1])
        chance = 0.5 * (math.erf(high / math.sqrt(2.0)) - math.erf(low / math.sqrt(2.0)))
        total += math.log(max(chance, 1e-300))
    return total


def with_explanation(estimate: Estimate, other: Estimate, odds: float, *, one_view: bool) -> Estimate:
    """The estimate with covariances that hold another explanation of its track too; odds: log, of its own."""
    return with_other_contacts(estimate, other, odds, OPEN) if one_view else with_other_contacts(estimate, other, odds)
