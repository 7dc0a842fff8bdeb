"""Holds the sightings of one ball by one or more cameras, and makes a track with rough positions from them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import TYPE_CHECKING, ClassVar, Final, cast

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.checks import listed, shown
from ballfg.dynamics.nominal import nominal_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.bounced_code import LAWS
from ballfg.estimation.observations.bounced_path import place_prior
from ballfg.estimation.observations.innovation import scatter
from ballfg.estimation.observations.observation import Context, Observation, Unknowns
from ballfg.estimation.observations.one_view import OneView, bounced_at, one_view
from ballfg.estimation.observations.ray_path import Rays, determined, filled, rough_path
from ballfg.estimation.observations.rig import cameras_of, check_apart, in_order, true_times_of
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.segmentation.result import Contact, Segmentation
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import FactorBatch
from ballfg.factors.camera import FIXED, CameraFactors
from ballfg.factors.prior import PriorFactors
from ballfg.factors.uncertain_camera import UncertainCameraFactors
from ballfg.state import POSITION, STATE_DIM
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.stamps import elapsed, written
from ballfg.tracks.track import Label, Track
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CHANGES, CameraBank

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

TIME_OFFSET: Final = "time_offset."  # Prefix of the name of a camera's time offset among the unknowns of a track
CHANGE: Final = "camera."
"""Prefix of the names of the seven numbers by which a camera with a covariance may differ, each of prior sigma 1."""
OFFSET_SETTLED: Final = 1e-5  # s. An offset that changes by less has converged: the path bends by a nanometre meanwhile

SAME_MOMENT: Final = 2e-4
"""s. Sightings closer than this share a state, and a camera factor carries it over the rest in a straight line: at 20
m/s^2 that is wrong by 0.4 um. States closer together would cost time without gain."""
ROUNDING: Final = 1e-6
"""s, by which moments of cameras in step may seem out of order: stamps less time offsets are rounded, and those since
1970 are 0.24 us apart."""
LEAST_SEEN: Final = 5  # Least number of sightings from one point: a flight has six unknowns, and noise must show
LOOSE_DEPTH, LOOSE_SHARE = 0.5, 0.1
"""m, and share of the distance: standard deviation of the depth from which the status of an estimate says so. Where
gravity alone shows how large a flight is, a fifth of the distance is open, near the camera too. Seed 32 of
`tests.estimation.rallies` chose the share, seed 33 and the measured strokes judged it."""


class TooFewSightingsError(ValueError):
    """The ball was seen too rarely for a path."""


@dataclass(eq=False, repr=False)
class CameraSightings(Observation):
    """Pixels of the ball in the images of cameras.

    The stamps of its track are the true times of sightings; those closer than `SAME_MOMENT` share a sample. Where
    `Settings.time_offsets` names cameras, their time offsets are unknowns of the track.

    Args:
        sightings: m of them, in order of true time.
        cameras: c of them, in the order of `sightings.cameras`; the stamps of the track include their time offsets.
        state: (m,) index of the sample that each sighting belongs to, ascending.
        delay: (m,) s, true time of each sighting minus the stamp of its sample: 0 to `SAME_MOMENT`.
        moved: (c,) s, change of the time offsets since the track was made: the prior of an offset is about its first
            value.
        one_view: True if no two cameras saw the ball within a few frames: motion gives the depth.
        bounces: of such a track, as its start has them.
        place: of such a track, prior mean (3,) m and standard deviation m of the first position; None: without.
        known: events of such a track, if they were found before; None: its bounces are looked for.
    """

    name: ClassVar[str] = "sighting"
    locates: ClassVar[bool] = True
    causes: ClassVar[str] = "the cameras' clocks, poses and sigmas"

    sightings: Sightings
    cameras: tuple[Camera, ...]
    state: Index
    delay: Array
    moved: Array
    one_view: bool = False
    bounces: tuple[Contact, ...] = ()
    place: tuple[Array, float] | None = None
    known: Segmentation | None = None

    @property
    def time_offsets(self) -> Array:
        """(c,) s, of the cameras, as the stamps include them."""
        return np.array([camera.time_offset for camera in self.cameras])

    def batch(self, context: Context) -> CameraFactors:
        """Camera factors; with time offsets among the coefficients where they are unknown."""
        names = [TIME_OFFSET + name for name in self.sightings.cameras]
        columns = np.array([context.columns.get(name, FIXED) for name in names])
        places = np.array([context.columns.get(f"{CHANGE}{name}.0", FIXED) for name in self.sightings.cameras])
        seen, bank = self.sightings, _bank(self.cameras)
        given = (self.state, seen.camera, seen.pixels, seen.covariances, bank, self.delay)
        rest = (context.settings.sighting_loss, seen.radii, context.model.radius, seen.shifts)
        if (places == FIXED).all():
            return CameraFactors(*given, columns if (columns != FIXED).any() else None, *rest)
        return UncertainCameraFactors(self.cameras, places, *given, columns, *rest)

    def unknowns(self, settings: Settings) -> Unknowns:
        """The time offsets that the settings name, s, each counted from that of its camera.

        Raises: ValueError: if the settings name a camera that the track does not have.
        """
        names = self.sightings.cameras
        for name in settings.time_offsets:
            if name not in names:
                raise ValueError(f"time_offsets must name cameras of the track, {listed(names)}; got {shown(name)}")
        chosen = [names.index(name) for name in settings.time_offsets]
        loose = [camera.name for camera in self.cameras if camera.covariance is not None]
        changes = [f"{CHANGE}{name}.{number}" for name in loose for number in range(CHANGES)]
        rest = np.zeros(len(changes))
        return Unknowns(
            (*(TIME_OFFSET + name for name in settings.time_offsets), *changes),
            np.append(-self.moved[chosen], rest),
            np.append(np.array(list(settings.time_offsets.values())), rest + 1.0),
            np.append(self.time_offsets[chosen], rest),
        )

    def found_offsets(self, estimate: Estimate) -> tuple[Array, Array]:
        """Time offsets (c,) s of all cameras after an estimate, and their covariance (c, c) s^2.

        Fixed offsets are the cameras' own, with zero covariance.
        """
        rows = [estimate.unknown_names.index(n) for n in estimate.unknown_names if n.startswith(TIME_OFFSET)]
        cameras = [self.sightings.cameras.index(estimate.unknown_names[r].removeprefix(TIME_OFFSET)) for r in rows]
        offsets, covariance = self.time_offsets, np.zeros((len(self.cameras),) * 2)
        offsets[cameras] = estimate.unknowns[rows]
        covariance[np.ix_(cameras, cameras)] = estimate.unknown_covariance[np.ix_(rows, rows)]
        return offsets, covariance

    def retimed(self, track: Track, estimate: Estimate) -> Track | None:
        """The track with the estimated time offsets; None if they changed by less than `OFFSET_SETTLED`."""
        offsets, _ = self.found_offsets(estimate)
        return None if np.abs(offsets - self.time_offsets).max() < OFFSET_SETTLED else self.with_offsets(track, offsets)

    def with_offsets(self, track: Track, offsets: Array) -> Track:
        """The track with other time offsets (c,) s; `moved` holds their change."""
        cameras = tuple(replace(c, time_offset=float(d)) for c, d in zip(self.cameras, offsets, strict=True))
        again = sighted_track(track.name, in_order(self.sightings, cameras), cameras, track.labels)
        seen = sightings_of(again)
        seen.moved = self.moved + offsets - self.time_offsets
        return again.observed(*(other.onto(track, again) for other in track.observations if other is not self))

    def select(self, samples: NDArray[np.bool_]) -> CameraSightings:
        """The sightings of some samples."""
        rows, number = samples[self.state], np.cumsum(samples) - 1
        sightings, state = self.sightings.select(rows), number[self.state[rows]]
        own = CameraSightings(sightings, self.cameras, state, self.delay[rows], self.moved, self.one_view)
        if self.known is not None and samples[: len(own.sightings)].all():  # the first samples, as predictions observe
            own.place, own.known = self.place, self.known.opening(int(samples.sum()))
        return own

    def starts(self, track: Track, model: BallModel, surfaces: Surfaces) -> tuple[Track, ...]:
        """The track with the paths that its own sightings, the ball and the surfaces give, if one camera saw it.

        Args: track: of the observation, with stamps since its first.  model: the ball.  surfaces: table and floor.
        """
        if not self.one_view or self.known is not None:
            return (track,)
        times = track.times[self.state] + self.delay
        found = one_view(Rays.of(self.sightings, times, self.cameras), track.times, physics_of(model), surfaces)
        return tuple(self._on(track, path, place_prior(surfaces)) for path in found)

    def _on(self, track: Track, found: OneView, place: tuple[Array, float]) -> Track:
        """The track with one path and the prior of its place."""
        arrays = (self.sightings, self.cameras, self.state, self.delay, self.moved)
        own = CameraSightings(*arrays, one_view=True, bounces=found.contacts(track.times), place=place)
        return replace(self._in_place(track, own), positions=found.path.positions, sigmas=found.path.sigmas)

    def _in_place(self, track: Track, other: CameraSightings) -> Track:
        """The track with other sightings in place of these."""
        return replace(track, observations=tuple(other if one is self else one for one in track.observations))

    def with_noise(self, track: Track, covariances: Array) -> Track:
        """The track with other covariances (m, 2, 2) px^2 of its sightings, seen by exact cameras."""
        noisy = replace(self.sightings, covariances=covariances)
        exact = tuple(replace(camera, covariance=None) for camera in self.cameras)
        return self._in_place(track, replace(self, sightings=noisy, cameras=exact))

    def loosened(self, track: Track) -> Track | None:
        """The track with the error of a start's laws added to the noise of its pixels, if that is smaller."""
        if not self.one_view or self.known is not None:
            return None
        seen = self.sightings
        points, spread = seen.from_cameras(track.positions[self.state]), np.empty((len(seen), 2))
        for number in np.unique(seen.camera):  # several, where one saw the ball after the other
            camera, mine = self.cameras[number], seen.camera == number
            spread[mine] = (LAWS / camera.depth(points[mine])[:, None] * np.diag(camera.matrix)[:2]) ** 2
        if np.median(spread) < np.median(np.trace(seen.covariances, axis1=1, axis2=2)) / 2.0:
            return None
        noisy = replace(seen, covariances=seen.covariances + spread[:, :, None] * np.eye(2))
        return self._in_place(track, replace(self, sightings=noisy))

    def across(self, first: int, positions: Array, covariances: Array) -> tuple[Array, Array]:
        """Errors of positions across the rays of the sightings, with their standard deviations.

        Args:
            first: index of the sample of the first position; the others follow.
            positions: (k, 3) m.  covariances: (k, 3, 3) m^2.
        Returns: (m, 2) m each, of the m sightings of those samples: along u and v, at the depth of the position; NaN
            behind a camera. The deviations include the noise of the sightings.
        """
        rows = (self.state >= first) & (self.state < first + len(positions))
        state, seen = self.state[rows] - first, self.sightings.select(rows)
        pixels, slope = _bank(self.cameras).jacobian(seen.from_cameras(positions[state]), seen.camera)
        spread = slope @ covariances[state] @ slope.swapaxes(1, 2) + seen.covariances
        scale = np.sqrt(2.0) / np.linalg.norm(slope, axis=(1, 2))[:, None]  # m for a pixel
        return scale * (pixels - seen.pixels), scale * np.sqrt(np.diagonal(spread, axis1=1, axis2=2))

    def priors(self) -> list[FactorBatch]:
        """The prior of the first position of a track that one camera saw: rays alone leave its distance open."""
        if self.place is None:
            return []
        mean, root = np.zeros((1, STATE_DIM)), np.zeros((1, 3, STATE_DIM))
        mean[:, POSITION], root[0, :, POSITION] = self.place[0], np.eye(3) / self.place[1]
        return [PriorFactors(np.zeros(1, dtype=np.int64), mean, root)]

    def lines(self, positions: Array) -> tuple[Array, Array]:
        """Directions (n, 3) and distances (n,) m from the cameras to positions (n, 3) m of the track's samples."""
        first = np.searchsorted(self.state, np.arange(len(positions)))
        centres = np.stack([camera.centre for camera in self.cameras])[self.sightings.camera[first]]
        rays = self.sightings.select(first).from_cameras(positions) - centres
        distance = np.linalg.norm(rays, axis=1)
        return rays / distance[:, None], distance

    def judged(self, estimate: Estimate) -> Estimate:
        """The estimate, with the status `DEPTH_UNCERTAIN` if one camera saw the ball and its depth is loose."""
        estimate = super().judged(estimate)
        if not self.one_view or estimate.status is not Status.OK:
            return estimate
        rays, distance = self.lines(estimate.states[:, POSITION])
        sigma = np.sqrt(np.einsum("ni,nij,nj->n", rays, estimate.covariances[:, POSITION, POSITION], rays))
        loose = np.median(sigma) > LOOSE_DEPTH or np.median(sigma / distance) > LOOSE_SHARE
        return replace(estimate, status=Status.DEPTH_UNCERTAIN) if loose else estimate

    def _parts(self, estimate: Estimate) -> Mapping[str, float]:
        if len(self.cameras) == 1:
            return {}
        seen, found = estimate.innovations[self.name], self.sightings.camera
        each = {camera.name: scatter(seen[found == number]) for number, camera in enumerate(self.cameras)}
        return {name: far for name, far in each.items() if np.isfinite(far)}

    def segmentation(self) -> Segmentation | None:
        """The bounces of a track that one camera saw; None if the positions show the events."""
        if not self.one_view:
            return None
        return self.known or Segmentation.of_contacts(self.bounces, int(self.state.max()) + 1)


