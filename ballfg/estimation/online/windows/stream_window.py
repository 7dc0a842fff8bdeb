"""A stream window predicts, evaluates and holds the last samples of a stream as a factor graph.

The window keeps linearisation points and the linear solution about them. Before an update it moves the states that have
left the thresholds, and evaluates their factors, together with the new one, in one call of the model. Other classes
keep and solve the linear system: iSAM2 (`window.py`) or a chain of triangles (`chain.py`).
docs/derivations/online.md explains the choices.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics.compiled.kept_model import carried
from ballfg.estimation.online.state import Measurement, Sample, prepare
from ballfg.estimation.online.windows.interval import Interval, IntervalMaker, evaluate, store
from ballfg.estimation.online.windows.window_filter import WindowFilter
from ballfg.estimation.settings import Settings, stamp_covariance
from ballfg.estimation.smoother.problem import coefficient_means, rolling_priors, start_priors
from ballfg.factors.batch import FactorBatch, Values
from ballfg.factors.correlated_noise import BIAS_DIM, BiasedPositionFactors
from ballfg.factors.dynamics import model_width
from ballfg.factors.position import PositionFactors
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel


@dataclass(frozen=True)
class Arrival:
    """A new sample, its linearisation point (w,), the linked interval before it, if any, and its own priors."""

    sample: Sample
    state: Array
    interval: Interval | None = None
    priors: Sequence[FactorBatch] = ()


VELOCITY_THRESHOLD = 0.3
"""m/s. A third of it costs twice the evaluations and changes nothing (docs/derivations/online.md)."""
SPIN_THRESHOLD = 40.0
"""rad/s. The Magnus force is linear in the spin: only its product with a velocity error matters."""
POSITION_THRESHOLD = 0.5
"""Measurement standard deviations. Flight does not depend on the position; a robust loss's weight does."""
COEFFICIENT_THRESHOLD = 0.5
"""Prior standard deviations. The coefficients enter every factor: a change relinearises the whole window."""


