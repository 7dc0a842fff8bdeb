"""A track that cameras saw: a track with rough positions, and the sightings that an estimate really rests on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import lru_cache
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.estimation.observations.sighted_path import Path, Rays, rough_path
from ballfg.state import STANDARD_GRAVITY, Z
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.track import Label, Track
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CameraBank

Array = NDArray[np.float64]

SAME_MOMENT: Final = 2e-4
"""s. Sightings closer than this share a state, and a camera factor carries it over the rest in a straight line: at
20 m/s^2 that is wrong by 0.4 um. States closer together would cost time and tell nothing."""
LOOSE: Final = 0.05
"""m. Where the rays around a moment leave the position more open than this, its neighbours in time tell it better."""
LOOSE_SIGMA: Final = 0.1
"""m, standard deviation of a position that was interpolated in time: a bounce may lie between its neighbours."""
LOOSE_GROWTH: Final = 2.0
"""m/s, growth of that with the time to the next moment that rays fix: what a window's velocity is worth."""


class NeverSeenByTwoError(ValueError):
    """No two cameras saw the ball within a few frames: there is no telling where it was."""


@dataclass(frozen=True, eq=False)
class SightedTrack(Track):
    """A track whose stamps are the true times of sightings.

    `positions` and `sigmas` are rough, made from the rays about each stamp: good enough to find events in and to start
    from. The smoother and the online estimator put camera factors in their place; the extended Kalman filter and the
    sliding window know positions only, and use these. Neighbouring ones share rays, so their errors go together.

    Made by `sighted_track`.
    """

    sightings: Sightings = field(kw_only=True)
    """Where cameras saw the ball; m of them."""

    cameras: tuple[Camera, ...] = field(kw_only=True)
    """In the order of `sightings.cameras`; their time offsets are in the stamps."""

    state: NDArray[np.int64] = field(kw_only=True)
    """(m,) the sample, or state, that each sighting belongs to, ascending."""

    delay: Array = field(kw_only=True)
    """(m,) s, true time of each sighting minus the stamp of its state: 0 to `SAME_MOMENT`."""

    moved: Array = field(kw_only=True)
    """(cameras,) s, by which the cameras' time offsets were moved since the track was made: what is believed of an
    offset beforehand is believed of where it was then."""

    def __repr__(self) -> str:
        return f"SightedTrack({self.name!r}, {len(self)} samples of {len(self.sightings)} sightings)"

    @property
    def bank(self) -> CameraBank:
        """The cameras in torch; one object for all tracks of a rig."""
        return _bank(self.cameras)

    def between(self, start: float, end: float) -> SightedTrack:
        """As for any track; the sightings of samples outside are left out. The positions keep what they were."""
        inside = (self.times >= start) & (self.times <= end)
        part = Track(self.name, self.times, self.positions, self.sigmas, self.labels).between(start, end)
        rows = inside[self.state]
        return SightedTrack(
            part.name,
            part.times,
            part.positions,
            part.sigmas,
            part.labels,
            sightings=self.sightings.taken(rows),
            cameras=self.cameras,
            state=(np.cumsum(inside) - 1)[self.state[rows]],
            delay=self.delay[rows],
            moved=self.moved,
        )


def sighted_track(
    name: str, sightings: Sightings, cameras: Sequence[Camera], labels: Mapping[str, Label] | None = None
) -> SightedTrack:
    """The track of one ball that cameras saw.

    Args:
        name: of the trajectory.
        sightings: of the ball, in order of true time.
        cameras: of the rig, in any order; those that `sightings` names must be among them.
        labels: what is known of the shot.
    Raises: ValueError: if a camera is missing, rows are not in order of true time, or the ball was never in the view of
        two cameras within a few frames.
    """
    rig = cameras_of(sightings, cameras)
    times = true_times_of(sightings, rig)
    if (np.diff(times) < 0.0).any():
        row = int(np.argmax(np.diff(times) < 0.0)) + 1
        raise ValueError(
            f"track {name!r}: sightings must be in order of true time; row {row}, camera "
            f"{sightings.cameras[sightings.camera[row]]!r}, is earlier than the one before. Sort them with `in_order`."
        )
    first = _firsts(times)
    moments = times[first]
    state = np.cumsum(first) - 1
    path = filled(moments, rough_path(Rays.of(sightings, times, rig), moments), name)
    return SightedTrack(
        name,
        moments,
        path.positions,
        path.sigmas,
        dict(labels or {}),
        sightings=sightings,
        cameras=rig,
        state=state,
        delay=times - moments[state],
        moved=np.zeros(len(rig)),
    )


