"""Turns the candidates of one fixed camera into the strokes of a ball, each with its estimate, and their events."""

from dataclasses import dataclass

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.rally.events import events_of
from ballfg.estimation.rally.moments import Event
from ballfg.estimation.rally.reconstruct import strokes_of
from ballfg.estimation.result import Estimate, Status
from ballfg.progress import Watch, unwatched
from ballfg.state import POSITION
from ballfg.tracks.sightings import Sightings
from ballfg.vision.association.gathering import SeenBall
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections
from ballfg.vision.tracking.pipeline import Tracking


@dataclass(frozen=True, eq=False)
class Strokes:
    """The strokes of a recording of one camera, the estimate of each in the same order, and hits, bounces, ends.

    The candidates of `tracking` have the noise that the strokes show. Estimates are joined at hits.
    """

    tracking: Tracking
    estimates: tuple[Estimate, ...]
    events: tuple[Event, ...]

    @property
    def doubts(self) -> list[str]:
        """Sentences on the strokes whose estimate is not sure."""
        unsure = (one for one in self.estimates if one.status is not Status.OK)
        return [f"track {one.name}: {one.status.value}" for one in unsure]


def track_one_camera(
    detections: Detections, camera: Camera, model: BallModel, surfaces: Surfaces, watch: Watch = unwatched
) -> Strokes:
    """The strokes among one camera's candidates.

    Args:
        detections: all candidates of the camera, good and bad.  camera: with its place.
        model, surfaces: of the ball, and of what it bounces on.  watch: sees the flights that are followed.
    Raises: ValueError: no surface.
    """
    if not surfaces.heights():
        raise ValueError(
            "surfaces must hold one: a bounce on it shows how far away a ball is that one camera saw; got none. "
            "Give a table_height."
        )
    found = strokes_of(detections, camera, model, surfaces, watch=watch)
    seen, pairs = found.seen, list[tuple[Estimate, SeenBall]]()
    for stroke, estimate in zip(found.chosen.strokes, found.estimates, strict=True):
        own = (seen.times[stroke.rows], seen.pixels[stroke.rows], seen.covariances[stroke.rows])
        sightings = Sightings((camera.name,), np.zeros(len(own[0]), dtype=np.int64), *own, seen.radii_of(stroke.rows))
        spread, views = estimate.covariances[:, POSITION, POSITION], np.ones(len(estimate), dtype=np.int64)
        pairs.append((estimate, SeenBall(estimate.times, estimate.states[:, POSITION], spread, sightings, views)))
    pairs.sort(key=lambda pair: pair[0].name)
    events = events_of(found, model, surfaces, float(np.median(np.diff(seen.frames)))) if pairs else []
    bounces = dict[str, list[Array]]()
    for event in events:
        if event.kind == "bounce":
            bounces.setdefault(event.trajectory, []).append(np.concatenate((event.place, event.sigmas)))
    balls, places = tuple(ball for _, ball in pairs), {name: np.array(found) for name, found in bounces.items()}
    tracking = Tracking((camera,), (seen,), balls, None, places)
    return Strokes(tracking, tuple(estimate for estimate, _ in pairs), tuple(events))
