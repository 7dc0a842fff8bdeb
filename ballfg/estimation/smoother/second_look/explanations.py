"""Asks how often a ball bounced that one camera saw, where each answer puts it at another distance.

Each start leads to an explanation of its own. Their evidence counts: the states integrated out, so that a bounce which
fixes the distance must fit better by what it narrows. What is nearly as probable stays in the covariances.

Without a bounce the distance stays open. The nearer a path is to the camera, the smaller are its steps, and the less
the noise of the motion costs; but the fewer such paths there are. So the most probable path lies too near, by a
multiple of its sigma. There the distance of one sample is held at each of several values, and counts by the evidence
of all paths there.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final, NamedTuple

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.motion.arrays import gaps
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.sides.monitor import FAR
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.estimation.smoother.second_look.at_end import Solved, log_evidence
from ballfg.estimation.smoother.second_look.gaps import APART, calmed, evidence
from ballfg.estimation.smoother.settle import (
    ROUGH,
    Other,
    Solution,
    arrangement_of,
    initial_states,
    spans_of,
    timed_contacts,
)
from ballfg.estimation.smoother.smoother import AT_MINIMUM, Smoother
from ballfg.factors.batch import Values
from ballfg.factors.graph import BallGraph
from ballfg.factors.linear.covariance import Covariances
from ballfg.factors.prior import PriorFactors
from ballfg.state import POSITION, STATE_DIM, VELOCITY

FEW_STEPS: Final = 10  # Largest number of linear solutions for a rival, before it is known to count
HELD: Final = 1e-3  # Share of a distance, so small that it counts as held
STEP: Final = 0.8  # Standard deviations of the logarithm of the distance, between two distances
LONGEST: Final = 0.25  # Largest step of that logarithm
KNOWN: Final = 0.01  # Its standard deviation below which the most probable path is as good
MOST: Final = 24  # Largest number of steps to either side
NEGLIGIBLE: Final = 7.0  # nats, by which a distance is so much less probable than the best one that the search ends

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


class Held(NamedTuple):
    """The path at a distance, and its part in what is known of that distance."""

    density: float  # nats, of the logarithm of the distance, whatever is in the ball's way
    free: float  # nats, chance that nothing is
    values: Values
    known: Covariances


@dataclass(frozen=True)
class Depths:
    """Paths at several distances from the camera, evenly spaced by `step` in their logarithm."""

    paths: tuple[Held, ...]
    step: float

    @property
    def weights(self) -> Array:
        """(k,) of the paths."""
        densities = np.array([path.density + path.free for path in self.paths])
        shares = np.exp(densities - densities.max())
        return np.asarray(shares / shares.sum())

    @property
    def evidence(self) -> float:
        """nats, of all distances together, as `log_evidence` counts them."""
        return float(np.logaddexp.reduce([path.density + path.free for path in self.paths])) + math.log(self.step)

    @property
    def sigma(self) -> float:
        """Standard deviation of the logarithm of the distance."""
        places = self.step * np.arange(len(self.paths))
        return float(np.sqrt(self.weights @ (places - self.weights @ places) ** 2))

    def onto(self, estimate: Estimate) -> Estimate:
        """The estimate of the most probable path with the mean of all paths and their covariance in its place."""
        weights, n, p = self.weights, len(estimate), len(estimate.coefficients)
        points = np.empty((len(weights), n, STATE_DIM + p))
        inside = np.zeros((n, STATE_DIM + p, STATE_DIM + p))
        for weight, path, point in zip(weights, self.paths, points, strict=True):
            point[:, :STATE_DIM], point[:, STATE_DIM:] = path.values.states, path.values.coefficients[:p]
            inside[:, :STATE_DIM, :STATE_DIM] += weight * path.known.states[:, :STATE_DIM, :STATE_DIM]
            cross = weight * path.known.cross[:, :STATE_DIM, :p]
            inside[:, :STATE_DIM, STATE_DIM:] += cross
            inside[:, STATE_DIM:, :STATE_DIM] += cross.swapaxes(1, 2)
            inside[:, STATE_DIM:, STATE_DIM:] += weight * path.known.coefficients[:p, :p]
        mean = np.einsum("k,kni->ni", weights, points)
        inside += np.einsum("k,kni,knj->nij", weights, points - mean, points - mean)
        loose = estimate.status is Status.DEPTH_UNCERTAIN  # what the most probable path leaves open is not sure
        return replace(
            estimate,
            states=mean[:, :STATE_DIM],
            covariances=inside[:, :STATE_DIM, :STATE_DIM],
            cross_covariances=inside[:, :STATE_DIM, STATE_DIM:],
            coefficients=mean[0, STATE_DIM:],
            coefficient_covariance=inside[0, STATE_DIM:, STATE_DIM:],
            status=estimate.status if loose else Status.OK,
        )


def over_depths(smoother: Smoother, problem: TrackProblem, solution: Solution) -> Depths | None:
    """The paths of a ball without contacts at all distances that are not negligible; None where they show none.

    Args: problem: of a track that one camera saw.  solution: of it.
    """
    search = _Search(smoother, problem, solution)
    sigma = search.sigma()
    if sigma < KNOWN:
        return None
    found = search.walked(min(STEP * sigma, LONGEST))
    if found is not None and found.sigma < found.step:  # the sigma of the most probable path is too large
        found = search.walked(STEP * max(found.sigma, KNOWN))
    return None if found is None or found.sigma < KNOWN else found


def log_prior_of_size(problem: TrackProblem, values: Values) -> float:
    """nats, beside flat priors of the first place and velocity: all sizes of a path are as probable (Jeffreys).

    Paths of one picture differ in their size, which grows with the distance. Flat priors alone make one the more
    probable, the larger it is: by the volumes of places and of velocities. Measured strokes of three views and
    simulated ones chose it among four priors; other simulated ones, from behind, beside and above, judged it.
    """
    return -6.0 * math.log(float(sightings_of(problem.track).lines(values.states[:, POSITION])[1][0]))


class _Search:
    """The paths of one solution with a held distance of the sample in the middle."""

    def __init__(self, smoother: Smoother, problem: TrackProblem, solution: Solution) -> None:
        self.smoother, self.problem, self.solution = smoother, problem, solution
        self.sightings = sightings_of(problem.track)
        self.middle, values = len(problem.track) // 2, solution.minimum.values
        rays, distances = self.sightings.lines(values.states[:, POSITION])
        self.ray, self.distance = rays[self.middle], float(distances[self.middle])
        self.centre = values.states[self.middle, POSITION] - self.distance * self.ray
        self.rough = replace(smoother.optimizer, tolerance=max(ROUGH, smoother.optimizer.tolerance))

    def sigma(self) -> float:
        """Standard deviation of the logarithm of the distance by the most probable path; 1 where none was found."""
        known = self.smoother.optimizer.covariances(self.solution.graph, self.solution.minimum)
        if known is None or self.solution.minimum.convergence not in AT_MINIMUM:
            return 1.0
        spread = self.ray @ known.states[self.middle, POSITION, POSITION] @ self.ray
        return float(np.sqrt(spread) / self.distance)

    def walked(self, step: float) -> Depths | None:
        """The paths at distances to both sides of the first one, as far as they count."""
        begin, sides = self.begin(), list[list[Held]]()
        tried = [self.at(begin, near) for near in (self.solution.minimum.values, self.start())]
        first = max((one for one in tried if one is not None), key=lambda one: one.density, default=None)
        if first is None:
            return None
        best = first.density
        for sign in (1, -1):
            side, before = list[Held](), first
            for number in range(1, MOST + 1):
                found = self.at(begin * math.exp(sign * number * step), before.values)
                if found is None or found.density < best - NEGLIGIBLE:
                    break
                best, before = max(best, found.density), found
                side.append(found)
            sides.append(side)
        return Depths((*reversed(sides[1]), first, *sides[0]), step)

    def begin(self) -> float:
        """m, the distance of the most probable path, but within that of the ball in play."""
        place = self.sightings.place
        if place is None:
            return self.distance
        usual = float(np.linalg.norm(place[0] - self.centre))
        return float(np.clip(self.distance, max(usual - place[1], usual / 2.0), usual + place[1]))

    def start(self) -> Values:
        """The values from which the search for the most probable path began: it may have ended at the camera."""
        problem = self.problem
        label, events = problem.settings.spin_label(problem.track), self.solution.events.segmentation
        return problem.start(initial_states(problem.track, (), events, problem.model, label))

    def at(self, distance: float, near: Values) -> Held | None:
        """The path at a distance, m, from values near it; None without a minimum."""
        mean, root = np.zeros((1, STATE_DIM)), np.zeros((1, 1, STATE_DIM))
        mean[0, POSITION], root[0, 0, POSITION] = self.centre + distance * self.ray, self.ray / (HELD * distance)
        held = BallGraph((*self.solution.graph.batches, PriorFactors(np.array([self.middle]), mean, root)))
        states, away = near.states.copy(), near.states[:, POSITION] - self.centre
        scale = distance / float(self.ray @ away[self.middle])
        states[:, POSITION] = self.centre + scale * away
        states[:, VELOCITY] *= scale
        minimum = self.rough.minimize(held, replace(near, states=states))
        known = self.smoother.optimizer.covariances(held, minimum)
        if known is None or minimum.convergence not in AT_MINIMUM:  # elsewhere a determinant says nothing of a volume
            return None
        density = log_evidence(replace(self.solution, graph=held, minimum=minimum))
        density += log_prior_of_size(self.problem, minimum.values) - math.log(HELD * math.sqrt(2.0 * math.pi))
        free = self.log_chance(minimum.values.states, known)
        return Held(density, free, minimum.values, known)

    def log_chance(self, states: Array, known: Covariances) -> float:
        """nats, of a path that meets no surface at its samples: at the lowest of them."""
        surfaces = self.smoother.surfaces
        over, sigmas = surfaces.over_table(states), np.sqrt(known.states[:, 2, 2])
        chance = 1.0
        for there, height in ((over, surfaces.table_height), (~over, surfaces.lowest())):
            if there.any() and height > -math.inf:
                above = gaps(self.smoother.model, states[there], height) / sigmas[there]
                chance = min(chance, 0.5 * math.erfc(-float(above.min()) / math.sqrt(2.0)))
        return math.log(max(chance, 1e-300))