def retimed(track: SightedTrack, offsets: Array) -> SightedTrack:
    """The track as it is with other time offsets (cameras,) s of its cameras; `moved` tells by how much they moved."""
    cameras = tuple(replace(c, time_offset=float(d)) for c, d in zip(track.cameras, offsets, strict=True))
    again = sighted_track(track.name, in_order(track.sightings, cameras), cameras, track.labels)
    return replace(again, moved=track.moved + offsets - np.array([c.time_offset for c in track.cameras]))


def cameras_of(sightings: Sightings, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras that sightings name, in their order. Raises: ValueError: if one is missing."""
    known = {camera.name: camera for camera in cameras}
    for name in sightings.cameras:
        if name not in known:
            raise ValueError(
                f"cameras must hold every camera of the sightings; {name!r} is missing among {', '.join(known)}. "
                "Add it to cameras.yaml, or leave its sightings out."
            )
    return tuple(known[name] for name in sightings.cameras)


def true_times_of(sightings: Sightings, cameras: Sequence[Camera]) -> Array:
    """(m,) s, when sightings happened: stamps less the time offsets of the cameras, in the order of their numbers."""
    offsets = np.array([camera.time_offset for camera in cameras])
    return np.asarray(sightings.times - offsets[sightings.camera])


def in_order(sightings: Sightings, cameras: Sequence[Camera]) -> Sightings:
    """The sightings in order of true time, as the cameras' time offsets have it."""
    times = true_times_of(sightings, cameras_of(sightings, cameras))
    return sightings.taken(np.argsort(times, kind="stable"))


@lru_cache(maxsize=64)
def _bank(cameras: tuple[Camera, ...]) -> CameraBank:
    return CameraBank(cameras)


def _firsts(times: Array) -> NDArray[np.bool_]:
    """(m,) whether a sighting begins a state of its own."""
    first = np.ones(len(times), dtype=bool)
    begun = times[0]
    for row in range(1, len(times)):
        first[row] = times[row] - begun > SAME_MOMENT
        begun = times[row] if first[row] else begun
    return first


def filled(moments: Array, path: Path, name: str) -> Path:
    """The path with what rays leave open interpolated in time, extrapolated at its ends.

    Args: moments: (n,) s, of the path.  path: from `rough_path`.  name: of the track, for the message.
    Raises: NeverSeenByTwoError: if rays fix no position at all.
    """
    firm = path.sigmas.max(axis=1) <= LOOSE
    if not firm.any():
        raise NeverSeenByTwoError(
            f"track {name!r}: the ball must be seen by two cameras within a few frames; it never is. "
            "Leave the track out, or look at the time offsets of the cameras."
        )
    if firm.all():
        return path
    (at,), (gaps,) = np.nonzero(firm), np.nonzero(~firm)
    place = np.searchsorted(at, gaps)
    before, after = at[np.maximum(place - 1, 0)], at[np.minimum(place, len(at) - 1)]
    since, until = moments[gaps] - moments[before], moments[after] - moments[gaps]
    whole = since + until
    share = np.where(whole > 0.0, since / np.where(whole > 0.0, whole, 1.0), 0.0)[:, None]
    share = share**2 * (3.0 - 2.0 * share)  # Hermite's blend of the two extrapolations: smooth at both ends
    positions, velocities, sigmas = path.positions.copy(), path.velocities.copy(), path.sigmas.copy()
    positions[gaps] = (1 - share) * _fallen(path, before, since) + share * _fallen(path, after, -until)
    velocities[gaps] = (1 - share) * path.velocities[before] + share * path.velocities[after]
    nearest = np.minimum(np.abs(since), np.abs(until))
    nearest = np.where(before == after, np.maximum(np.abs(since), np.abs(until)), nearest)
    sigmas[gaps] = (LOOSE_SIGMA + LOOSE_GROWTH * nearest)[:, None]
    return Path(positions, velocities, sigmas)


def _fallen(path: Path, rows: NDArray[np.int64], elapsed: Array) -> Array:
    """(k, 3) m, where the free fall from some moments is after some time, s."""
    points = path.positions[rows] + elapsed[:, None] * path.velocities[rows]
    points[:, Z] -= 0.5 * STANDARD_GRAVITY * elapsed**2
    return points
