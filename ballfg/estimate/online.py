"""The online estimator: iSAM2, one observation at a time, within a window of bounded length."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimate.estimator import Estimator
from ballfg.estimate.online_events import EventTracker, contact_step, first_difference
from ballfg.estimate.online_events import SIGMA_FACTOR
from ballfg.estimate.online_final import Frozen, collect, solve_window
from ballfg.estimate.online_interval import FLIGHT, Motion, motions_of
from ballfg.estimate.online_isam import Sample, Update
from ballfg.estimate.online_window import Window
from ballfg.estimate.problem import trackwise_model
from ballfg.estimate.result import Estimate, Status
from ballfg.estimate.segmentation import physics_of
from ballfg.estimate.settings import Settings, sample_sigmas
from ballfg.state import STATE_DIM
from ballfg.tracks import Track

Array = NDArray[np.float64]

LAG = 256
"""States in the window: more than any one flight of the measured data has, 1.4 s at 180 Hz."""
LATEST_CHANGE = 80
"""Samples. The segmenter's events are final after 64; nothing older is built again."""
YOUNG = 20
"""Samples after a contact in which the estimate may still move it to another interval."""


@dataclass(frozen=True)
class OnlineState:
    """What is known after an observation.

    Attributes:
        time: s.
        state: (9,) position m, velocity m/s, spin rad/s, of the ball at that time.
        covariance: (9, 9).
        coefficients: (p,) of the model, where they are estimated.
        innovation: (3,) the observation against its prediction, whitened; NaN where nothing predicted it.
        motion: how the ball got here from the last observation.
        revised: how many of the last samples were taken back and explained anew.
        evaluated: factors of the motion evaluated.  calls: torch calls for them.
        rebuilt: iSAM2 failed, and the window was built anew.
        status: OK, or what to try.
    """

    time: float
    state: Array
    covariance: Array
    coefficients: Array
    innovation: Array
    motion: Motion
    revised: int
    evaluated: int
    calls: int
    rebuilt: bool
    status: Status


