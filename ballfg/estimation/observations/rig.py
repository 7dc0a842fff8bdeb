"""Looks up the cameras of sightings, checks their places and clocks, and puts sightings in order of true time."""

from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import listed, shown
from ballfg.tracks.checks import check_overlap
from ballfg.tracks.sightings import Sightings
from ballfg.tracks.track import Track
from ballfg.vision.camera import Camera

LONGEST_UNSEEN: Final = 3.0  # s. No flight that is seen at its ends only lasts longer: it would rise by 11 m
APART: Final = 0.01  # m. Least distance of two cameras: rays from one point do not meet anywhere else, and count twice


def check_apart(cameras: Sequence[Camera]) -> None:
    """Refuses cameras that stand at one point. Raises: ValueError: naming two of them."""
    for one, other in combinations(cameras, 2):
        if np.linalg.norm(one.centre - other.centre) < APART:
            raise ValueError(
                f"cameras must stand apart; {shown(one.name)} and {shown(other.name)} share a centre, so that together "
                "they see no more than one. Leave one of them out, or correct its pose."
            )


def cameras_of(sightings: Sightings, cameras: Sequence[Camera]) -> tuple[Camera, ...]:
    """The cameras that sightings name, in their order. Raises: ValueError: if one is missing."""
    known = {camera.name: camera for camera in cameras}
    for name in sightings.cameras:
        if name not in known:
            raise ValueError(
                f"cameras must hold every camera of the sightings; {shown(name)} is missing among {listed(known)}. "
                "Add it to cameras.yaml, or leave its sightings out."
            )
    return tuple(known[name] for name in sightings.cameras)


def check_one_flight(track: Track) -> None:
    """Refuses a ball that one camera saw, if it was out of sight for long. Raises: ValueError: naming the gap."""
    gaps = np.diff(track.times)
    if track.one_view and len(gaps) and gaps.max() > LONGEST_UNSEEN:
        before = int(np.argmax(gaps))
        start = round(float(track.times[before]), 3)
        raise ValueError(
            f"track {shown(track.name)}: a ball that one camera saw must not be out of sight for more than "
            f"{LONGEST_UNSEEN:g} s; got {gaps[before]:.4g} s from t={start:.13g}. Give its flights names of their own, "
            "or correct the stamps."
        )


def check_clocks(name: str, sightings: Sightings, cameras: Sequence[Camera]) -> None:
    """Refuses sightings of one ball, in order of true time, by cameras far apart in time. Raises: ValueError."""
    times = true_times_of(sightings, cameras)
    own = {cameras[number].name: times[sightings.camera == number] for number in np.unique(sightings.camera)}
    try:
        check_overlap({camera: (float(t[0]), float(t[-1])) for camera, t in own.items()}, LONGEST_UNSEEN)
    except ValueError as error:
        raise ValueError(f"track {shown(name)}: {error}") from None


def true_times_of(sightings: Sightings, cameras: Sequence[Camera]) -> Array:
    """(m,) s, true times of sightings by the clocks and shutters of the cameras, in the order of their numbers."""
    times = np.zeros(len(sightings))
    for number, camera in enumerate(cameras):
        mine = sightings.camera == number
        times[mine] = camera.true_times(sightings.times[mine], sightings.pixels[mine])
    return times


def with_ends(sightings: Sightings, cameras: Sequence[Camera]) -> Sightings:
    """The sightings with both ends of each streak, as the shutter opened and closed, in place of its middle.

    Either end has twice the variance of the middle, which is their mean. The motion from the sighting before and to
    the one after tells which end is first; where they differ, as at a hit, the middle stays.

    Args: cameras: in the order of their numbers; those without a known exposure show no ends.
    Raises: ValueError: an exposure that is longer than the time between two sightings.
    """
    if sightings.streaks is None:
        return sightings
    way = np.zeros((len(sightings), 2))
    for number, camera in enumerate(cameras):
        rows = np.flatnonzero(sightings.camera == number)
        if camera.exposure > 0.0 and len(rows) > 1:
            steps = np.diff(sightings.times[rows])
            if steps.min() <= camera.exposure:
                raise ValueError(
                    f"camera {shown(camera.name)}: exposure must be shorter than the {steps.min():g} s between two "
                    f"sightings; got {camera.exposure:g} s. Correct it in cameras.yaml."
                )
            way[rows] = _forward(sightings.streaks[rows], np.diff(sightings.pixels[rows], axis=0))
    long = np.linalg.norm(way, axis=1) > 0.0
    rows, half = np.repeat(np.arange(len(long)), 1 + long), np.array([camera.exposure for camera in cameras]) / 2.0
    end = np.zeros(len(rows))  # -1 and 1 for the ends, 0 for a middle
    end[np.append(False, rows[1:] == rows[:-1])] = 1.0
    end[np.append(rows[1:] == rows[:-1], False)] = -1.0
    times = sightings.times[rows] + end * half[sightings.camera[rows]]
    pixels = sightings.pixels[rows] + 0.5 * end[:, None] * way[rows]
    spread = sightings.covariances[rows] * np.where(end == 0.0, 1.0, 2.0)[:, None, None]
    radii = None if sightings.radii is None else sightings.radii[rows]
    shifts = None if sightings.shifts is None else sightings.shifts[rows]
    return Sightings(sightings.cameras, sightings.camera[rows], times, pixels, spread, radii, shifts=shifts)


def _forward(streaks: Array, moved: Array) -> Array:
    """Streaks (n, 2) px along the motions (n - 1, 2) px between them; 0 where these do not tell which way."""
    sides = np.concatenate((moved[:1], moved)), np.concatenate((moved, moved[-1:]))  # before, and after
    ways = [np.sign((streaks * side).sum(axis=1)) for side in sides]
    return np.asarray(streaks * np.where(ways[0] == ways[1], ways[0], 0.0)[:, None])


def in_order(sightings: Sightings, cameras: Sequence[Camera]) -> Sightings:
    """The sightings in order of true time, by the cameras' clocks and shutters."""
    times = true_times_of(sightings, cameras_of(sightings, cameras))
    return sightings.select(np.argsort(times, kind="stable"))
