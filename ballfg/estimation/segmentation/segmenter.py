"""Explains a stream by a multi-hypothesis (Viterbi) Kalman filter, one sample at a time, in bounded memory."""

import copy
import math
from dataclasses import dataclass
from functools import partial

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation.bank import HYPOTHESIS, NO_EVENT, Records, Scene
from ballfg.estimation.segmentation.explain import explain
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Event, EventKind, Node, contains, copied, make_final, open_nodes
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
        self._tips: list[Node | None] = []
        self.count = 0
        """Number of samples so far."""
        self._time = -math.inf

    def copy(self) -> "Segmenter":
        """An independent segmenter with the same samples."""
        other = copy.copy(self)
        known: dict[int, Node] = {}
        other._tips = [copied(tip, known) for tip in self._tips]
        return other

    def push(self, time: float, position: ArrayLike, sigma: ArrayLike) -> Decision:
        """Takes in the next sample.

        Args: time: s, later than the last.  position: (3,) m.  sigma: (3,) m, standard deviations.
        Raises: ValueError: if the time does not increase, or something is not finite or has a wrong shape.
        """
        if not math.isfinite(time) or time <= self._time:
            raise ValueError(f"time must be finite and increase; got {time} s after {self._time} s. Sort the samples.")
        point, noise = _triple("position", position), _triple("sigma", sigma)
        final = self._taken(time, point, np.maximum(noise, self._scene.settings.sigma_floor))
        return Decision(final, tuple(node.event for node in open_nodes(self._tips[0])))

    def push_all(self, times: Array, positions: Array, sigmas: Array) -> list[Event]:
        """The events of all samples so far, oldest first, after finite samples in order."""
        events: list[Event] = []
        noise = np.array(np.maximum(sigmas, self._scene.settings.sigma_floor), order="C")
        for sample in zip(times.tolist(), np.array(positions, order="C"), noise, strict=True):
            events += self._taken(*sample)
        return events + ([node.event for node in open_nodes(self._tips[0])] if self._tips else [])

    def _taken(self, time: float, position: Array, sigma: Array) -> tuple[Event, ...]:
        """Takes in a sample; returns the events that become final."""
        last, scene = (self._bank, self._time), self._scene
        self._bank, log = explain(*last, time, position, sigma, self.count, scene.numbers, scene.rows)
        self._tips = self._followed(self._bank["tip"].tolist(), log)
        self._time = time
        self.count += 1
        return self._made_final()

    def _followed(self, tips: list[int], log: Records) -> list[Node | None]:
        """The last node of each hypothesis, by its `tip` in the log of a sample; equal events share a node."""
        old = self._tips
        if not len(log):
            return [old[-1 - tip] for tip in tips]
        made: dict[int, Node | None] = {NO_EVENT: None}
        before = log["before"].tolist()

        def node(tip: int) -> Node | None:
            if tip not in made:
                event = partial(_event, log, tip, self._scene)
                made[tip] = old[-1 - tip] if tip < 0 else Node(event, node(before[tip]))
            return made[tip]

        return [old[-1 - tip] if NO_EVENT < tip < 0 else node(tip) for tip in tips]

    def _made_final(self) -> tuple[Event, ...]:
        """Makes old events final, and drops the hypotheses that deny them."""
        cutoff = self.count - self._scene.settings.lag
        old = [node for node in open_nodes(self._tips[0]) if node.event.index < cutoff]
        if not old:
            return ()
        agreeing = [row for row, tip in enumerate(self._tips) if contains(tip, old[-1])]
        self._bank, self._tips = self._bank[agreeing], [self._tips[row] for row in agreeing]
        return make_final(old)


def _event(log: Records, row: int, scene: Scene) -> Event:
    """The event in a row of a log."""
    number, index, surface, _, time, offset = log[row].tolist()
    kind = EventKind(number)
    return Event(kind, index, time, scene.height(surface), np.array(offset) if kind is EventKind.SHIFT else None)


def _triple(name: str, value: ArrayLike) -> NDArray[np.float64]:
    array = np.ascontiguousarray(value, dtype=np.float64)
    if array.shape != (3,) or not all(map(math.isfinite, array.tolist())):
        raise ValueError(f"{name} must be three finite numbers in m; got {value!r}. Drop samples without a position.")
    return array