class Online(Estimator):
    """Incremental smoothing: every observation updates the states of the whole window.

    Use `push` on a live stream, or `estimate` on a track, which ends by minimising over the window to a tight
    tolerance.

    Args:
        model: the ball.  surfaces: what it may bounce on.  settings: noise and priors.
        lag: states in the window; older ones are marginalised.

    Attributes:
        window: the samples, states and factors that are held; None before the first observation.
    """

    name = "online"

    def __init__(self, model: BallModel, surfaces: Surfaces, settings: Settings, lag: int = LAG) -> None:
        super().__init__(model, surfaces, settings)
        if lag < 2:
            raise ValueError(f"lag must be at least 2 states; got {lag}")
        self.trackwise = trackwise_model(model, settings)
        self.physics = physics_of(model)
        self.lag = lag
        self.reset()

    def reset(self) -> None:
        """Forget everything: the next observation begins a new stream."""
        self.window: Window | None = None
        self.events = EventTracker(self.surfaces, self.physics, self.settings.find_events)
        self._motions: list[Motion] = []
        self._factors = np.zeros(0)
        self._sigmas = np.zeros((0, 3))
        self._counts = np.zeros(2, dtype=np.int64)

    def push(self, time: float, position: ArrayLike, sigma: ArrayLike | None = None) -> OnlineState:
        """Take in an observation.

        Args:
            time: s, later than the last.
            position: (3,) m.
            sigma: (3,) m, its standard deviation; the settings' where None.
        Returns: the newest state. It is valid for good; the window's own arrays move on.
        Raises: ValueError: if the time does not increase, or a number is not finite.
        """
        return self._push(float(time), position, sigma, None)

    def _push(self, time: float, position: ArrayLike, sigma: ArrayLike | None, label: Array | None) -> OnlineState:
        own = None if sigma is None else np.asarray(sigma, dtype=np.float64)[None]
        spread = sample_sigmas(self.settings, 1, own)[0]
        point = np.asarray(position, dtype=np.float64)
        changed = self.events.push(time, point, spread)  # also checks the numbers
        if self.window is None:
            self.window = Window(self.trackwise, self.settings, float(spread.min()))
        self._counts[:] = 0
        sample = Sample(time, point, spread, label)
        try:
            revised, update, rebuilt = *self._take_in(self.window, sample, spread, changed), False
        except (RuntimeError, ValueError) as error:
            revised, update, rebuilt = len(self.window), self._repair(self.window, sample, error), True
        return self._state(self.window, sample, update, revised, rebuilt)

    def _take_in(self, window: Window, sample: Sample, spread: Array, changed: bool) -> tuple[int, Update]:
        """Explain, take back what is explained otherwise now, append, move contacts, keep the window's length."""
        self._sigmas = np.concatenate((self._sigmas, spread[None]))
        motion, factor, again = FLIGHT, 1.0, []
        if changed:
            motions, factors = self._explained(window, sample)
            again = self._take_back(window, motions, factors)
            motion, factor = (motions[-1] if motions else FLIGHT), float(factors[-1])
        for old in again:
            self._append(window, old, self._motions[len(window) - 1] if len(window) else FLIGHT)
        self._motions += [motion] if len(window) else []
        self._factors = np.append(self._factors, factor)
        sample.sigma = spread * factor
        update = self._append(window, sample, motion)
        self._move_contacts(window)
        self._shorten(window)
        return len(again), update

    def _append(self, window: Window, sample: Sample, motion: Motion) -> Update:
        update = window.append(sample, motion)
        self._counts += update.evaluated, update.calls
        return update

    def _explained(self, window: Window, sample: Sample) -> tuple[list[Motion], Array]:
        """The motions and noise factors that the events amount to, the new sample's last."""
        times = np.append(window.times, sample.time)
        positions = np.array([*(s.position for s in window.samples), sample.position])
        segmentation = self.events.segmentation(window.first, times, positions)
        motions = motions_of(self.events.moved(segmentation, window.first), times)
        factors = SIGMA_FACTOR[segmentation.quality]
        settled = max(len(window) - LATEST_CHANGE, 0)
        motions[:settled], factors[:settled] = self._motions[:settled], self._factors[:settled]
        return motions, factors

    def _take_back(self, window: Window, motions: list[Motion], factors: Array) -> list[Sample]:
        """Go back to before the first sample that is explained otherwise; give others their new noise."""
        n = len(window)
        start = first_difference(self._motions, self._factors, motions, factors)
        again = [] if start is None else window.retract(start)
        changed = np.flatnonzero(self._factors != factors[:n])
        for k in changed.tolist():
            if k < len(window):
                window.replace_sigma(k, self._sigmas[k] * factors[k])
            else:
                again[k - len(window)].sigma = self._sigmas[k] * factors[k]
        self._motions, self._factors = motions[: max(n - 1, 0)], factors[:n]
        return again

    def _move_contacts(self, window: Window) -> None:
        """Put young contacts where the estimate says they are; the newest one may not have happened yet."""
        for k in range(max(len(window) - 1 - YOUNG, 0), len(window) - 1):
            motion = self._motions[k]
            if len(motion.heights) != 1 or motion.hit:
                continue
            (height,) = motion.heights
            dt = window.samples[k + 1].time - window.samples[k].time
            step = contact_step(window.theta[k] + window.delta[k], self.events.rise(height), dt)
            other = k + step
            free = 0 <= other < len(self._motions) and self._motions[other] == FLIGHT
            if step == 0 or not free or not self.events.move(window.first + k, height, step):
                continue
            shift = window.samples[k].time - window.samples[other].time
            there = Motion(motion.heights, (motion.times[0] + shift,))
            window.replace_motion(k, FLIGHT)
            window.replace_motion(other, there)
            self._motions[k], self._motions[other] = FLIGHT, there

    def _shorten(self, window: Window) -> None:
        while len(window) > self.lag:
            window.drop_oldest()
            self._motions, self._factors, self._sigmas = self._motions[1:], self._factors[1:], self._sigmas[1:]

    def _repair(self, window: Window, sample: Sample, error: Exception) -> Update:
        """Build the window anew from its samples; if that fails as well, from the newest one."""
        keep = len(window.samples)
        if not any(s is sample for s in window.samples):
            window.samples.append(sample)
            keep += 1
        raise NotImplementedError from error

    def _state(self, window: Window, sample: Sample, update: Update, revised: int, rebuilt: bool) -> OnlineState:
        return OnlineState(
            time=sample.time,
            state=window.theta[-1] + window.delta[-1],
            covariance=window.newest_covariance[:STATE_DIM, :STATE_DIM].copy(),
            coefficients=window.coefficients,
            innovation=update.innovation,
            motion=self._motions[-1] if self._motions else FLIGHT,
            revised=revised,
            evaluated=int(self._counts[0]),
            calls=int(self._counts[1]),
            rebuilt=rebuilt,
            status=Status.OK if len(window) > 1 else Status.NO_VELOCITY,
        )
