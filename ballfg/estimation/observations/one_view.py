"""Finds the path of a ball that was seen from one point: bounces and gravity give the depth that rays lack.

At a guessed time the ball bounces where the ray then meets a surface, with flights before and after it
(`bounced_path`). The time of a bounce is scanned, and so is that of a further one while it fits much better. Without a
bounce, gravity gives the scale. All these paths are starts; how often the ball bounced is a question to their evidence.
"""

from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.bounced_path import LIFT, Paths, Scene, places_of, possible, solved, velocities_of
from ballfg.estimation.observations.ray_path import Path, Rays
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Contact

STEPS: Final = 0.25  # Of the camera's period, between guessed times of a bounce; the smoother finds the time itself
SPIN: Final = 0.12, 0.12, 0.45
"""1/s, as `LIFT`, of a ball that flies any way: of 40 rad/s aside and 150 of topspin, as `Settings.one_view_spin`."""
WIDEST: Final = 1.0
"""m, largest standard deviation that is stated of a rough position: what is beyond is not known at all."""
LEAST_STEP: Final = 4e-3  # s, least of these steps
MOST_STEPS: Final = 2000  # Guessed times of a bounce; a track that is longer than 8 s may have longer steps
ENOUGH: Final = 60  # Sightings that show the bounces: of more, some are left out
PRICE: Final = 10.0  # Twice the log likelihood that a bounce must gain over a path without it, to be tried before it
BETTER: Final = 1.15  # Factor by which a further bounce must lower the misfit: spin bends flights too, but less
POOR: Final = 3.0
"""Misfit for each sighting, of which noise leaves two, from which the first bounces may be wrong, and are scanned again
beside a further one."""
MOST_BOUNCES: Final = 4
RIVAL: Final = 50.0
"""Twice the log likelihood by which another path may fit worse and is tried all the same."""
MOST_RIVALS: Final = 3
APART: Final = 0.009  # s, least time between the bounces of rivals: the smoother moves a bounce from sample to sample


@dataclass(frozen=True)
class OneView:
    """The path of a ball at the moments of its track, and its bounces at some times, s, on a surface at a height, m.

    Its misfit is twice the sum of the losses of sightings and priors, for each sighting.
    """

    path: Path
    bounces: tuple[float, ...]
    height: float
    misfit: float

    def contacts(self, times: Array) -> tuple[Contact, ...]:
        """The bounces between two of the samples at times (n,) s."""
        places = np.searchsorted(times, self.bounces, side="right") - 1
        intervals = np.clip(places, 0, max(len(times) - 2, 0)).tolist()
        return tuple(Contact(i, time, self.height) for i, time in zip(intervals, self.bounces, strict=True))


def one_view(rays: Rays, moments: Array, physics: SegmentationPhysics, surfaces: Surfaces) -> list[OneView]:
    """The likely paths, best first: with bounces in other intervals, with fewer bounces, and with one more.

    Args: rays: of all sightings.  moments: (n,) s, of the track's samples.  physics: of the ball.  surfaces: to meet.
    """
    rays = rays.thinned(ENOUGH)
    table = Scene(rays, physics, surfaces, surfaces.table_height, SPIN)
    middle, still = np.array([[float(np.median(rays.times))]]), replace(table, lift=None)
    flight = _path(still, solved(still, middle, 0), 0, moments)  # beside spin, gravity does not give the scale
    offers = [(float(solved(table, middle, 0).misfit[0]), flight)]
    for height in surfaces.heights():  # the floor only gets what cannot be on the table: farther and faster look alike
        scene = replace(table, height=height)
        for tried, misfit, rivals in _bounced(scene, moments):
            rows = _rivals(misfit, tried.times, np.searchsorted(moments, tried.times, side="right"))
            priced = misfit + PRICE * tried.bounces
            offers += [(float(priced[row]), _path(scene, tried, row, moments)) for row in rows[: 1 + rivals]]
        offers.sort(key=lambda offer: offer[0])
        if offers[0][1].bounces:
            break
    return [path for priced, path in offers if priced <= offers[0][0] + RIVAL]


