"""Turns one camera's candidates into strokes: chains of smooth motion, cut where no flight explains them.

A chain of pieces (`ballfg.vision.association.one_view`) grows piece by piece while flights with bounces explain all of
it; the first piece that they do not explain begins a new stroke, as after a hit. What no flight explains is no ball.
The smoother then estimates each stroke.
"""

from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.one_view import one_view
from ballfg.estimation.observations.ray_path import Rays
from ballfg.estimation.observations.rig import in_order, true_times_of
from ballfg.estimation.observations.sightings import LEAST_SEEN, sighted_track
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.progress import Watch, unwatched
from ballfg.state import POSITION
from ballfg.tracks.sightings import Sightings
from ballfg.vision.association.associate import AssociationSettings
from ballfg.vision.association.gathering import SeenBall
from ballfg.vision.association.one_view import chains
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections
from ballfg.vision.tracking.pipeline import Tracking

TOLERANCE: Final = 5e-3
"""rad, standard deviation of a sighting about a flight without spin: 15 mm at 3 m. A hit misses by far more."""
EXPLAINED: Final = 10.0
"""Misfit for each sighting up to which flights explain a stroke; strong spin leaves 5, a hit some hundreds."""
ENOUGH: Final = 30
"""Sightings that show a hit: of more, some are left out."""
GRIP: Final = 0.6
"""Change of the horizontal velocity in a bounce, at most, over that of the vertical one: a ball on a table grips with
0.3. More is a hit."""
CATCH: Final = 1.0
"""m/s, always allowed change."""
CLOSE: Final = 1.4
"""Largest median NIS of the sightings of a ball whose estimate did not converge: that of right noise."""
STRAIGHT: Final = 0.3
"""s. What moves so long in a straight line does not fall."""
NEAREST: Final = 0.5
"""m from the camera; a ball nearer by fills much of the picture."""
LONGEST_TIME: Final = 3.0
"""s, of a stroke: a lob with its bounces."""
LEAST_TIME: Final = 0.25
"""s, of a stroke: gravity shows in 0.3 m. Shorter pieces of two rallies were fragments or chance."""


@dataclass(frozen=True, eq=False)
class Strokes:
    """The strokes of a recording of one camera, and the estimate of each, in the same order."""

    tracking: Tracking
    estimates: tuple[Estimate, ...]

    @property
    def doubts(self) -> list[str]:
        """Sentences on the strokes whose estimate is not sure."""
        unsure = (one for one in self.estimates if one.status is not Status.OK)
        return [f"track {one.name}: {one.status.value}" for one in unsure]


def track_one_camera(
    detections: Detections,
    camera: Camera,
    model: BallModel,
    surfaces: Surfaces,
    settings: AssociationSettings | None = None,
    watch: Watch = unwatched,
) -> Strokes:
    """The strokes among one camera's candidates.

    Args:
        detections: all candidates of the camera, good and bad.  camera: with its place.
        model, surfaces: of the ball, and of what it bounces on.  settings: the default ones if None.
        watch: sees the chains of candidates that are tried.
    """
    settings = settings or AssociationSettings()
    smoother, found = Smoother(model, surfaces, Settings.for_measured(model)), list[tuple[SeenBall, Estimate]]()
    ways = chains(detections, camera, settings)
    for chain in watch(ways, len(ways), "ways across the picture tried"):
        for stroke in _cut(chain, camera, smoother):
            if len(stroke) < max(settings.least_points, LEAST_SEEN) or np.ptp(stroke.times) < LEAST_TIME:
                continue
            track = sighted_track("stroke", stroke, [camera], model=model, surfaces=surfaces)
            estimate = smoother.estimate(track)
            distance = np.linalg.norm(estimate.states[:, POSITION] - camera.centre, axis=1)
            if _fits(estimate) and np.median(distance) > NEAREST:
                covariances = estimate.covariances[:, POSITION, POSITION]
                views = np.ones(len(track), dtype=np.int64)
                ball = SeenBall(track.times, estimate.states[:, POSITION], covariances, stroke, views)
                found.append((ball, estimate))
    found.sort(key=lambda pair: float(pair[0].times[0]))
    tracking = Tracking((camera,), (detections,), tuple(ball for ball, _ in found), None)
    pairs = zip(tracking.names, found, strict=True)
    return Strokes(tracking, tuple(replace(estimate, name=name) for name, (_, estimate) in pairs))


