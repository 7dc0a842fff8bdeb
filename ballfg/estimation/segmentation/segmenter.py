"""The forward pass: a multi-hypothesis (Viterbi) Kalman filter, one sample at a time, with bounded memory."""

import copy
import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation import branches
from ballfg.estimation.segmentation.bank import FLYING, Bank, concatenate
from ballfg.estimation.segmentation.events import Event, EventKind, Node, contains, copied, make_final, open_nodes
from ballfg.estimation.segmentation.evidence import prune, quiet_update, update
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.scene import Scene
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.estimation.segmentation.surface_contact import step


@dataclass(frozen=True)
class Decision:
    """What is believed after a sample.

    Attributes:
        final: events that became final with this sample, oldest first; each event is reported once.
        pending: the best explanation of what came after all final events, oldest first. It may change with the
            next sample.
    """

    final: tuple[Event, ...]
    pending: tuple[Event, ...]


class Segmenter:
    """Explains a stream of measured positions: contacts, hits, rests, tracker shifts, bad samples.

    Every hypothesis is one explanation of the past. A sample branches the hypotheses (at surfaces always; into hits
    and shifts when the best of them is surprised), weighs them, and drops the unlikely. Events `settings.lag` samples
    old become final: hypotheses that deny them are dropped, so that memory is bounded on an endless stream.

    Args:
        surfaces: table and floor.
        physics: of the ball; see `physics_of`.
        settings: noise model and prices.
    """

    def __init__(
        self,
        surfaces: Surfaces,
        physics: SegmentationPhysics | None = None,
        settings: SegmentationSettings | None = None,
    ) -> None:
        self._scene = Scene(physics or SegmentationPhysics(), surfaces, settings or SegmentationSettings())
        self._bank: Bank | None = None
        self._count = 0
        self._time = -math.inf

    def copy(self) -> "Segmenter":
        """A segmenter that has taken in the same samples; what either takes in from now on is its own."""
        other = copy.copy(self)
        if self._bank is not None:
            known: dict[int, Node] = {}
            other._bank = self._bank.take(list(range(len(self._bank))))
            other._bank.tips[:] = [copied(tip, known) for tip in self._bank.tips]
        return other

    @property
    def count(self) -> int:
        """Number of samples so far."""
        return self._count

    def push(self, time: float, position: ArrayLike, sigma: ArrayLike) -> Decision:
        """Takes in the next sample.

        Args:
            time: s, later than the last.
            position: (3,) m.
            sigma: (3,) m, standard deviation of each coordinate.
        Returns: the events that became final, and the best explanation of the rest.
        Raises: ValueError: if the time does not increase, or something is not finite or has a wrong shape.
        """
        point, noise = self._checked(time, position, sigma)
        noise = np.maximum(noise, self._scene.settings.sigma_floor)
        quiet, dt = None, time - self._time
        if self._bank is not None and dt <= self._scene.settings.longest_step:
            quiet = quiet_update(self._bank, point, noise, dt, self._scene)
        if quiet is not None:
            self._bank = quiet
        elif self._bank is None:
            self._bank = prune(branches.starts(None, 0.0, point, noise, self._scene, 0, time), self._scene)
        else:
            self._bank = prune(self._next(self._bank, point, noise, time), self._scene)
        self._time = time
        self._count += 1
        return self._decide()

    def _next(self, bank: Bank, position: Array, sigma: Array, time: float) -> Bank:
        """The hypotheses after the next sample, not pruned, from those before it, best first."""
        scene, sample, dt = self._scene, self._count, time - self._time
        settings = scene.settings
        if dt > settings.longest_gap:
            tip = Node(Event(EventKind.RESTART, sample - 1, time), bank.tips[0])
            return branches.starts(tip, float(bank.score[0]), position, sigma, scene, sample, time)
        predicted = self._predict(bank, dt)
        updated, surprise = update(predicted, position, sigma, scene, sample, time)
        extra = branches.departures(predicted, dt, scene, sample - 1, time)
        if surprise[updated.score.argmax()] > settings.surprise or bank.surface[0] != FLYING:
            best = bank.take([0])
            extra += branches.hits(best, position, dt, scene, sample - 1, time)
            extra += branches.shifts(predicted, position, sigma, dt, scene, sample - 1, time)
        if not extra:
            return updated
        others, _ = update(concatenate(extra), position, sigma, scene, sample, time)
        return concatenate([updated, others])

    def _predict(self, bank: Bank, dt: float) -> Bank:
        """All hypotheses at the next stamp, through the contacts that may have happened on the way."""
        settings = self._scene.settings
        steps = max(1, math.ceil(dt / settings.longest_step))
        for k in range(steps):
            start = self._time + k * dt / steps
            bank = step(bank, dt / steps, self._scene, self._count - 1, start, strict=steps > 1)
            if len(bank) > settings.most:
                bank = bank.take(np.argsort(-bank.score, kind="stable")[: settings.most])
        return bank

    def _decide(self) -> Decision:
        """Makes old events final, drops the hypotheses that deny them, and reports."""
        assert self._bank is not None
        pending = open_nodes(self._bank.tips[0])
        cutoff = self._count - self._scene.settings.lag
        old = [node for node in pending if node.event.index < cutoff]
        if not old:
            return Decision((), tuple(node.event for node in pending))
        agreeing = [row for row, tip in enumerate(self._bank.tips) if contains(tip, old[-1])]
        self._bank = self._bank.take(agreeing)
        return Decision(make_final(old), tuple(node.event for node in pending[len(old) :]))

    def _checked(self, time: float, position: ArrayLike, sigma: ArrayLike) -> tuple[Array, Array]:
        if not math.isfinite(time) or time <= self._time:
            raise ValueError(f"time must be finite and increase; got {time} s after {self._time} s. Sort the samples.")
        return _triple("position", position), _triple("sigma", sigma)


def _triple(name: str, value: ArrayLike) -> NDArray[np.float64]:
    array = np.ascontiguousarray(value, dtype=np.float64)
    if array.shape != (3,) or not all(map(math.isfinite, array.tolist())):
        raise ValueError(f"{name} must be three finite numbers in m; got {value!r}. Drop samples without a position.")
    return array
