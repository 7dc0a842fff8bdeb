"""Turns the candidates of one fixed camera into the strokes of a ball, each with its estimate."""

from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Index
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.sightings import LEAST_SEEN, sighted_track
from ballfg.estimation.rally.reconstruct import search
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
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
    smoother, pairs = Smoother(model, surfaces, Settings.for_measured(model)), list[tuple[SeenBall, Estimate]]()
    strokes = search(detections, camera, model, surfaces, watch=watch)[0].strokes
    for stroke in watch(strokes, len(strokes), "strokes estimated"):
        if len(stroke.rows) >= LEAST_SEEN:  # alone and by its sightings, as it is estimated again from a dataset
            seen = _sightings(detections, stroke.rows, camera.name)
            estimate = smoother.estimate(sighted_track("stroke", seen, [camera], model=model, surfaces=surfaces))
            positions, views = estimate.states[:, POSITION], np.ones(len(estimate), dtype=np.int64)
            spread = estimate.covariances[:, POSITION, POSITION]
            pairs.append((SeenBall(estimate.times, positions, spread, seen, views), estimate))
    pairs.sort(key=lambda pair: float(pair[0].times[0]))
    tracking = Tracking((camera,), (detections,), tuple(ball for ball, _ in pairs), None)
    named = zip(tracking.names, pairs, strict=True)
    return Strokes(tracking, tuple(replace(estimate, name=name) for name, (_, estimate) in named))


def _sightings(seen: Detections, rows: Index, camera: str) -> Sightings:
    """Some candidates as the sightings of one ball."""
    own = (seen.times[rows], seen.pixels[rows], seen.covariances[rows])
    return Sightings((camera,), np.zeros(len(rows), dtype=np.int64), *own)