def bounced_at(rays: Rays, moments: Array, physics: SegmentationPhysics, surfaces: Surfaces, bounces: Array) -> OneView:
    """The path with bounces on the table at known times (b,) s, with spin; other arguments as for `one_view`."""
    scene = Scene(rays, physics, surfaces, surfaces.table_height, LIFT)
    times = bounces if len(bounces) else np.array([float(np.median(rays.times))])
    return _path(scene, solved(scene, times[None], len(bounces)), 0, moments)


def _bounced(scene: Scene, moments: Array) -> list[tuple[Paths, Array, int]]:
    """Paths with one bounce at all guessed times, and misfits (k,); then those with more, while they fit better.

    Then those with one more, if any are possible. The last number says how many rivals of the best are worth a trial.
    """
    if len(moments) < 2:
        return []
    span = float(moments[-1] - moments[0])
    step = max(STEPS * float(np.median(np.diff(moments))), LEAST_STEP, span / MOST_STEPS)
    guesses = np.arange(moments[0] + step, moments[-1] - 0.5 * step, step)
    further = guesses[(guesses > moments[1]) & (guesses < moments[-2])]  # a flight of one sample explains anything
    found, least, poor = list[tuple[Paths, Array, int]](), np.inf, POOR * len(scene.rays.times)
    more = _one_more(scene, np.zeros(0), guesses)
    while more is not None:
        for number in range(more[0].bounces if least > poor else 0):  # the others again, beside the new one
            again = _one_more(scene, np.delete(_best(*more), number), guesses)
            more = again if again is not None and again[1].min() < more[1].min() else more
        if BETTER * more[1].min() + PRICE < least:
            found = [*((*one[:2], 0) for one in found), (*more, MOST_RIVALS)]
            least = float(more[1].min())
        elif found:
            return [*found, (*more, 0)] if np.isfinite(more[1]).any() else found
        more = _one_more(scene, _best(*more), further) if more[0].bounces < MOST_BOUNCES else None
    return found


def _best(tried: Paths, misfit: Array) -> Array:
    """(b,) s, times of the bounces of the best path; if all are impossible, of the best of these."""
    return np.asarray(tried.times[int(np.argmin(misfit if np.isfinite(misfit).any() else tried.misfit))])


def _one_more(scene: Scene, known: Array, guesses: Array) -> tuple[Paths, Array] | None:
    """The paths with known bounces and another one at each guess, and misfits (k,), infinite where impossible."""
    free = guesses[(np.abs(guesses[:, None] - known) > scene.rays.period).all(axis=1)]
    if not len(free):
        return None
    times = np.sort(np.concatenate((np.tile(known, (len(free), 1)), free[:, None]), axis=1), axis=1)
    tried = solved(scene, times, times.shape[1])
    return tried, np.where(possible(scene, tried), tried.misfit, np.inf)


def _rivals(misfit: Array, times: Array, intervals: Index) -> list[int]:
    """The best guess, and those with other times and intervals (k, b) that are nearly as good, best first."""
    chosen = list[int]()
    for row in np.argsort(misfit, kind="stable"):
        if misfit[row] > misfit.min() + RIVAL or len(chosen) > MOST_RIVALS:
            break
        other = np.abs(times[chosen] - times[row]).max(axis=1, initial=0.0) > APART
        if (other & (intervals[chosen] != intervals[row]).any(axis=1)).all():
            chosen.append(int(row))
    return chosen


def _path(scene: Scene, tried: Paths, row: int, moments: Array) -> OneView:
    """One solution at moments (n,) s; misfits widen its sigmas."""
    positions, spread = places_of(scene, tried, row, moments)
    misfit = float(tried.misfit[row])
    wider = max(misfit / max(2 * len(scene.rays.times) - 3 * tried.vectors.shape[1], 1), 1.0)
    sigmas = np.minimum(np.sqrt(wider * np.diagonal(spread, axis1=1, axis2=2)), WIDEST)
    velocities = velocities_of(tried, row, moments, scene.physics.gravity)
    bounces = tuple(tried.times[row].tolist()) if tried.bounces else ()
    return OneView(Path(positions, velocities, sigmas), bounces, scene.height, misfit / len(scene.rays.times))
