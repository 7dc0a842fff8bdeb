"""Searches the arrangement of contacts in which each lies in the interval of its estimated time.

A minimum is found for one arrangement. Contacts whose estimated time lies outside of their interval then move, and the
next minimum is computed, until they stay; the lowest minimum is the result.
"""

from __future__ import annotations

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.smoother.initial import move_contacts
from ballfg.estimation.smoother.problem import Events, TrackProblem
from ballfg.estimation.smoother.solution import Solution, places_of, timed_contacts
from ballfg.factors.batch import Values
from ballfg.factors.dynamics import model_width
from ballfg.state import VZ

MAX_REFINEMENTS = 6
"""Largest number of moves of contacts to a neighbouring interval; measured tracks needed two."""


class ContactSearch:
    """The arrangements of a track's contacts, beginning with its segmentation.

    Args: problem: of the track.  surfaces: table and floor.  segmentation: its events.
    """

    def __init__(self, problem: TrackProblem, surfaces: Surfaces, segmentation: Segmentation) -> None:
        self.problem, self.surfaces, self.segmentation = problem, surfaces, segmentation
        self._seen: dict[tuple[tuple[int, float], ...], Solution] = {}
        self._settled: Solution | None = None
        self._best: Solution | None = None

    @property
    def best(self) -> Solution:
        """The lowest minimum so far; among those with consistent contacts, if any."""
        return min(self._seen.values(), key=lambda s: s.minimum.error) if self._best is None else self._best

    def after(self, solution: Solution) -> tuple[Events, Values] | None:
        """The next arrangement with initial values; None at the end of the search.

        Args: solution: for the previous arrangement.
        """
        times, ball = self.problem.track.times, self.problem.ball
        places = places_of(solution.events.contacts)
        self._seen[places] = solution
        refined = refined_contacts(times, solution)
        if places_of(refined) == places:
            unseen = () if self._settled else contacts_at_ends(times, solution, ball, self.surfaces)
            if not unseen:  # a contact that only the end of the track suggests must also explain it better
                stayed = (solution,) if self._settled is None else (self._settled, solution)
                self._best = min(stayed, key=lambda s: s.minimum.error)
                return None
            self._settled = solution
            refined = tuple(sorted((*refined, *unseen), key=lambda c: c.time))
        if places_of(refined) in self._seen or len(self._seen) == MAX_REFINEMENTS:
            return None
        values = move_contacts(solution.minimum.values, times, places, places_of(refined), ball)
        return Events(refined, self.segmentation), values


def contacts_at_ends(times: Array, solution: Solution, model: BallModel, surfaces: Surfaces) -> tuple[Contact, ...]:
    """Contacts that only a single sample at either end shows, too few for the segmentation.

    The last state has fallen through a surface; or the first, extrapolated from later samples, rises from below one.
    """
    values, events, last = solution.minimum.values, solution.events, len(times) - 1
    taken = {c.interval for c in events.contacts} | set(events.segmentation.hits.tolist())
    for rest in events.segmentation.rests:
        taken |= set(range(rest.first, rest.last + 1))
    coefficients = np.tile(values.coefficients[: model_width(model)], (2, 1))
    found = []
    for inside, beyond in ((1, 0), (last - 1, last)) if last > 0 else ():
        interval, speed = min(inside, beyond), float(values.states[beyond, VZ])
        if interval in taken or (beyond - inside) * speed >= 0.0:  # it does not move away from the other samples
            continue
        pair = torch.from_numpy(np.concatenate((values.states[[inside, beyond]], coefficients), axis=1))
        height = surfaces.level_below(pair)[0]
        with torch.no_grad():
            above, below = model.gap(pair, height).tolist()
        if above >= 0.0 > below and bool(surfaces.over_table(pair)[1]):
            time = times[beyond] - below / speed
            found.append(Contact(interval, float(np.clip(time, times[interval], times[interval + 1])), float(height)))
            taken.add(interval)
    return tuple(found)


def refined_contacts(times: Array, solution: Solution) -> tuple[Contact, ...]:
    """The contacts, each in the interval of its estimated time, without those outside the track."""
    refined = []
    for contact in timed_contacts(times, solution):
        if not times[0] <= contact.time <= times[-1]:
            continue
        interval = int(np.clip(np.searchsorted(times, contact.time, side="right") - 1, 0, len(times) - 2))
        step = np.clip(interval - contact.interval, -1, 1)  # one interval at a time: the estimate moves along
        refined.append(Contact(contact.interval + int(step), contact.time, contact.height))
    return tuple(refined)
