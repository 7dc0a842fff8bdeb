"""Holds a window in iSAM2: inserts and retracts samples, replaces factors, drops its oldest states.

The window evaluates factors ahead in batches; when GTSAM asks for one, its callback returns the stored result.
"""

import copy
from collections.abc import Sequence
from typing import Self

import gtsam
import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import Measurement, Sample, prepare
from ballfg.estimation.online.windows.isam import (
    bias_link,
    bias_start,
    key_list,
    linear_factor,
    linearized,
    parameters,
    summary_of,
)
from ballfg.estimation.online.windows.stream_window import COEFFICIENT_THRESHOLD, Arrival, StreamWindow
from ballfg.factors.batch import FactorBatch
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY, Bridge
from ballfg.factors.prior import coefficient_prior


class IsamWindow(StreamWindow):
    """A window with its linear system in iSAM2: arguments and attributes as those of `StreamWindow`.

    Attributes:
        isam: of GTSAM.
        shared: factors without a sample, by their slots in iSAM2: the prior of the coefficients and the linear factors
            of the removed states.
    """

    def _clear(self) -> None:
        """An empty iSAM2 and no states."""
        super()._clear()
        self.isam = gtsam.ISAM2(parameters(self.threshold, COEFFICIENT_THRESHOLD * self._own_sigmas))
        if not self.first:
            prior = Bridge(coefficient_prior(self._own_means, self._own_sigmas), "row") if self.p else None
            self.shared: dict[int, gtsam.NonlinearFactor] = {} if prior is None else {0: prior.factor(0)}

    def _first_is_known(self) -> bool:
        return any(STATE_KEY + self.first in list(factor.keys()) for factor in self.shared.values())

    def _insert(self, arrivals: Sequence[Arrival]) -> None:
        """Adds new states with their factors to iSAM2, and reads back the solution."""
        graph, values, ends = gtsam.NonlinearFactorGraph(), gtsam.Values(), []
        last = {STATE_KEY + self.first + len(self.samples) + len(arrivals) - 1: 1, COEFFICIENT_KEY: 2}
        older = len(self.samples) > 0
        for arrival in arrivals:
            sample, key = arrival.sample, STATE_KEY + self.first + len(self.samples)
            for factor in self._factors_of(arrival, key):
                graph.push_back(factor)
            ends.append(graph.size())
            if self.biased and self.samples:
                graph.push_back(bias_link(key, sample.time - self.samples[-1].time, self.settings))
            values.insert(key, arrival.state)
            if self.samples:
                self.intervals.append(arrival.interval)
            self.samples.append(sample)
        if not older:
            for factor in self.shared.values():
                graph.push_back(factor)
            if self.p:
                values.insert(COEFFICIENT_KEY, self.coefficient_theta)
        slots = self._update(graph, values, [], last if self.p and older else {}, self._fixed_keys())
        if not older:
            self.shared = dict(zip(slots[len(slots) - len(self.shared) :], self.shared.values(), strict=True))
        begin = 0
        for arrival, end in zip(arrivals, ends, strict=True):
            linked = self.biased and (older or begin > 0)
            if arrival.interval is not None:
                arrival.interval.slot = slots[begin]
            arrival.sample.slots = tuple(slots[begin + (arrival.interval is not None) : end])
            arrival.sample.bias_slot = slots[end] if linked else None
            begin = end + linked
        self.theta = np.concatenate((self.theta, np.array([arrival.state for arrival in arrivals])))
        self._read_back()

    def _factors_of(self, arrival: Arrival, key: int) -> list[gtsam.NonlinearFactor]:
        """The factors of a new state: that of its interval first, then its own."""
        factors: list[gtsam.NonlinearFactor] = []
        if arrival.interval is not None:
            factors.append(arrival.interval.bridge.factor(0))
        measurements = arrival.sample.measurements
        prepare(measurements, np.tile(arrival.state, (len(measurements), 1)))
        factors += [self._position_factor(arrival.sample, key - STATE_KEY)] if arrival.sample.measured else []
        factors += [measurement.factor(key - STATE_KEY) for measurement in measurements]
        factors += [Bridge(prior, "row").factor(0, [key - STATE_KEY]) for prior in arrival.priors]
        if self.biased and arrival.priors and not self.samples:
            factors.append(bias_start(key, self.settings))
        return factors

    def _position_factor(self, sample: Sample, state: int) -> gtsam.NonlinearFactor:
        """The observation's factor; linear without a robust loss."""
        batch = self._position_batch(sample, state)
        if batch.loss.name != "squared":
            return Bridge(batch, "row").factor(0)
        (residual,), (block,) = batch.compute(slice(None), (np.zeros((1, self.width)),))
        return linear_factor([STATE_KEY + state], [block[0]], -residual)

    def _update(
        self,
        graph: gtsam.NonlinearFactorGraph,
        values: gtsam.Values,
        remove: list[int],
        last: dict[int, int],
        held: Sequence[int] = (),
        anew: Sequence[int] = (),
    ) -> list[int]:
        """One iSAM2 update; keys in `last` are eliminated after all others, by group; empty: GTSAM's order.

        The linearisation points of the keys in `held` stay, whatever the thresholds say; those in `anew` are eliminated
        again, moved or not.

        By itself GTSAM eliminates the newest states last, but not the coefficients: every state would then depend on
        them from below, and no update would be local.
        """
        how = gtsam.ISAM2UpdateParams()
        how.removeFactorIndices = remove
        if last:
            groups = gtsam.KeyGroupMap()
            for key, group in last.items():
                groups.insert2(key, group)
            how.constrainedKeys = groups
        if held:
            how.noRelinKeys = key_list(held)
        if anew:
            how.extraReelimKeys = key_list(anew)
        return list(self.isam.update(graph, values, how).getNewFactorsIndices())

    def _fixed_keys(self) -> list[int]:
        """GTSAM's keys of the variables whose points stay, whatever the thresholds say."""
        first, settled = STATE_KEY + self.first, self._settled
        shared = self.p > 0 and (self.first > 0 or settled > 0)
        return [*range(first, first + settled), *[COEFFICIENT_KEY] * shared]

    def _keys(self) -> list[int]:
        """GTSAM's keys of all variables."""
        first = STATE_KEY + self.first
        return [*range(first, first + len(self.theta)), *[COEFFICIENT_KEY] * (self.p > 0)]

    def _read_back(self) -> None:
        """The linear solution of all states, and the newest one's covariance."""
        newest = STATE_KEY + self.first + len(self.theta) - 1
        solution = self.isam.getDelta()
        self.delta = solution.vector(range(STATE_KEY + self.first, newest + 1)).reshape(-1, self.width)
        if self.p:
            self.coefficient_delta = solution.at(COEFFICIENT_KEY)
            self.newest_covariance = self.isam.jointMarginalCovariance([newest, COEFFICIENT_KEY]).fullMatrix()
        else:
            self.newest_covariance = self.isam.marginalCovariance(newest)

    def copy(self, samples: Sequence[Sample]) -> Self:
        """An independent window with the same states and factors.

        iSAM2 is copied with its cliques. The factors are shared: their bridges answer for any state, from stored
        results or by a new evaluation.
        """
        other = copy.copy(self)
        other.isam = gtsam.ISAM2(self.isam)
        other.samples = list(samples)
        other.intervals = [copy.copy(interval) for interval in self.intervals]
        other.shared = dict(self.shared)
        other.coefficient_delta = self.coefficient_delta.copy()  # GTSAM's own memory, which its next update overwrites
        return other

    def retract(self, count: int) -> None:
        """Removes the newest samples, with their states and factors, from iSAM2 as well."""
        gone, n = range(count, len(self.samples)), len(self.samples)
        slots = self._slots(gone, range(count - 1, n - 1), gone)
        del self.samples[count:], self.intervals[count - 1 :]
        self.theta = self.theta[:count]
        self._update(gtsam.NonlinearFactorGraph(), gtsam.Values(), slots, {}, self._keys())
        self._read_back()

    def attach(self, measurement: Measurement) -> Array:
        """Adds one more measurement of the newest sample, which holds it already."""
        self._relinearize(None)
        measurement.corrected(self.points[-1], self.newest_covariance[: self.width, : self.width])
        prepare([measurement], self.theta[-1:])
        newest = STATE_KEY + self.first + len(self.samples) - 1
        graph = gtsam.NonlinearFactorGraph()
        graph.push_back(measurement.factor(newest - STATE_KEY))
        last = {newest: 1, COEFFICIENT_KEY: 2} if self.p and len(self.theta) > 1 else {}
        slots = self._update(graph, gtsam.Values(), [], last, self._fixed_keys())
        sample = self.samples[-1]
        sample.slots = (*sample.slots, *slots)
        self._read_back()
        return measurement.innovation

    def reweigh(self, numbers: list[int]) -> None:
        """Replaces the position factors of some samples of the window, whose noise has changed."""
        graph, old = gtsam.NonlinearFactorGraph(), []
        for k in numbers:
            graph.push_back(self._position_factor(self.samples[k], self.first + k))
            old.append(self.samples[k].slots[0])
        slots = self._update(graph, gtsam.Values(), old, {}, self._keys())
        for k, slot in zip(numbers, slots, strict=True):
            self.samples[k].slots = (slot, *self.samples[k].slots[1:])
        self._read_back()

    def shorten(self, keep: int) -> None:
        """Drops all but the newest states; linear factors on the first that stays keep their information.

        GTSAM takes the leaves off its tree: nothing is evaluated or eliminated again. If only a bias links the first
        state that stays to the removed ones, after a long gap, the bias restarts.

        Raises: RuntimeError: from GTSAM, when the removed part is singular.
        """
        leaving = len(self.samples) - keep
        if self.biased and self.intervals[leaving - 1] is None:
            self._restart_bias(leaving)
        made, removed = self._take_off(leaving)
        point, held = self._point(leaving + 1), self.isam.getFactorsUnsafe()
        self.shared = {slot: factor for slot, factor in self.shared.items() if slot not in removed}
        self.shared |= {slot: linear_factor(*linearized(held.at(slot), point), point) for slot in made}
        self.first += leaving
        self.samples, self.intervals = self.samples[leaving:], self.intervals[leaving:]
        self.theta, self.delta = self.theta[leaving:], self.delta[leaving:]
        self.samples[0].bias_slot = None
        self._merge_shared()

    def _take_off(self, leaving: int) -> tuple[list[int], set[int]]:
        """Removes the oldest states from iSAM2; slots of the linear factors in their place, and of all removed ones.

        Raises: RuntimeError: from GTSAM, when the removed part is singular.
        """
        keys, n, whole = self._keys(), len(self.samples), gtsam.ISAM2(self.isam)
        leaves = key_list(keys[:leaving])
        staying = self._slots(range(leaving, n), range(leaving, n - 1), range(leaving + 1, n))
        try:
            made, removed = self.isam.marginalizeLeavesWithIndices(leaves)
            below = not set(removed).isdisjoint(staying)
        except (RuntimeError, ValueError):
            below = True
        if below:  # states that stay were eliminated before leaving ones, and GTSAM dropped them as well
            self.isam = whole
            last = {key: 2 if key == COEFFICIENT_KEY else 1 for key in keys[leaving:]}
            self._update(gtsam.NonlinearFactorGraph(), gtsam.Values(), [], last, keys, anew=keys)
            made, removed = self.isam.marginalizeLeavesWithIndices(leaves)
        return made, set(removed)

    def _merge_shared(self) -> None:
        """Keeps what is known of the coefficients alone in one factor, however often the window is cut."""
        alone = {slot: factor for slot, factor in self.shared.items() if list(factor.keys()) == [COEFFICIENT_KEY]}
        if len(alone) < 2:
            return
        stacked, point, graph = gtsam.GaussianFactorGraph(), self._point(0), gtsam.NonlinearFactorGraph()
        for factor in alone.values():
            stacked.push_back(factor.linearize(point))
        triangle = np.linalg.qr(stacked.augmentedJacobian()).R[: self.p]
        merged = linear_factor([COEFFICIENT_KEY], [triangle[:, :-1]], triangle[:, -1], point)
        graph.push_back(merged)
        (slot,) = self._update(graph, gtsam.Values(), list(alone), {}, self._keys())
        self.shared = {s: factor for s, factor in self.shared.items() if s not in alone} | {slot: merged}

    def _restart_bias(self, k: int) -> None:
        """Replaces the link of a state's bias to the one before by the prior of a bias."""
        graph, sample = gtsam.NonlinearFactorGraph(), self.samples[k]
        graph.push_back(bias_start(STATE_KEY + self.first + k, self.settings))
        link = [] if sample.bias_slot is None else [sample.bias_slot]
        slots = self._update(graph, gtsam.Values(), link, {}, self._keys())
        sample.slots, sample.bias_slot = (*sample.slots, *slots), None
        self._read_back()

    def summaries(self) -> list[FactorBatch]:
        """The linear factors from removed states, about the present estimate."""
        values = self.values if self.first else None
        return [] if values is None else [summary_of(f, values, self.first) for f in self.shared.values()]

    def _point(self, count: int) -> gtsam.Values:
        """The linearisation points of the first states of the window and of the coefficients."""
        values = gtsam.Values()
        for k in range(count):
            values.insert(STATE_KEY + self.first + k, self.theta[k])
        if self.p:
            values.insert(COEFFICIENT_KEY, self.coefficient_theta)
        return values

    def _slots(self, samples: range, intervals: range, biases: range) -> list[int]:
        """Slots in iSAM2 of factors: of some samples, of some intervals, and of those to the biases of some samples."""
        slots = [slot for k in samples for slot in self.samples[k].slots]
        slots += [i.slot for k in intervals if (i := self.intervals[k]) is not None and i.slot is not None]
        return slots + [slot for k in biases if (slot := self.samples[k].bias_slot) is not None]
