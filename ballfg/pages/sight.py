"""Finds the rays along which cameras saw the ball of a shot, for drawing."""

from dataclasses import dataclass
from typing import Protocol, cast

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.tracks import Track
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera

LEAST_ACROSS = 0.1
"""Of a ray's noise, the least share along a coordinate that is stated: along the ray nothing is measured."""
MOST_RAYS, NEAR_PICTURE = 14, 0.3
"""Rays of a camera that are drawn along a shot, and m before a camera at which its picture is drawn."""


@dataclass(frozen=True, eq=False)
class Sight:
    """The m sightings of a shot's ball, in order of time."""

    cameras: tuple[Camera, ...]  # of the rig
    camera: Index  # (m,) number of each sighting's camera
    sample: Index  # (m,) number of the shot's sample that it belongs to
    centres: Array  # (m, 3) m, where the camera stood
    rays: Array  # (m, 3) unit vectors from there to the ball
    noise: Array  # (m,) rad, standard deviation of their direction
    one_view: bool  # True if one camera alone saw the ball

    def nearest(self, places: Array) -> Array:
        """(m, 3) m, the points of the rays that are nearest to places (n, 3) m of the samples."""
        far = ((places[self.sample] - self.centres) * self.rays).sum(axis=1)
        return np.asarray(self.centres + np.maximum(far, 0.0)[:, None] * self.rays)

    def some(self, places: Array) -> dict[str, tuple[Array, Array]]:
        """A few rays of each camera that saw the ball: their ends (k, 3) m, there and near the places (n, 3) m."""
        ends, found = self.nearest(places), dict[str, tuple[Array, Array]]()
        for number in np.unique(self.camera).tolist():
            (rows,) = np.nonzero(self.camera == number)
            rows = rows[np.unique(np.linspace(0, len(rows) - 1, MOST_RAYS).round().astype(np.int64))]
            found[self.cameras[number].name] = (self.centres[rows], ends[rows])
        return found

    def measured(self, places: Array) -> tuple[Array, Array]:
        """What stands for measured positions of a ball that one camera saw: (n, 3) m and their standard deviations.

        Along the ray nothing is measured: the points of the rays that are nearest to the places (n, 3) m of an
        estimate differ from these across the rays alone. Both are NaN for samples without a sighting.
        """
        ends, unknown = self.nearest(places), np.full(places.shape, np.nan)
        positions, sigmas = unknown, unknown.copy()
        positions[self.sample] = ends
        across = np.sqrt(np.maximum(1.0 - self.rays**2, 0.0))
        across[across < LEAST_ACROSS] = np.nan
        distances = np.linalg.norm(ends - self.centres, axis=1)
        sigmas[self.sample] = (distances * self.noise)[:, None] * across
        return positions, sigmas


def near_picture(camera: Camera) -> Array:
    """(4, 3) m, the corners of a camera's picture `NEAR_PICTURE` before it."""
    width, height = camera.size
    corners = camera.rays(np.array([[0.0, 0.0], [width, 0.0], [width, height], [0.0, height]]))
    return np.asarray(camera.centre + NEAR_PICTURE * corners / (corners @ camera.rotation[2])[:, None])


class Seen(Protocol):
    """Observations of a track that are sightings: those of `ballfg.estimation`, which is not needed to draw them."""

    sightings: Sightings
    cameras: tuple[Camera, ...]
    state: Index
    one_view: bool


def sight(track: Track) -> Sight:
    """The sightings of a track whose positions were made from them."""
    own = [one for one in track.observations if isinstance(getattr(one, "sightings", None), Sightings)]
    found = cast(Seen, own[0])
    seen, cameras = found.sightings, found.cameras
    centres = np.stack([camera.centre for camera in cameras])[seen.camera]
    if seen.shifts is not None:
        centres = centres + seen.shifts
    rays, noise = np.empty((len(seen), 3)), np.empty(len(seen))
    for number, camera in enumerate(cameras):
        rows = seen.camera == number
        rays[rows] = camera.rays(seen.pixels[rows])
        pixels = np.sqrt(0.5 * np.trace(seen.covariances[rows], axis1=1, axis2=2))
        noise[rows] = pixels / np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1])
    return Sight(cameras, seen.camera, found.state, centres, rays, noise, found.one_view)
