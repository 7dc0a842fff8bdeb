"""Turns the candidates of one fixed camera into the strokes of a ball, each with its estimate."""

from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Index
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.sightings import LEAST_SEEN
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
    """The strokes of a recording of one camera, and the estimate of each, in the same order."""

    tracking: Tracking
    estimates: tuple[Estimate, ...]

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
    """
    one = strokes_of(detections, camera, model, surfaces, watch=watch)
    pairs = [(stroke.rows, estimate) for stroke, estimate in zip(one.chosen.strokes, one.estimates, strict=True)]
    pairs.sort(key=lambda pair: float(pair[1].times[0]))
    pairs = [pair for pair in pairs if len(pair[0]) >= LEAST_SEEN]  # others could not be estimated from a dataset
    balls = tuple(_ball(one.seen, *pair) for pair in pairs)
    tracking = Tracking((camera,), (one.seen,), balls, None)
    named = zip(tracking.names, pairs, strict=True)
    return Strokes(tracking, tuple(replace(estimate, name=name) for name, (_, estimate) in named))


def _ball(seen: Detections, rows: Index, estimate: Estimate) -> SeenBall:
    """The ball of an estimate and of its candidates."""
    own = (seen.times[rows], seen.pixels[rows], seen.covariances[rows])
    sightings = Sightings((seen.camera,), np.zeros(len(rows), dtype=np.int64), *own)
    views = np.ones(len(estimate.times), dtype=np.int64)
    return SeenBall(
        estimate.times, estimate.states[:, POSITION], estimate.covariances[:, POSITION, POSITION], sightings, views
    )
