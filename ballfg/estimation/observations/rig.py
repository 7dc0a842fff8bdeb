"""Looks up the cameras of sightings, checks their places, and puts sightings in order of their true times."""

from collections.abc import Sequence
from itertools import combinations
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.checks import listed, shown
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera

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


def true_times_of(sightings: Sightings, cameras: Sequence[Camera]) -> Array:
    """(m,) s, true times of sightings by the clocks and shutters of the cameras, in the order of their numbers."""
    times = np.zeros(len(sightings))
    for number, camera in enumerate(cameras):
        mine = sightings.camera == number
        times[mine] = camera.true_times(sightings.times[mine], sightings.pixels[mine])
    return times


def in_order(sightings: Sightings, cameras: Sequence[Camera]) -> Sightings:
    """The sightings in order of true time, by the cameras' clocks and shutters."""
    times = true_times_of(sightings, cameras_of(sightings, cameras))
    return sightings.select(np.argsort(times, kind="stable"))