def sightings_of(track: Track) -> CameraSightings:
    """The sightings of a track.

    Raises: ValueError: if it has none.
    """
    for observation in track.observations:
        if observation.name == CameraSightings.name:
            return cast(CameraSightings, observation)
    raise ValueError(
        f"track {shown(track.name)} must have sightings of cameras; it has none. Make it with sighted_track."
    )


def sighted_track(
    name: str,
    sightings: Sightings,
    cameras: Sequence[Camera],
    labels: Mapping[str, Label] | None = None,
    *,
    model: BallModel | None = None,
    surfaces: Surfaces | None = None,
    bounces: Array | None = None,
) -> Track:
    """The track of one ball from the sightings of one or more cameras.

    Its `positions` and `sigmas` are rough, from the rays around each stamp: good enough for finding events and for a
    start. The smoother and the online estimator use camera factors instead; the extended Kalman filter and the sliding
    window use positions only, and take these. Neighbouring ones share rays, so their errors are correlated.

    Args:
        name: of the trajectory.
        sightings: of the ball, in order of true time.
        cameras: of the rig, in any order, with all that `sightings` names.
        labels: of the shot.
        model, surfaces: of the ball, and of what it bounces on, for the positions of a ball that one camera saw;
            estimators use their own. None: table tennis, with the table at z = 0.
        bounces: (b,) s, stamps of all bounces of a ball that one camera saw, if they were found before; None: unknown.
    Raises: ValueError: if a camera is missing, two cameras stand at one point, rows are not in order of true time, or
        one camera saw the ball less than `LEAST_SEEN` times.
    """
    rig = cameras_of(sightings, cameras)
    check_apart([rig[number] for number in np.unique(sightings.camera)])
    origin = float(sightings.times[0]) if len(sightings) else 0.0
    times = true_times_of(replace(sightings, times=elapsed(sightings.times, origin)), rig)
    early = np.diff(times) < -ROUNDING
    if early.any():
        row = int(np.argmax(early)) + 1
        raise ValueError(
            f"track {shown(name)}: sightings must be in order of true time; row {row}, camera "
            f"{shown(sightings.cameras[sightings.camera[row]])}, is earlier than the one before. "
            "Sort them with `in_order`."
        )
    times = np.maximum.accumulate(times)
    first, begun = np.ones(len(times), dtype=bool), times[0]  # those that begin a state of their own
    for row in range(1, len(times)):
        first[row] = times[row] - begun > SAME_MOMENT
        begun = times[row] if first[row] else begun
    moments = times[first]
    state = np.cumsum(first) - 1
    rays = Rays.of(sightings, times, rig)
    path = rough_path(rays, moments)
    alone = not determined(path).any()
    known: OneView | None = None
    if alone:
        ball, ground = physics_of(nominal_model() if model is None else model), surfaces or Surfaces.table_tennis(0.0)
        if not ground.heights():
            raise ValueError(
                f"track {shown(name)}: a ball that one camera saw must bounce on a surface, which shows how far away "
                "it is; got none. State frame.table_height, or use a second camera."
            )
        if bounces is not None:
            known = bounced_at(rays, moments, ball, ground, elapsed(bounces, origin))
        elif len(moments) < LEAST_SEEN:
            raise TooFewSightingsError(
                f"track {shown(name)}: a ball that one camera saw must be seen {LEAST_SEEN} times or more; got "
                f"{len(moments)}. Leave the track out, or look at the time offsets of the cameras."
            )
        path = (known or one_view(rays, moments, ball, ground)[0]).path
    else:
        path = filled(moments, path)
    seen = CameraSightings(sightings, rig, state, times - moments[state], np.zeros(len(rig)), alone)
    if known is not None:
        seen.place = place_prior(ground)
        since = moments - moments[0]  # as an estimator counts the stamps of a track: a time offset moves all of them
        known = replace(known, bounces=tuple((np.array(known.bounces) - moments[0]).tolist()))
        seen.known = Segmentation.of_contacts(known.contacts(since), len(moments))
    stamps = written(moments, origin)
    return Track(stamps, path.positions, path.sigmas, dict(labels or {}), observations=(seen,), rough=True, name=name)


@lru_cache(maxsize=64)
def _bank(cameras: tuple[Camera, ...]) -> CameraBank:
    """The cameras in torch; one object for all tracks of a rig."""
    return CameraBank(cameras)
