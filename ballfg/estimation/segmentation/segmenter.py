"""Explains a stream by a multi-hypothesis (Viterbi) Kalman filter, one sample at a time, in bounded memory."""

import copy
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation.bank import HYPOTHESIS, LOGGED, Records, Scene
from ballfg.estimation.segmentation.explain import follow
from ballfg.estimation.segmentation.log import chain
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Event, EventKind
from ballfg.estimation.segmentation.settings import SegmentationSettings

USUAL = SegmentationSettings()


@dataclass(frozen=True)
class Decision:
    """The events that became final with a sample, reported once, and the best explanation of all later ones."""

    final: tuple[Event, ...]
    pending: tuple[Event, ...]


class Segmenter:
    """Explains a stream of measured positions: contacts, hits, rests, tracker shifts, bad samples.

    Every hypothesis is one explanation of the past. A sample branches the hypotheses (at surfaces always; into hits
    and shifts when the best of them is surprised), weighs them, and drops the unlikely. Events `settings.lag` samples
    old become final: hypotheses that deny them are dropped, so that memory is bounded on an endless stream.

    Args: surfaces: table and floor.  physics: of the ball; see `physics_of`.  settings: noise model and prices.
    """

    def __init__(
        self, surfaces: Surfaces, physics: SegmentationPhysics, settings: SegmentationSettings = USUAL
    ) -> None:
        self._scene = Scene(physics, surfaces, settings)
        self._bank: Records = np.empty(0, HYPOTHESIS)
        self._log: Records = np.empty(0, LOGGED)
        self._open: dict[int, Event] = {}
        """The best explanation's events that are not final, oldest first, by their serial numbers."""
        self.count = 0
        """Number of samples so far."""
        self._time = -math.inf

    def copy(self) -> "Segmenter":
        """An independent segmenter with the same samples."""
        return copy.copy(self)  # nothing is changed in place

    def push(self, time: float, position: ArrayLike, sigma: ArrayLike) -> Decision:
        """Takes in the next sample.

        Args: time: s, later than the last.  position: (3,) m.  sigma: (3,) m, standard deviations.
        Raises: ValueError: if the time does not increase, or something is not finite or has a wrong shape.
        """
        if not math.isfinite(time) or time <= self._time:
            raise ValueError(f"time must be finite and increase; got {time} s after {self._time} s. Sort the samples.")
        point, noise = _triple("position", position), _triple("sigma", sigma)
        return self._followed(np.array([time]), point[None], noise[None])

    def push_all(self, times: Array, positions: Array, sigmas: Array) -> Decision:
        """Takes in all of the next samples, which are finite and in order: (n,) s, (n, 3) m, (n, 3) m."""
        return self._followed(*(np.array(given, order="C") for given in (times, positions, sigmas)))

    def _followed(self, times: Array, positions: Array, sigmas: Array) -> Decision:
        if not len(times):
            return Decision((), ())
        scene, noise = self._scene, np.maximum(sigmas, self._scene.settings.sigma_floor)
        level = scene.physics.level(positions)
        known = (self._bank, self._log, self._time, times, level, noise, self.count, scene.numbers, scene.rows)
        self._bank, self._log, final = follow(*known)
        self._time = float(times[-1])
        self.count += len(times)
        decided = tuple(self._events(final).values())
        self._open = self._events(chain(self._bank[0]["tip"], self._log)) if len(self._log) else {}
        return Decision(decided, tuple(self._open.values()))

    def _events(self, rows: Records) -> dict[int, Event]:
        """The events in some rows of a log; those that were open in the last explanation are the same objects."""
        found = {}
        for number, index, surface, _, serial, time, offset in rows.tolist():
            kind, height = EventKind(number), self._scene.height(surface)
            event = Event(kind, index, time, height, np.array(offset) if kind is EventKind.SHIFT else None)
            found[serial] = self._open.get(serial, event)
        return found


def _triple(name: str, value: ArrayLike) -> NDArray[np.float64]:
    array = np.ascontiguousarray(value, dtype=np.float64)
    if array.shape != (3,) or not all(map(math.isfinite, array.tolist())):
        raise ValueError(f"{name} must be three finite numbers in m; got {value!r}. Drop samples without a position.")
    return array
