"""Asks how often a ball has bounced in a gap between two samples, where no sample shows it.

The segmentation tries a bounce where its mean path meets a surface. Over a gap the path is known to decimetres, so that
the ball may have bounced more or less often; a wrong number looks like noise, spin or events of the samples beside the
gap. So the samples near a gap are explained again, each side by itself, with other numbers of bounces between them.
"""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.motion.arrays import fly_through
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.explain import hit_price
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.segmentation.segmenter import USUAL
from ballfg.estimation.sides.monitor import widening
from ballfg.estimation.smoother.pieces.section import shifted
from ballfg.estimation.smoother.problem import TrackProblem
from ballfg.estimation.smoother.second_look.at_end import CERTAIN, Solved, log_evidence
from ballfg.estimation.smoother.settle import ROUGH, Arrangement, Other, Solution, places_of
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.state import Z
from ballfg.tracks import Track

MANY_STEPS: Final = 3.0
"""Least length of a gap over the usual step. Where all steps are so long, samples show too little between them."""
REACH: Final = 0.3
"""s, on each side of a gap: these samples show the motion at its ends, whatever was before and after them."""
HIT: Final = -1
"""In place of a number of contacts: a hit in the gap."""
MOST: Final = 8
"""Largest number of contacts that the motion before a gap may foretell."""
QUICK: Final = 20
"""Largest number of linear solutions for an explanation: what needs more is improbable. 10 and 40 count alike."""
UNSURE: Final = (
    "how the ball bounced where samples are missing is not certain: covariances hold what is nearly as probable"
)
OPEN: Final = "how the ball bounced is not certain: covariances hold what is nearly as probable"
LIKELY: Final = 2
"""Largest number of explanations of a gap that are solved on the whole track."""
PASSES: Final = 3
"""Largest number of passes over several gaps, until none changes."""
APART: Final = -math.log(CERTAIN)
"""nats, by which an explanation is so much less probable than another one that it is left out."""

Key = tuple[Arrangement, tuple[int, ...]]
"""The arrangement and the qualities of the samples: what tells one explanation from another."""


def bridged(smoother: Smoother, problem: TrackProblem, solution: Solution) -> Solved:
    """The most probable of a track's solutions with other numbers of contacts in its gaps.

    Args: problem, solution: with the events that the whole track shows.
    Returns: a problem and its solution, whose `others` are nearly as probable.
    """
    # beyond this an interval is a gap: longer than those over which the segmentation follows hits
    longest = max(USUAL.short_gap, MANY_STEPS * float(np.median(np.diff(problem.track.times))))
    best, solved = (problem, solution), dict[Key, Solved]()
    near = {gap: found for gap in _gaps(*best, longest) if (found := _near(smoother, *best, gap, longest))}
    if not near:
        return best
    if len(near) > 1:  # beside a wrong number in one gap, the right one in another may seem less probable
        together = _events_of(solution)
        for gap, (likeliest, *_) in near.items():
            together = _spliced(together, likeliest, gap)
        best = max(best, _settled(smoother, best, together, near, solved) or best, key=evidence)
    for _ in range(PASSES if len(near) > 1 else 1):  # beside another number, other numbers may be in doubt
        others, before = list[Solved](), best
        for gap, explanations in near.items():
            for events in explanations:
                other = _settled(smoother, best, _spliced(_events_of(best[1]), events, gap), [gap], solved)
                if other is None:
                    continue
                other, best = sorted((other, best), key=evidence)
                if not _alike(_events_of(other[1]), _events_of(best[1]), gap):
                    others.append(other)
        if best is before:
            break
    highest = evidence(best)
    rivals = (Other(*other, highest - evidence(other)) for other in others)
    return best[0], replace(best[1], others=tuple(one for one in rivals if one.odds < APART))


def _settled(
    smoother: Smoother, best: Solved, events: Segmentation, gaps: Iterable[int], solved: dict[Key, Solved]
) -> Solved | None:
    """The whole track with other events; None if they are no others in these gaps. solved: by its events, if before."""
    problem, solution = best
    if all(_alike(_events_of(solution), events, gap) for gap in gaps):
        return None
    key = (places_of(events.contacts), tuple(events.hits.tolist())), tuple(events.quality.tolist())
    if key not in solved:
        other = smoother.problem(problem.track, events)
        other.added += problem.added
        solved[key] = other, smoother.settle(other)
    return solved[key]


def _events_of(solution: Solution) -> Segmentation:
    """The events of a solution, its contacts included."""
    return replace(solution.events.segmentation, contacts=solution.events.contacts)


