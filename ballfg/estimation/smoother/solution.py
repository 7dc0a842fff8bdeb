"""A minimised graph, and where it says that the contacts are."""

from dataclasses import dataclass

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation import Contact
from ballfg.estimation.smoother.motion import contacts_by_interval
from ballfg.estimation.smoother.problem import Events, contact_batches
from ballfg.factors.dynamics import model_width
from ballfg.factors.graph import BallGraph, Minimum
from ballfg.state import VZ


@dataclass(frozen=True)
class Solution:
    """A minimised graph and the events it was built on."""

    events: Events
    graph: BallGraph
    minimum: Minimum
    rival: Array | None = None
    """(3,) rad/s, first spin of another minimum that is nearly as low, where one was found."""


def contacts_at_ends(times: Array, solution: Solution, model: BallModel, surfaces: Surfaces) -> tuple[Contact, ...]:
    """Contacts that a single sample at either end could show, too little for the segmentation.

    The last state has fallen through a surface; or the first, where later samples lead back to, rises from below one.
    """
    values, events, last = solution.minimum.values, solution.events, len(times) - 1
    taken = {c.interval for c in events.contacts} | set(events.segmentation.hits.tolist())
    for rest in events.segmentation.rests:
        taken |= set(range(rest.first, rest.last + 1))
    coefficients = np.tile(values.coefficients[: model_width(model)], (2, 1))
    found = []
    for inside, beyond in ((1, 0), (last - 1, last)) if last > 0 else ():
        interval = min(inside, beyond)
        pair = torch.from_numpy(np.concatenate((values.states[[inside, beyond]], coefficients), axis=1))
        height = surfaces.level_below(pair)[0]
        with torch.no_grad():
            above, below = model.gap(pair, height).tolist()
        outwards = (beyond - inside) * float(pair[1, VZ]) < 0.0
        if interval not in taken and above >= 0.0 > below and outwards and bool(surfaces.over_table(pair)[1]):
            time = times[beyond] - below / float(pair[1, VZ])
            found.append(Contact(interval, float(np.clip(time, times[interval], times[interval + 1])), float(height)))
            taken.add(interval)
    return tuple(found)


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


def refined_contacts(times: Array, solution: Solution) -> tuple[Contact, ...]:
    """The contacts, each in the interval that its estimated time lies in; those outside the track are dropped."""
    refined = []
    for contact in timed_contacts(times, solution):
        if not times[0] <= contact.time <= times[-1]:
            continue
        interval = int(np.clip(np.searchsorted(times, contact.time, side="right") - 1, 0, len(times) - 2))
        step = np.clip(interval - contact.interval, -1, 1)  # one interval at a time: the estimate moves along
        refined.append(Contact(contact.interval + int(step), contact.time, contact.height))
    return tuple(refined)
