"""Estimates the time offsets of a rig's cameras from all tracks of a recording."""

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.checks import listed, shown
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from ballfg.vision.camera import Camera

PRIOR: Final = 0.01
"""s, prior standard deviation of a time offset about the camera's own: a frame or so."""
ROUNDS: Final = 8
"""Largest number of corrections of the stamps; 4 ms converge in three rounds, a whole frame in five."""
USABLE: Final = (Status.OK, Status.NOT_CONVERGED)
SETTLED: Final = 0.1
"""Standard deviations. Offsets that change by less have converged."""


@dataclass(frozen=True, eq=False)
class TimeOffsets:
    """The clocks of a rig.

    Attributes:
        cameras: the rig's, with the estimated time offsets.
        covariance: (c, c) s^2 of the offsets; zero for the reference.
        settled: True if another round would not change the offsets; if False, check the calibration.
        tracks: number of tracks in the estimate.
    """

    cameras: tuple[Camera, ...]
    covariance: Array
    settled: bool
    tracks: int

    @property
    def offsets(self) -> Array:
        """(c,) s."""
        return np.array([camera.time_offset for camera in self.cameras])

    @property
    def sigmas(self) -> Array:
        """(c,) s, standard deviations."""
        return np.sqrt(np.diagonal(self.covariance))


def estimate_time_offsets(
    tracks: Iterable[Track],
    model: BallModel,
    surfaces: Surfaces,
    settings: Settings,
    reference: str | None = None,
    prior: float = PRIOR,
) -> TimeOffsets:
    """Delays of each camera's stamps, relative to a reference camera.

    Each track is smoothed with its own offsets. Its information on them is its posterior's less the prior's; the sum
    over all tracks, with the prior counted once, is the estimate. Then all stamps are corrected by it, because a camera
    factor follows the ball in a straight line, and the tracks are smoothed again, until the offsets converge.

    Args:
        tracks: of one rig. One of half a second gives offsets to 0.1 ms, if cameras resolve a third of a pixel.
        model: the ball.  surfaces: table and floor.
        settings: noise and priors; their `time_offsets` are ignored.
        reference: name of the camera with the fixed offset; None: the first.
        prior: s, prior standard deviation of the other offsets.
    Raises: ValueError: no tracks, tracks of different rigs, an unknown reference, or no track that can be smoothed.
    """
    tracks = list(tracks)
    names = _rig_of(tracks)
    reference = names[0] if reference is None else reference
    if reference not in names:
        raise ValueError(f"reference must be one of the cameras {listed(names)}; got {shown(reference)}")
    if len(names) < 2:
        raise ValueError(
            f"tracks must be seen by two cameras or more; got {shown(names[0])} alone. Its clock is the time."
        )
    free = np.array([k for k, name in enumerate(names) if name != reference])
    own = replace(settings, time_offsets={names[k]: prior for k in free})
    smoother = Smoother(model, surfaces, own)
    first = smoother.first_look()
    believed = sightings_of(tracks[0]).time_offsets
    offsets, settled = believed, False
    for k in range(ROUNDS):
        estimates = [((smoother if k else first).estimate(track, move_stamps=False), track) for track in tracks]
        used = [sightings_of(t).found_offsets(e) for e, t in estimates if e.status in USABLE]
        if not used:
            raise ValueError("tracks must hold one that can be smoothed; none could. Look at the calibration first.")
        found, covariance = _fused(used, believed, free, prior)
        moved = np.abs(found - offsets)[free] / np.sqrt(np.diagonal(covariance)[free])
        offsets, settled = found, bool(k > 0 and (moved < SETTLED).all())
        tracks = [sightings_of(track).with_offsets(track, offsets) for track in tracks]
        if settled:
            break
    return TimeOffsets(sightings_of(tracks[0]).cameras, covariance, settled, len(used))


def _rig_of(tracks: list[Track]) -> tuple[str, ...]:
    """The names of the cameras."""
    if not tracks:
        raise ValueError("tracks must hold at least one; got none. Time offsets need a ball in flight.")
    first = sightings_of(tracks[0])
    for track in tracks:
        if sightings_of(track).cameras != first.cameras:
            raise ValueError(
                f"tracks must be seen by the same cameras; those of {shown(track.name)} and {shown(tracks[0].name)} "
                "differ. Make all of them with the same list of cameras."
            )
    return first.sightings.cameras


def _fused(
    found: list[tuple[Array, Array]], believed: Array, free: NDArray[np.int64], prior: float
) -> tuple[Array, Array]:
    """Offsets (c,) and their covariance (c, c) from all tracks, with the prior counted once."""
    before = np.eye(len(free)) / prior**2
    information, pull = before.copy(), np.zeros(len(free))
    for offsets_of_track, covariance_of_track in found:
        after = np.linalg.inv(covariance_of_track[np.ix_(free, free)])
        information += after - before
        pull += after @ (offsets_of_track - believed)[free]
    covariance = np.zeros((len(believed), len(believed)))
    covariance[np.ix_(free, free)] = np.linalg.inv(information)
    offsets = believed.copy()
    offsets[free] += np.linalg.solve(information, pull)
    return offsets, covariance