def _gaps(problem: TrackProblem, solution: Solution, longest: float) -> list[int]:
    """The gaps in which a ball may have bounced unseen: not so long that nothing links their sides.

    Observations that state their own events state those in gaps, too.
    """
    track = problem.track
    if any(observation.segmentation() is not None for observation in track.observations):
        return []
    steps = np.diff(track.times)
    long = (steps > longest) & (steps <= USUAL.longest_gap)
    for rest in solution.events.segmentation.rests:
        long[rest.first : rest.last + 1] = False
    return [int(interval) for interval in np.flatnonzero(long)]


def _near(
    smoother: Smoother, problem: TrackProblem, solution: Solution, gap: int, longest: float
) -> list[tuple[int, Segmentation]]:
    """The likely events of the samples near a gap, most probable first, each with the number of its first sample."""
    begin, track = _beside(problem.track, gap, longest)
    local = _Local(smoother, track, gap - begin, longest)
    counts = _inside(solution.events.contacts, gap), _foretold(smoother, problem, solution, gap)
    return [(begin, shifted(events, begin)) for events in local.likely(*counts)]


def _beside(track: Track, gap: int, longest: float) -> tuple[int, Track]:
    """The number of the first sample near a gap, and the part of the track near it, up to the next gaps."""
    times, gaps = track.times, np.flatnonzero(np.diff(track.times) > longest)
    begin = max(int(np.searchsorted(times, times[gap] - REACH)), *(gaps[gaps < gap] + 1).tolist()[-1:], 0)
    end = min(times[gap + 1] + REACH, *times[gaps[gaps > gap]].tolist()[:1], times[-1])
    return begin, track.between(float(times[begin]), float(end))


@dataclass
class _Local:
    """The samples near a gap, explained with some numbers of contacts in it, each with its evidence in nats."""

    smoother: Smoother
    track: Track
    gap: int
    longest: float
    explained: dict[int, tuple[float, Segmentation]] = field(default_factory=dict)

    def __post_init__(self) -> None:
        self.apart = self.smoother.segment(self.track, self.longest)
        self.calm = calmed(self.smoother)

    def likely(self, *counts: int) -> Iterator[Segmentation]:
        """The events of the most probable explanation, then of those that are nearly as probable.

        Numbers of contacts grow and fall from given ones as long as that is more probable. A hit explains any number.
        """
        self._evidence(HIT)
        for count in counts:
            for change in (1, -1):
                best = count
                while best + change >= 0 and self._evidence(best + change) > self._evidence(best):
                    best += change
        ranked = sorted(self.explained.values(), key=lambda known: -known[0])
        yield from (events for evidence, events in ranked[:LIKELY] if evidence > ranked[0][0] - APART)

    def _evidence(self, count: int) -> float:
        if count not in self.explained:
            start = _with_contacts(self.apart, self.track, self.smoother.surfaces, self.gap, count)
            problem = self.calm.problem(self.track, start)
            solved = problem, self.calm.settle(problem)
            self.explained[count] = evidence(solved), _events_of(solved[1])
        return self.explained[count][0]


def calmed(smoother: Smoother, most_steps: int = QUICK) -> Smoother:
    """A smoother that explains a track roughly: without hits, for which a wrong number of contacts would ask."""
    calm = replace(smoother.settings, find_events=False)
    quick = replace(smoother.optimizer, max_iterations=most_steps, tolerance=ROUGH)
    return Smoother(smoother.model, smoother.surfaces, calm, quick)


def _with_contacts(apart: Segmentation, track: Track, surfaces: Surfaces, gap: int, count: int) -> Segmentation:
    """Events whose gap is linked, with contacts evenly over it: they move to where they belong. count: or `HIT`."""
    parts = (np.arange(max(count, 0)) + 0.5) / max(count, 1)
    times = track.times[gap] + parts * (track.times[gap + 1] - track.times[gap])
    below = zip(times.tolist(), _heights_below(surfaces, track, gap, parts), strict=True)
    contacts = [Contact(gap, time, height) for time, height in below if height > -math.inf]
    contacts += [contact for contact in apart.contacts if contact.interval != gap]
    return replace(
        apart,
        contacts=tuple(sorted(contacts, key=lambda contact: contact.time)),
        hits=np.union1d(apart.hits, [gap]) if count == HIT else np.setdiff1d(apart.hits, [gap]),
        restarts=np.setdiff1d(apart.restarts, [gap]),
    )


