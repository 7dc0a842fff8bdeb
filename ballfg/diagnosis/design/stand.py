"""Tells where one camera should stand: how well it would know strokes from each of many places.

From each place the strokes of a dataset are filmed without noise and estimated from these sightings alone. A sample
that is out of the picture or behind the table counts as one of unbounded error: else the best place would see a small
part of each stroke well, or through the table.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array, Mask
from ballfg.checks import check_array, check_number
from ballfg.dynamics import BallModel, Surfaces
from ballfg.estimation import Estimate, Settings, Smoother, Status, dataset_settings, dataset_surfaces, sighted_track
from ballfg.estimation.batch import do_all, map_tracks
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.observations.sightings import LEAST_SEEN
from ballfg.simulation.cameras import looking_at
from ballfg.state import POSITION
from ballfg.tracks import Dataset
from ballfg.tracks.sightings import Sightings
from ballfg.vision import Camera

STROKES: Final = 20  # Of a dataset, evenly over it, that are filmed from each place
NOISE: Final = 0.5  # px


@dataclass(frozen=True)
class Stand:
    """What a camera at a place, which looks at the middle of the strokes, would tell of them.

    Attributes:
        place: (x, y, z) m.
        sigma: m, median over all samples of the standard deviation of the ball's place, in all directions together;
            inf where most are not seen.
        seen: share of all samples that it sees, in strokes that it sees often enough.
        uncertain: share of these strokes whose depth is called uncertain.
    """

    place: tuple[float, float, float]
    sigma: float
    seen: float
    uncertain: float


def where_to_stand(
    dataset: Dataset, model: BallModel, lens: Camera, places: Array, *, noise: float = NOISE, jobs: int = 1
) -> list[Stand]:
    """How well one camera would know the strokes of a dataset from each place, the best place first.

    Args:
        dataset: strokes, up to `STROKES` of which are filmed at their own stamps.  model: of the ball.
        lens: a camera whose place does not count.  places: (n, 3) m.  noise: px, of each coordinate of a sighting.
    Raises: ValueError: places of another shape or above the middle of the strokes, or no stroke that is estimated.
    """
    places = check_array("places", places, remedy="Give a row x, y, z (m) for each place.")
    if places.ndim != 2 or places.shape[1] != 3 or not len(places):
        raise ValueError(f"places must have shape (n, 3), n at least 1; got {places.shape}. Give x, y, z in m.")
    if not check_number("noise", noise, "px") > 0.0:
        raise ValueError(f"noise must be positive; got {noise:g} px. Give that of your detector.")
    surfaces = dataset_surfaces(dataset)
    smoother = Smoother(model, surfaces, dataset_settings(dataset, model))
    tracks = list(spread_over(iter(dataset), len(dataset), STROKES))
    flown = [one for one in map_tracks(smoother.estimate, tracks, len(tracks), jobs) if one.status is Status.OK]
    if not flown:
        raise ValueError("dataset must hold a stroke whose estimate is sure; it holds none. Look at 'ballfg estimate'.")
    target = np.median(np.concatenate([one.states[:, POSITION] for one in flown]), axis=0)
    asked = [partial(_stand, place, _turned(lens, place, target), flown, model, surfaces, noise) for place in places]
    stands = do_all(asked, jobs)
    return sorted(stands, key=lambda one: (one.sigma, -one.seen))


def _turned(lens: Camera, place: Array, target: Array) -> Camera:
    """A camera with a lens at a place, level, its principal point on a target."""
    pose = looking_at(lens.name, place, target, 1.0, lens.size)
    return replace(lens, rvec=pose.rvec, tvec=pose.tvec, covariance=None)


def _stand(
    place: Array, camera: Camera, flown: Sequence[Estimate], model: BallModel, surfaces: Surfaces, noise: float
) -> Stand:
    """What a camera at a place tells of strokes."""
    smoother, known = Smoother(model, surfaces, Settings.for_measured(model)), list[Estimate]()
    for one in flown:
        found = _seen(smoother, camera, one, noise)
        known += [] if found is None else [found]
    sigmas, seen = np.full(sum(map(len, flown)), np.inf), sum(map(len, known))
    if known:
        covariances = np.concatenate([one.covariances[:, POSITION, POSITION] for one in known])
        sigmas[:seen] = np.sqrt(np.trace(covariances, axis1=1, axis2=2))
    uncertain = sum(one.status is Status.DEPTH_UNCERTAIN for one in known) / max(len(known), 1)
    x, y, z = place.tolist()
    return Stand((x, y, z), float(np.median(sigmas)), seen / len(sigmas), uncertain)


def _seen(smoother: Smoother, camera: Camera, flown: Estimate, noise: float) -> Estimate | None:
    """The estimate of a stroke from what a camera sees of it; None if that is too little."""
    positions = flown.states[:, POSITION]
    (rows,) = np.nonzero(camera.in_view(positions) & ~_hidden(camera, positions, smoother.surfaces))
    if len(rows) < LEAST_SEEN:
        return None
    times, pixels = flown.times[rows], camera.project(positions[rows])
    stamps = 2.0 * times - camera.true_times(times, pixels)
    own = (np.zeros(len(rows), dtype=np.int64), stamps, pixels, np.tile(noise**2 * np.eye(2), (len(rows), 1, 1)))
    bounces = np.array([contact.time for contact in flown.contacts if times[0] < contact.time < times[-1]])
    seen, model, surfaces = Sightings((camera.name,), *own), smoother.model, smoother.surfaces
    track = sighted_track(flown.name, seen, [camera], model=model, surfaces=surfaces, bounces=bounces)
    estimate = smoother.estimate(track)
    return estimate if estimate.status in (Status.OK, Status.DEPTH_UNCERTAIN) else None


def _hidden(camera: Camera, positions: Array, surfaces: Surfaces) -> Mask:
    """(n,) True where a table with known ends is between a camera and positions (n, 3), one above it and one below."""
    if surfaces.extent is None:
        return np.zeros(len(positions), dtype=bool)
    rise, start = positions[:, 2] - surfaces.table_height, camera.centre[2] - surfaces.table_height
    apart = rise * start < 0.0
    share = np.where(apart, start, 0.0) / np.where(apart, start - rise, 1.0)
    crossings = camera.centre + share[:, None] * (positions - camera.centre)
    return np.asarray(apart & surfaces.over_table(torch.from_numpy(crossings)).numpy())
