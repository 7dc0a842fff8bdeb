"""Errors of a recording that a camera makes: its clock, its focal length, its lens.

They act on stamps and pixels, not on the ball, so that a model file cannot hold them: cameras.yaml and the stamps are
what they correct.
"""

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics import BallModel, Surfaces
from ballfg.dynamics.effect import Coefficient, Effect, Usual
from ballfg.dynamics.effects.measurement import TimeScale
from ballfg.estimation import Estimate
from ballfg.estimation.observations.sightings import CameraSightings, sighted_track, sightings_of
from ballfg.factors.loss import Loss
from ballfg.state import POSITION, VELOCITY
from ballfg.tracks.track import Track
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CameraBank


class LensDistortion(Effect):
    """The lens bends the picture more than cameras.yaml says: pixels lie 1 + k1 r^2 times as far from its middle."""

    name = "distortion"
    kind = "measurement"
    plain = "a lens that bends the picture"
    sentence = "The lens bends the picture by place, more or less than cameras.yaml says."
    decide = "Film a board of known squares, and calibrate the lens: ballfg calibrate-cameras --images."
    coefficients = (Coefficient("k1", 0.0, 0.05, "1", -1.0, 1.0),)
    usual = Usual({"k1": 0.05}, "an estimate: a third of a telephone's lens, 4 px at the edge of a picture of 1280 px")
    belongs_to = "rig"


class FocalLength(Effect):
    """The focal length is 1 + s times the one in cameras.yaml."""

    name = "focal_length"
    kind = "measurement"
    plain = "a focal length that is wrong"
    sentence = "The focal length is 1 + s times the one in cameras.yaml."
    decide = "Calibrate the camera anew from the table's corners, or from a board of known squares."
    coefficients = (Coefficient("s", 0.0, 0.01, "1", -0.5, 0.5),)
    usual = Usual({"s": 0.01}, "an estimate: 1 %")
    belongs_to = "rig"


ERRORS: Final[tuple[type[Effect], ...]] = (TimeScale, FocalLength, LensDistortion)
CLOCK, FOCAL, LENS = NAMES = tuple(f"measurement.{e.name}.{e.coefficients[0].name}" for e in ERRORS)
"""Names of their strengths, as the parameters of a model would be called."""


@dataclass(frozen=True)
class Picture:
    """Strengths of the three errors, as of `ERRORS`."""

    clock: float = 0.0
    focal: float = 0.0
    lens: float = 0.0

    @classmethod
    def of(cls, strengths: Mapping[str, float]) -> "Picture":
        """Those among strengths by name; absent ones are zero."""
        return cls(*(strengths.get(name, 0.0) for name in NAMES))

    def true_times(self, times: Array) -> Array:
        """(n,) s, true times since the first of written ones (n,) s, which may be large: counted from the first."""
        return times[0] + (times - times[0]) / (1.0 + self.clock)

    def camera(self, camera: Camera) -> Camera:
        """A camera with these errors taken into account."""
        if self.focal == 0.0 and self.lens == 0.0:
            return camera
        matrix, bent = camera.matrix.copy(), np.zeros(max(len(camera.distortion), 4))
        matrix[[0, 1], [0, 1]] *= 1.0 + self.focal
        bent[: len(camera.distortion)] = camera.distortion
        bent[0] += self.lens
        return replace(camera, matrix=matrix, distortion=bent)

    def seen_by(self, track: Track, model: BallModel, surfaces: Surfaces) -> Track:
        """A track of sightings with its true stamps and cameras; the track itself without errors."""
        if self == Picture():
            return track
        seen = sightings_of(track)
        sightings = replace(seen.sightings, times=self.true_times(seen.sightings.times))
        cameras = [self.camera(camera) for camera in seen.cameras]
        bounces = known_bounces(seen, 1.0 / (1.0 + self.clock))
        return sighted_track(
            track.name, sightings, cameras, track.labels, model=model, surfaces=surfaces, bounces=bounces
        )


def known_bounces(seen: CameraSightings, slower: float) -> Array | None:
    """(b,) s, stamps of the bounces of a track that were found before it was estimated; None if they were not.

    Args: slower: factor of the durations since the first sighting.
    """
    if seen.known is None:
        return None
    return seen.sightings.times[0] + slower * np.array([contact.time for contact in seen.known.contacts])


def slopes(track: Track, estimate: Estimate, loss: Loss) -> Array:
    """(3,) derivatives of the objective at its minimum by the three errors, with the opposite sign.

    At a minimum the states' own derivatives vanish, so that those of the sightings alone are left.
    """
    seen = sightings_of(track)
    sightings, states = seen.sightings, estimate.states[seen.state]
    points = sightings.from_cameras(states[:, POSITION])
    pixels, slope = CameraBank(seen.cameras).jacobian(points, sightings.camera)
    off = sightings.pixels - pixels
    white = (np.linalg.inv(sightings.covariances) @ off[..., None])[..., 0]
    pull = loss.weight(np.sqrt((white * off).sum(axis=1)))[:, None] * white
    turn = np.stack([camera.rotation for camera in seen.cameras])[sightings.camera]
    shift = np.stack([camera.tvec for camera in seen.cameras])[sightings.camera]
    focal = np.stack([np.diagonal(camera.matrix)[:2] for camera in seen.cameras])[sightings.camera]
    middle = np.stack([camera.matrix[:2, 2] for camera in seen.cameras])[sightings.camera]
    local = (turn @ points[..., None])[..., 0] + shift
    place = local[:, :2] / local[:, 2:]
    moves = (slope @ states[:, VELOCITY, None])[..., 0]
    late = sightings.times - sightings.times[0]
    bent = focal * place * (place**2).sum(axis=1, keepdims=True)
    by = (-moves * late[:, None], pixels - middle, bent)
    return np.array([float((pull * move).sum()) for move in by])