def _heights_below(surfaces: Surfaces, track: Track, gap: int, parts: Array) -> list[float]:
    """m, heights of the surfaces below the line between the ends of a gap, at parts (k,) of its length."""
    places = track.positions[gap] + parts[:, None] * (track.positions[gap + 1] - track.positions[gap])
    places[:, Z] = track.positions[gap : gap + 2, Z].max()
    heights: list[float] = surfaces.height_below(places, 0.0).tolist()
    return heights


def _spliced(known: Segmentation, explained: tuple[int, Segmentation], gap: int) -> Segmentation:
    """Events of a whole track, with others near a gap: between samples far from the events of both.

    Args: explained: number of the first sample near the gap, and the events of these samples, numbered in the track.
    """
    begin, near = explained
    end = begin + len(near.quality) - 1
    at = [one.interval for events in (known, near) for one in events.contacts]
    at += np.concatenate(
        (known.hits, near.hits, np.flatnonzero(known.quality), begin + np.flatnonzero(near.quality))
    ).tolist()
    first, last = _quiet(begin, gap, at), _quiet(gap + 1, end, at)
    quality = known.quality.copy()
    quality[first : last + 1] = near.quality[first - begin : last + 1 - begin]
    contacts = [c for c in known.contacts if not first <= c.interval < last]
    contacts += [c for c in near.contacts if first <= c.interval < last]
    hits, restarts = (
        np.union1d(old[(old < first) | (old >= last)], new[(new >= first) & (new < last)])
        for old, new in ((known.hits, near.hits), (known.restarts, near.restarts))
    )
    ordered = tuple(sorted(contacts, key=lambda c: c.time))
    return replace(known, contacts=ordered, hits=hits, restarts=restarts, quality=quality)


def _quiet(first: int, last: int, at: Sequence[int]) -> int:
    """The sample from `first` to `last` that is furthest from all intervals with events."""
    samples = np.arange(first, last + 1)
    away = np.abs(samples[:, None] - 0.5 - np.array(at)).min(axis=1, initial=np.inf)
    return int(samples[away.argmax()])


def _alike(one: Segmentation, other: Segmentation, gap: int) -> bool:
    """True if two explanations differ in no number of contacts, no hit and no bad sample."""
    return (
        len(one.contacts) == len(other.contacts)
        and _inside(one.contacts, gap) == _inside(other.contacts, gap)
        and np.array_equal(one.hits, other.hits)
        and np.array_equal(one.usable, other.usable)
    )


def _foretold(smoother: Smoother, problem: TrackProblem, solution: Solution, gap: int) -> int:
    """Number of contacts in a gap of a ball that goes on as before."""
    values, track = solution.minimum.values, problem.track
    start = np.concatenate((values.states[gap], values.coefficients[: problem.width]))
    heights = _heights_below(smoother.surfaces, track, gap, np.zeros(MOST))
    dt = track.times[gap + 1] - track.times[gap]
    _, times = fly_through(problem.ball, start[None], np.array([dt]), heights)
    return int((times < dt).sum())


def _inside(contacts: Sequence[Contact], gap: int) -> int:
    """Number of contacts in a gap."""
    return sum(contact.interval == gap for contact in contacts)


def evidence(solved: Solved, whole: float | None = None) -> float:
    """nats, less the prices of contacts and hits; -inf without a minimum.

    Args: whole: the evidence of all paths of these events, if it is known better than by `log_evidence`.
    """
    problem, solution = solved
    if solution.minimum.step is None:
        return -math.inf
    events = solution.events
    price = USUAL.contact_cost * len(events.contacts)
    for step in np.diff(problem.track.times)[events.segmentation.hits].tolist():
        price += hit_price(USUAL.hit_rate, USUAL.hit_cost, USUAL.short_gap, step)
    return (log_evidence(solution) if whole is None else whole) - price


def with_other_contacts(estimate: Estimate, other: Estimate, odds: float, *, one_view: bool = False) -> Estimate:
    """The estimate with covariances that hold another one's states too, and a note; odds: log, of its own."""
    chance = 1.0 / (1.0 + math.exp(max(odds, 0.0)))
    if not chance > CERTAIN:
        return estimate
    covariances = estimate.covariances.copy()
    for k, near in enumerate(estimate.covariances):
        far, jump = other.covariances[k], other.states[k] - estimate.states[k]
        covariances[k] += widening(near, far, jump, chance)
    note = OPEN if one_view else UNSURE
    notes = estimate.notes if note in estimate.notes else (*estimate.notes, note)
    return replace(estimate, covariances=covariances, notes=notes)