def _fits(estimate: Estimate) -> bool:
    """True if an estimate converged, or did not but passes through most sightings all the same."""
    if estimate.status is Status.NOT_CONVERGED:
        return bool(np.median(estimate.nis) < CLOSE)
    return not estimate.status.failed


def _cut(chain: Sequence[Sightings], camera: Camera, smoother: Smoother) -> list[Sightings]:
    """The strokes of a chain: pieces in order of time, together as long as flights explain them.

    A piece that no flight explains may go on smoothly through a hit: what still fits belongs to the stroke before.
    """
    explained = partial(_explained, camera=camera, smoother=smoother)
    found, left, grown = list[Sightings](), deque(chain), list[Sightings]()
    while left:
        piece = left.popleft()
        if _straight(piece, camera):
            continue
        whole = _joined([*grown, piece])
        if explained(whole):
            grown = [whole]
            continue
        known = sum(map(len, grown))
        at = known if grown and explained(piece) else _first_unexplained(whole, known, explained)
        found += [whole.select(np.arange(at))] if at else []
        grown = []
        if known or np.ptp(whole.times[:at]) >= LEAST_TIME:  # else it is no ball
            left.appendleft(whole.select(np.arange(at, len(whole))))
    return [one for one in (*found, *grown) if not _straight(one, camera)]


def _first_unexplained(whole: Sightings, known: int, explained: Callable[[Sightings], bool]) -> int:
    """Number of first sightings that flights explain, by bisection; known: such a number, or 0."""
    low, high = known, len(whole)
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (middle, high) if explained(whole.select(np.arange(middle))) else (low, middle)
    return low


def _joined(pieces: Sequence[Sightings]) -> Sightings:
    """Sightings of one camera, joined in order of time."""
    names = ("camera", "times", "pixels", "covariances")
    return Sightings(pieces[0].cameras, *(np.concatenate([getattr(one, name) for one in pieces]) for name in names))


def _explained(seen: Sightings, camera: Camera, smoother: Smoother) -> bool:
    """True if flights with bounces pass near enough to all sightings, or too few were seen for saying."""
    if len(seen) < LEAST_SEEN:
        return True
    if np.ptp(seen.times) > LONGEST_TIME:
        return False
    spread = (TOLERANCE * np.diag(camera.matrix)[:2]) ** 2
    loose = replace(seen, covariances=seen.covariances + np.diag(spread))
    ordered = in_order(loose, [camera]).select(np.arange(0, len(seen), -(-len(seen) // ENOUGH)))
    times = true_times_of(ordered, [camera])
    times = times - times[0]
    path = one_view(Rays.of(ordered, times, [camera]), times, physics_of(smoother.model), smoother.surfaces)[0]
    for bounce in path.bounces:
        before = min(max(int(np.searchsorted(times, bounce)) - 1, 0), len(times) - 2)
        *level, rise = path.path.velocities[before + 1] - path.path.velocities[before]
        if np.hypot(*level) > GRIP * abs(rise) + CATCH:
            return False
    return path.misfit <= EXPLAINED


def _straight(seen: Sightings, camera: Camera) -> bool:
    """True for a long motion on a straight line at a steady speed."""
    since = seen.times - seen.times.mean()
    design = np.stack((np.ones_like(since), since), axis=1)
    left = seen.pixels - design @ np.linalg.lstsq(design, seen.pixels)[0]
    missed = np.linalg.norm(left / np.diag(camera.matrix)[:2], axis=1)
    return bool(np.ptp(since) >= STRAIGHT and np.sqrt((missed**2).mean()) < TOLERANCE)
