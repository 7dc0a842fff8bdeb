"""A window in iSAM2 retracts samples, replaces factors, drops its oldest states and restarts."""

import copy
from collections.abc import Sequence
from typing import Self

import gtsam

from ballfg.arrays import Array
from ballfg.estimation.online.linear_factors import bias_start
from ballfg.estimation.online.measurement import Measurement, prepare
from ballfg.estimation.online.sample import Sample, Update
from ballfg.estimation.online.windows.isam import IsamCore
from ballfg.estimation.online.windows.linear import LinearFactors
from ballfg.factors.batch import FactorBatch
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY


class IsamWindow(IsamCore):
    """The window in iSAM2: arguments and attributes as those of `IsamCore`."""

    def copy(self, samples: Sequence[Sample]) -> Self:
        """An independent window with the same states and factors.

        iSAM2 is copied with its cliques. The factors are shared: their bridges answer for any state, from stored
        results or by a new evaluation.
        """
        other = copy.copy(self)
        other.isam = gtsam.ISAM2(self.isam)
        other.samples = list(samples)
        other.intervals = [copy.copy(interval) for interval in self.intervals]
        other.shared = list(self.shared)
        other.coefficient_delta = self.coefficient_delta.copy()  # GTSAM's own memory, which its next update overwrites
        return other

    def retract(self, count: int) -> None:
        """Removes the newest samples, with their states and factors, from iSAM2 as well."""
        gone = self.samples[count:]
        slots = [slot for sample in gone for slot in sample.slots]
        slots += [i.slot for i in self.intervals[count - 1 :] if i is not None and i.slot is not None]
        slots += [sample.bias_slot for sample in gone if sample.bias_slot is not None]
        self._relinearize(None)
        del self.samples[count:], self.intervals[count - 1 :]
        self._update(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots, {})
        self.theta = self.theta[:count]
        self._read_back()

    def attach(self, measurement: Measurement) -> Update:
        """Adds one more measurement of the newest sample, which holds it already."""
        _, count, calls = self._relinearize(None)
        measurement.corrected(self.points[-1], self.newest_covariance[: self.width, : self.width])
        prepare([measurement], self.theta[-1:])
        newest = STATE_KEY + self.first + len(self.samples) - 1
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(measurement.factor(newest - STATE_KEY))
        last = {newest: 1, COEFFICIENT_KEY: 2} if self.p and len(self.theta) > 1 else {}
        slots = self._update(graph, gtsam.Values(), [], last)
        sample = self.samples[-1]
        sample.slots = (*sample.slots, *slots)
        self._read_back()
        return Update(measurement.innovation, count, calls, int(self._result.getVariablesReeliminated()))

    def reweigh(self, numbers: list[int]) -> None:
        """Replaces the position factors of some samples of the window, whose noise has changed."""
        self._relinearize(None)
        graph, old = gtsam.NonlinearFactorGraph(), []
        for k in numbers:
            graph.push_back(self._position_factor(self.samples[k], self.first + k))
            old.append(self.samples[k].slots[0])
        slots = self._update(graph, gtsam.Values(), old, {})
        for k, slot in zip(numbers, slots, strict=True):
            self.samples[k].slots = (slot, *self.samples[k].slots[1:])
        self._read_back()

    def shorten(self, keep: int) -> None:
        """Drops all but the newest states; a linear factor on the first that stays keeps their information.

        The factors of the removed states are eliminated, by QR, at their linearisation points; iSAM2 is then rebuilt
        from the others, whose linearisations are all at hand: no torch call. If only a bias links the first of these to
        the removed ones, after a long gap, the bias restarts.

        Raises: RuntimeError: from GTSAM, when the removed part is singular.
        """
        leaving = len(self.samples) - keep
        self._relinearize(None)
        before = self.first, self.samples, self.intervals, self.theta, self.delta, self.shared
        linked = self.intervals[leaving - 1] is not None
        try:
            self.shared = self._summary(leaving)
            self.first += leaving
            self.samples, self.intervals = self.samples[leaving:], self.intervals[leaving:]
            self.theta, self.delta = self.theta[leaving:], self.delta[leaving:]
            self._renew(linked)
        except RuntimeError:
            self.first, self.samples, self.intervals, self.theta, self.delta, self.shared = before
            raise

    def joint_covariances(self, count: int) -> list[Array]:
        """(w + p, w + p) of each of the oldest states, with its bias and the coefficients."""
        shared, first = [COEFFICIENT_KEY] * (self.p > 0), STATE_KEY + self.first
        return [self.isam.jointMarginalCovariance([first + k, *shared]).fullMatrix() for k in range(count)]

    def summaries(self) -> list[FactorBatch]:
        """The linear factors from removed states, about the present estimate."""
        values = self.values if self.first else None
        return [] if values is None else [LinearFactors.of_gtsam(f, values, self.first) for f in self.shared]

    def _summary(self, leaving: int) -> list[gtsam.NonlinearFactor]:
        """The information of the oldest states, as linear factors on the first that stays and on the coefficients."""
        point = self._point(range(leaving + 1))
        old = gtsam.GaussianFactorGraph()
        cut = leaving - (self.intervals[leaving - 1] is None)
        factors = self._factors(range(leaving), range(leaving), range(1, cut + 1))
        for factor in (*factors, *self.shared):
            old.push_back(factor.linearize(point))
        ordering = gtsam.Ordering()
        present = set(old.keyVector())
        for key in (*range(STATE_KEY + self.first, STATE_KEY + self.first + leaving + 1), COEFFICIENT_KEY):
            if key in present:
                ordering.push_back(key)
        bayes_net = old.eliminateSequential(ordering, gtsam.EliminateQR)
        conditionals = [bayes_net.at(i) for i in range(bayes_net.size())]  # by branches of the forest, not in order
        gone = range(STATE_KEY + self.first, STATE_KEY + self.first + leaving)
        rest = [_jacobian_factor(c) for c in conditionals if list(c.keys())[0] not in gone]  # noqa: RUF015
        return [gtsam.LinearContainerFactor(factor, point) for factor in rest]

    def _point(self, numbers: range) -> gtsam.Values:
        """The linearisation points of some states of the window and of the coefficients."""
        values = gtsam.Values()
        for k in numbers:
            values.insert(STATE_KEY + self.first + k, self.theta[k])
        if self.p:
            values.insert(COEFFICIENT_KEY, self.coefficient_theta)
        return values

    def _factors(self, samples: range, intervals: range, biases: range) -> list[gtsam.NonlinearFactor]:
        """Slots in iSAM2 of factors: of some samples, of some intervals, and of those to the biases of some samples."""
        held = self.isam.getFactorsUnsafe()
        slots = [slot for k in samples for slot in self.samples[k].slots]
        slots += [i.slot for k in intervals if (i := self.intervals[k]) is not None and i.slot is not None]
        slots += [slot for k in biases if (slot := self.samples[k].bias_slot) is not None]
        return [held.at(slot) for slot in slots]

    def _renew(self, linked: bool) -> None:
        """A new iSAM2 from the present window; its first state may have no link to the removed ones."""
        n = len(self.samples)
        graph = gtsam.NonlinearFactorGraph()
        for factor in self._factors(range(n), range(n - 1), range(1, n)):
            graph.push_back(factor)
        self.samples[0].bias_slot = None
        if self.biased and not linked:
            graph.push_back(bias_start(STATE_KEY + self.first, self.settings))
        for factor in self.shared:
            graph.push_back(factor)
        self.isam = self._new_isam()
        last = {STATE_KEY + self.first + n - 1: 1, COEFFICIENT_KEY: 2} if self.p else {}
        slots = iter(self._update(graph, self._point(range(n)), [], last))
        for sample in self.samples:
            sample.slots = tuple(next(slots) for _ in sample.slots)
        for interval in self.intervals:
            if interval is not None:
                interval.slot = next(slots)
        for sample in self.samples[1:]:
            if sample.bias_slot is not None:
                sample.bias_slot = next(slots)
        if self.biased and not linked:
            self.samples[0].slots += (next(slots),)
        self._read_back()


def _jacobian_factor(conditional: gtsam.GaussianConditional) -> gtsam.JacobianFactor:
    """A conditional R x + S y = d as a factor."""
    keys, unit = list(conditional.keys()), gtsam.noiseModel.Unit.Create(len(conditional.d()))
    if len(keys) == 1:
        return gtsam.JacobianFactor(keys[0], conditional.R(), conditional.d(), unit)
    first, second = keys
    return gtsam.JacobianFactor(first, conditional.R(), second, conditional.S(), conditional.d(), unit)