class StreamWindow(ABC):
    """The last samples of a stream as a factor graph.

    Args:
        model: the ball, from `problem.trackwise_model`.  settings: noise and priors.
        position_sigma: m, of a good measurement; scales the threshold of relinearisation in position.
        biased: True if the tracker's bias, a vector of three, follows each state.
        reach: number of the newest states that an update may linearise anew; None: all.

    Attributes:
        first: number of the window's first state since the stream began.
        samples: n of them.  intervals: n - 1, None without a link between two samples.
        theta: (n, w) linearisation points of states and biases, w = 9 or 12.  delta: (n, w) solution about them.
        coefficient_theta, coefficient_delta: (p,) the same for the coefficients.
        newest_covariance: (w + p, w + p) of the newest state with its bias and the coefficients.
    """

    def __init__(
        self,
        model: BallModel,
        settings: Settings,
        position_sigma: float,
        biased: bool = False,
        reach: int | None = None,
    ) -> None:
        self.model = model
        self.settings = settings
        self.position_sigma = position_sigma
        self.biased = biased
        self.reach = reach
        self.width = STATE_DIM + BIAS_DIM * biased
        self.maker = IntervalMaker(model, settings.process)
        self.p = model_width(model)
        self._filter = WindowFilter(settings, self.width)
        self._order = np.r_[:STATE_DIM, self.width : self.width + self.p, STATE_DIM : self.width]
        self._own_means = coefficient_means(carried(model)[0], settings)
        self._own_sigmas = np.array(list(settings.coefficients.values()))
        self.first = 0
        self.threshold = np.full(self.width, POSITION_THRESHOLD * position_sigma)
        self.threshold[VELOCITY], self.threshold[SPIN] = VELOCITY_THRESHOLD, SPIN_THRESHOLD
        self._clear()

    def __len__(self) -> int:
        return len(self.samples)

    @abstractmethod
    def copy(self, samples: Sequence[Sample]) -> Self:
        """An independent window with the same states and factors, and copies of its samples."""

    @abstractmethod
    def retract(self, count: int) -> None:
        """Removes the newest samples but `count` of them, at least one, with their states and factors."""

    @abstractmethod
    def attach(self, measurement: Measurement) -> Array:
        """Adds one more measurement of the newest sample, which holds it already.

        Returns and raises: as `append_all`.
        """

    @abstractmethod
    def reweigh(self, numbers: list[int]) -> None:
        """Replaces the position factors of some samples of the window, whose noise has changed."""

    @abstractmethod
    def shorten(self, keep: int) -> None:
        """Drops all but the newest states; a linear factor on the first that stays keeps their information.

        Raises: RuntimeError: when the leaving part is singular.
        """

    @abstractmethod
    def summaries(self) -> list[FactorBatch]:
        """The information of removed states on the first state and the coefficients, numbered as in the window."""

    @abstractmethod
    def _insert(self, arrivals: Sequence[Arrival]) -> None:
        """Takes in new states with their factors, one after another, and solves."""

    @abstractmethod
    def _first_is_known(self) -> bool:
        """True if removed states left information on the window's first state."""

    def _clear(self) -> None:
        """No samples and no states."""
        self.samples: list[Sample] = []
        self.intervals: list[Interval | None] = []
        self.theta, self.delta = np.zeros((0, self.width)), np.zeros((0, self.width))
        self.coefficient_theta, self.coefficient_delta = self._own_means.copy(), np.zeros(self.p)
        self.newest_covariance = np.zeros((0, 0))

    def start_anew(self, samples: list[Sample]) -> Array:
        """Drops a half-updated solution and takes in all samples again; innovation and errors as of `append_all`."""
        start, coefficients = self.points[:1], self.coefficients
        self._clear()
        for sample in samples:
            sample.slots, sample.bias_slot = (), None
        innovation = np.full(3, np.nan)
        if self.first:
            self.coefficient_theta = coefficients
        if self._first_is_known():
            self._insert([Arrival(samples[0], start[0])])
            samples = samples[1:]
        for sample in samples:
            innovation = self.append_all([sample])
        return innovation

    @property
    def points(self) -> Array:
        """(n, w) the present estimate of states and biases."""
        return self.theta + self.delta

    @property
    def states(self) -> Array:
        """(n, 9) the present estimate."""
        return self.points[:, :STATE_DIM]

    @property
    def values(self) -> Values:
        """The present estimate of all variables."""
        return Values(self.states, self.coefficients, self.points[:, STATE_DIM:] if self.biased else None)

    @property
    def newest_belief(self) -> tuple[Array, Array]:
        """Mean (9 + p,) and covariance (9 + p, 9 + p) of the newest state and the coefficients, without the bias."""
        (mean, covariance), own = self.newest_in_order, STATE_DIM + self.p
        return mean[:own], np.ascontiguousarray(covariance[:own, :own])

    @property
    def newest_in_order(self) -> tuple[Array, Array]:
        """Mean (w + p,) and covariance of the newest state, the coefficients and the bias, in this order."""
        mean = np.concatenate((self.theta[-1] + self.delta[-1], self.coefficients))
        return mean[self._order], self.newest_covariance[self._order[:, None], self._order]

    @property
    def coefficients(self) -> Array:
        """(p,) the present estimate."""
        return self.coefficient_theta + self.coefficient_delta

    def append_all(self, samples: Sequence[Sample]) -> Array:
        """Takes in several samples and solves once: those that were retracted when an event changed.

        An extended Kalman filter over them gives their linearisation points. If these are too far from the solution,
        the next sample moves them.

        Returns: (dim,) whitened innovation of the last one's position, or of its substitute; NaN without a prediction.
        Raises: RuntimeError or ValueError: from GTSAM or the model; the window must then be rebuilt.
        """
        innovation, begin = np.full(3, np.nan), 0
        while begin < len(samples):
            end = begin + 1
            if samples[begin].motion.linked and self.samples:
                while end < len(samples) and samples[end].motion.linked:
                    end += 1
                innovation = self._append_linked(samples[begin:end])
            else:
                innovation = self._append_start(samples[begin])
            begin = end
        return innovation

    def _append_linked(self, samples: Sequence[Sample]) -> Array:
        """Takes in samples that are linked to the newest one and to each other."""
        mean, covariance = np.concatenate((self.theta[-1] + self.delta[-1], self.coefficients)), self.newest_covariance
        points, intervals, pieces = list[Array](), list[Interval](), list[Array]()
        for before, sample in pairwise((self.samples[-1], *samples)):
            number = self.first + len(self.samples) + len(intervals)
            interval = self.maker.make(number - 1, sample.motion, sample.time - before.time)
            if not points:
                piece = self._relinearize(interval)
                points.append(self.theta[-1])
            else:
                start, end = points[-1][None], np.empty((0, self.width))
                (piece,) = evaluate([interval], start, end, self.coefficient_theta)
            mean, covariance, innovation = self._filter.step(
                piece, points[-1], mean, self.coefficient_theta, covariance, interval, sample
            )
            points.append(mean[: self.width])
            intervals.append(interval)
            pieces.append(piece)
        states = np.array(points)
        store(intervals, states[:-1], states[1:], self.coefficient_theta, np.array(pieces))
        self._insert([Arrival(*a) for a in zip(samples, states[1:], intervals, strict=True)])
        return innovation

    def _append_start(self, sample: Sample) -> Array:
        """Takes in a sample without a prediction: its state has a wide prior of its own."""
        state = np.zeros(self.width)
        state[POSITION] = sample.position
        if sample.label is not None:
            state[SPIN] = sample.label.spin
        if sample.rolls:
            priors = rolling_priors(0, sample.position, self.model.radius, self.settings)
        else:
            priors = start_priors(0, sample.position, sample.label, self.settings)
        self._relinearize(None)
        self._insert([Arrival(sample, state, None, priors)])
        return np.full(3, np.nan)

    @property
    def _settled(self) -> int:
        """Number of the oldest states whose points stay: those out of reach, and one that removed states tell of."""
        out_of_reach = 0 if self.reach is None else max(len(self.theta) - self.reach, 0)
        return max(out_of_reach, int(self.first > 0 and self._first_is_known()))

    def _relinearize(self, new: Interval | None) -> Array:
        """Moves states whose solution left the thresholds, and evaluates their factors, ahead of iSAM2.

        What is known from removed states is linear about the points of the coefficients and of the first state, which
        stay from then on.

        Returns: the new interval's propagation (9, 1 + 9 + p).
        """
        moved = np.asarray((np.abs(self.delta) > self.threshold).any(axis=1), dtype=bool)
        limit = COEFFICIENT_THRESHOLD * self._own_sigmas
        moved[: self._settled] = False
        shared = not self.first and not self._settled and bool((np.abs(self.coefficient_delta) > limit).any())
        touched, begins = list[Interval](), list[int]()
        if moved.any():
            self.theta = np.where(moved[:, None], self.theta + self.delta, self.theta)
            self.delta = np.where(moved[:, None], 0.0, self.delta)
            seen = [(measurement, k) for k in np.flatnonzero(moved) for measurement in self.samples[k].measurements]
            prepare([measurement for measurement, _ in seen], self.theta[[k for _, k in seen]])
        if shared:
            self.coefficient_theta = self.coefficient_theta + self.coefficient_delta
            self.coefficient_delta = np.zeros(self.p)
        if shared or moved.any():
            either = np.flatnonzero(moved[:-1] | moved[1:] | shared)
            touched = [interval for k in either if (interval := self.intervals[k]) is not None]
            begins = [interval.index - self.first for interval in touched]
        ends = [k + 1 for k in begins]
        if new is not None:
            touched.append(new)
            begins.append(len(self.theta) - 1)  # this call computes its end: `store` completes it
        if not touched:
            return np.empty(0)
        return evaluate(touched, self.theta[begins], self.theta[ends], self.coefficient_theta)[-1]

    def _position_batch(self, sample: Sample, state: int) -> FactorBatch:
        """The factor of a measured position."""
        where, position, loss = np.array([state]), sample.position[None], self.settings.loss
        if self.biased or self.settings.stamp_jitter > 0.0:
            stamps = stamp_covariance(self.settings, sample.velocity)[None]
            return BiasedPositionFactors(where, position, sample.sigma[None], stamps, loss, self.biased)
        return PositionFactors(where, position, sample.sigma[None], loss)
