"""Assigns the sightings of a stream to samples with rough positions.

Events are found in positions, and one ray gives none. So each new moment gets the position of a parabola through the
last rays, including the newest. While the rays leave it undetermined, at the start of a flight, sightings are held
back; a single camera later on gets positions extrapolated from the last determined one.
"""

from collections import deque
from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import ArrayLike

from ballfg.checks import check_array, check_choice, shown
from ballfg.estimation.observations.ray_path import AROUND, BEFORE, LOOSE, Path, Rays, filled, rough_path
from ballfg.estimation.observations.sightings import ROUNDING, SAME_MOMENT
from ballfg.estimation.online.state import Measurement, Sample
from ballfg.factors.camera import CameraFactors
from ballfg.factors.loss import Loss
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera
from ballfg.vision.projection import CameraBank

MOST_RAYS: Final = 96
"""Number of stored rays: more than the windows of four cameras hold."""
PATIENCE: Final = 0.3
"""s. A flight with a single camera is extrapolated for so long; then its sightings are held back."""
FORGET: Final = 0.5
"""s. Sightings held back for longer are dropped: nothing links them to later ones."""
STAMPS: Final = 9
"""Number of a camera's stamps that give its period."""


class SightingStream:
    """Turns sightings of a rig's cameras into samples for the window."""

    def __init__(self, cameras: Sequence[Camera], loss: Loss) -> None:
        self.cameras = {camera.name: camera for camera in cameras}
        self.bank = CameraBank(cameras)
        self.loss = loss
        self._stamps: dict[str, deque[float]] = {name: deque(maxlen=STAMPS) for name in self.cameras}
        self._rays: Rays | None = None
        self._held: list[Sample] = []
        self._newest: Sample | None = None
        self._firm: tuple[float, Path] | None = None
        self._last = -np.inf

    def take(
        self, time: float, camera: str, pixel: ArrayLike, covariance: ArrayLike
    ) -> tuple[list[Sample], Measurement | None]:
        """Takes in a sighting.

        Args: as those of `Online.push_sighting`.
        Returns: new samples, oldest first, none while sightings are held back; and the sighting, if it joins the newest
            returned sample.
        Raises: ValueError: an unknown camera, a wrong shape, a number that is not finite, a time before the last.
        """
        check_choice("camera", camera, self.cameras)
        pixel, covariance = check_array("pixel", pixel, (2,)), check_array("covariance", covariance, (2, 2))
        own, number = self.cameras[camera], list(self.cameras).index(camera)
        row = Sightings(tuple(self.cameras), np.array([number]), np.array([time]), pixel[None], covariance[None])
        true = float(own.true_times(row.times, row.pixels)[0])
        stamps = self._stamps[camera]
        if true < self._last - ROUNDING or (stamps and true <= stamps[-1]):
            raise ValueError(
                f"sightings must come in order of true time; got {true} s of camera {shown(camera)} after "
                f"{self._last} s. Hold them back by a frame and sort them."
            )
        true = max(true, self._last)
        stamps.append(true)
        self._last = true
        ray = Rays.of(row, np.array([true]), tuple(self.cameras.values()))
        seen = [s for s in self._stamps.values() if len(s) > 1 and true - s[-1] < FORGET]
        period = max((float(np.median(np.diff(s))) for s in seen), default=0.0)  # of the slowest that sees the ball
        self._rays = ray if self._rays is None else self._rays.joined(ray, MOST_RAYS, period)
        newest, where = self._newest, np.zeros(1, dtype=np.int64)
        since = np.inf if newest is None else true - newest.time
        delay = np.array([since if since <= SAME_MOMENT else 0.0])
        sighting = Measurement(
            CameraFactors(where, row.camera, row.pixels, row.covariances, self.bank, delay, loss=self.loss)
        )
        if newest is None or since > SAME_MOMENT:
            self._newest = Sample(true, np.zeros(3), np.ones(3), measured=False, measurements=[sighting])
            self._held.append(self._newest)
            return self._placed(), None
        if not self._held:
            return [], sighting
        newest.measurements.append(sighting)
        return self._placed(), None

    def _placed(self) -> list[Sample]:
        """The samples that were held back, with positions, once the newest one's is determined."""
        assert self._rays is not None
        now = self._held[-1].time
        path = rough_path(self._rays, np.array([now]), BEFORE)
        if path.sigmas.max() <= LOOSE:
            self._firm = now, path
        elif self._firm is None or now - self._firm[0] > PATIENCE:
            self._held = [sample for sample in self._held if now - sample.time < FORGET]
            return []
        moments = np.array([sample.time for sample in self._held])
        if len(moments) > 1:
            path = rough_path(self._rays, moments, (*AROUND, *BEFORE))
        elif self._firm[0] < now:
            last, known = self._firm
            moments = np.array([last, now])
            path = known.joined(path)
        path = filled(moments, path)
        for k, sample in enumerate(reversed(self._held)):
            sample.position, sample.stated = path.positions[-1 - k], path.sigmas[-1 - k]
        placed, self._held = self._held, []
        return placed
