"""Holds the linear system of a window in iSAM2 and reads the solution back.

The window evaluates factors ahead in batches; when GTSAM asks for one, its callback returns the stored result.
"""

from __future__ import annotations

from collections.abc import Sequence

import gtsam
import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.linear_factors import bias_link, bias_start, linear_factor
from ballfg.estimation.online.measurement import prepare
from ballfg.estimation.online.sample import Sample
from ballfg.estimation.online.windows.stream_window import COEFFICIENT_THRESHOLD, Arrival, StreamWindow
from ballfg.factors.bridge import COEFFICIENT_KEY, STATE_KEY, Bridge
from ballfg.factors.prior import coefficient_prior

WILDFIRE = 1e-7
"""m, m/s, rad/s. Back-substitution stops where the solution changes by less."""


class IsamCore(StreamWindow):
    """A window with its linear system in iSAM2: arguments and attributes as those of `StreamWindow`.

    Attributes:
        isam: of GTSAM.
        shared: factors without a sample: the prior of the coefficients; after a cut, the linear factors that replaced
            it and the removed states.
    """

    def _clear(self) -> None:
        """An empty iSAM2 and no states."""
        super()._clear()
        self.isam = self._new_isam()
        if not self.first:
            prior = Bridge(coefficient_prior(self._own_means, self._own_sigmas), "row") if self.p else None
            self.shared: list[gtsam.NonlinearFactor] = [] if prior is None else [prior.factor(0)]

    def _first_is_known(self) -> bool:
        return any(STATE_KEY + self.first in list(factor.keys()) for factor in self.shared)

    def _new_isam(self) -> gtsam.ISAM2:
        return gtsam.ISAM2(_parameters(self.threshold, COEFFICIENT_THRESHOLD * self._own_sigmas))

    def _insert(self, arrivals: Sequence[Arrival]) -> int:
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
            for factor in self.shared:
                graph.push_back(factor)
            if self.p:
                values.insert(COEFFICIENT_KEY, self.coefficient_theta)
        slots = self._update(graph, values, [], last if self.p and older else {})
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
        return int(self._result.getVariablesReeliminated())

    def _factors_of(self, arrival: Arrival, key: int) -> list[gtsam.NonlinearFactor]:
        """The factors of a new state: that of its interval first, then its own."""
        factors: list[gtsam.NonlinearFactor] = []
        if arrival.interval is not None:
            factors.append(arrival.interval.bridge.factor(0))
        measurements = arrival.sample.measurements
        prepare(measurements, np.tile(arrival.state, (len(measurements), 1)))
        factors += self._measured(arrival.sample, key - STATE_KEY)
        factors += [Bridge(prior, "row").factor(0, [key - STATE_KEY]) for prior in arrival.priors]
        if self.biased and arrival.priors and not self.samples:
            factors.append(bias_start(key, self.settings))
        return factors

    def _measured(self, sample: Sample, state: int) -> list[gtsam.NonlinearFactor]:
        """The factors of a sample's measurements."""
        position = [self._position_factor(sample, state)] if sample.measured else []
        return position + [measurement.factor(state) for measurement in sample.measurements]

    def _position_factor(self, sample: Sample, state: int) -> gtsam.NonlinearFactor:
        """The observation's factor; linear without a robust loss."""
        batch = self._position_batch(sample, state)
        if batch.loss.name != "squared":
            return Bridge(batch, "row").factor(0)
        (residual,), (block,) = batch.compute(slice(None), (np.zeros((1, self.width)),))
        return linear_factor([STATE_KEY + state], [block[0]], -residual)

    def _update(
        self, graph: gtsam.NonlinearFactorGraph, values: gtsam.Values, remove: list[int], last: dict[int, int]
    ) -> list[int]:
        """One iSAM2 update; keys in `last` are eliminated after all others, by group; empty: GTSAM's order.

        By itself GTSAM eliminates the newest states last, but not the coefficients: every state would then depend on
        them from below, and no update would be local.
        """
        if last:
            groups = gtsam.KeyGroupMap()
            for key, group in last.items():
                groups.insert2(key, group)
            self._result = self.isam.update(graph, values, remove, groups)
        else:
            self._result = self.isam.update(graph, values, remove)
        return list(self._result.getNewFactorsIndices())

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


def _parameters(threshold: Array, coefficient_threshold: Array) -> gtsam.ISAM2Params:
    """QR, because a loose spin prior beside a tight process noise defeats Cholesky."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", threshold))
    if len(coefficient_threshold):
        thresholds.insert(("c", coefficient_threshold))
    parameters.setRelinearizeThreshold(thresholds)
    solver = gtsam.ISAM2GaussNewtonParams()
    solver.setWildfireThreshold(WILDFIRE)
    parameters.setOptimizationParams(solver)
    return parameters
