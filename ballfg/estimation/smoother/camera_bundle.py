"""Estimates pose and focal length of one camera from all strokes of a recording: bundle adjustment by balls."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.sightings import CHANGE, sighted_track, sightings_of
from ballfg.estimation.result import Estimate
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.estimation.smoother.time_offsets import USABLE
from ballfg.tracks import Track
from ballfg.vision.camera import Camera
from ballfg.vision.camera_change import changed

ROUNDS: Final = 8
"""Largest number of corrections of the camera."""
SETTLED: Final = 0.1
"""Standard deviations. A camera that changes by less has converged."""


@dataclass(frozen=True, eq=False)
class Bundle:
    """A camera from the strokes that it saw.

    Attributes:
        camera: with its covariance.  settled: True if another round would not change it.  tracks: number of strokes in
        the estimate.  change: (7,) of the camera that was believed.
    """

    camera: Camera
    settled: bool
    tracks: int
    change: Array


def camera_of_strokes(
    tracks: Sequence[Track], believed: Camera, model: BallModel, surfaces: Surfaces, settings: Settings
) -> Bundle:
    """The most probable camera for the strokes that it saw, and its covariance.

    Each stroke is smoothed with its own change of the camera. Its information on it is its posterior's less the
    prior's; the sum over all strokes, with the belief counted once, is the estimate. The strokes are then smoothed
    again about the new camera.

    Args: tracks: of the one camera.  believed: it, with a covariance.  model, surfaces, settings: as for estimates.
    Raises: ValueError: no track that can be smoothed.
    """
    smoother, prior = Smoother(model, surfaces, settings), np.linalg.inv(believed.covariance)
    camera, total = believed, np.zeros(len(prior))
    seen = [(track.name, sightings_of(track).sightings, track.labels) for track in tracks]
    for _ in range(ROUNDS):
        information, pull, used = prior.copy(), -prior @ total, 0
        for name, sightings, labels in seen:
            track = sighted_track(name, sightings, [camera], labels, model=model, surfaces=surfaces)
            estimate = smoother.estimate(track)
            if estimate.status in USABLE:
                more, towards = _information(estimate, camera)
                information, pull, used = information + more, pull + towards, used + 1
        if not used:
            raise ValueError("tracks must hold one that can be smoothed; none could. Look at the calibration first.")
        step = np.linalg.solve(information, pull)
        total += step
        camera = replace(changed(camera, step), covariance=np.linalg.inv(information))
        settled = bool(step @ information @ step < SETTLED**2 * len(step))
        if settled:
            break
    return Bundle(camera, settled, used, total)


def _information(estimate: Estimate, camera: Camera) -> tuple[Array, Array]:
    """Of one stroke on the changes of the camera: (7, 7), and (7,) the same times the most probable change."""
    rows = [row for row, name in enumerate(estimate.unknown_names) if name.startswith(CHANGE)]
    posterior = np.linalg.inv(estimate.unknown_covariance[np.ix_(rows, rows)])
    whiten = np.linalg.inv(np.linalg.cholesky(camera.covariance))
    return whiten.T @ (posterior - np.eye(len(rows))) @ whiten, whiten.T @ posterior @ estimate.unknowns[rows]
