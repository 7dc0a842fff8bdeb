"""A chain window eliminates its states from the oldest to the newest and keeps the triangles.

It keeps the triangle that the earlier states leave on each state. A new sample then costs one step of the elimination,
and a moved state only the steps from it on. Where the chain is cut, the triangle there is the whole information of the
earlier states. The same factors at the same points have the same solution as in iSAM2 (`window.py`), to rounding and
without its objects.
"""

import copy
from collections.abc import Sequence
from itertools import pairwise
from typing import Self

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.online.state import Measurement, Sample, prepare
from ballfg.estimation.online.windows.interval import Interval
from ballfg.estimation.online.windows.linear import LinearFactors
from ballfg.estimation.online.windows.rows import Answer, LinearRows, columns_of, write_answers, write_linear
from ballfg.estimation.online.windows.stream_window import Arrival, StreamWindow
from ballfg.factors.batch import COEFFICIENTS, FactorBatch
from ballfg.factors.correlated_noise import BiasFactors, BiasStartFactors
from ballfg.factors.dynamics import DynamicsFactors
from ballfg.factors.linear.covariance import marginal_covariances
from ballfg.factors.linear.elimination import Root, eliminate_on, padded
from ballfg.factors.linear.substitution import solution_of
from ballfg.factors.prior import coefficient_prior


class ChainWindow(StreamWindow):
    """The window as a chain: arguments and attributes as those of `StreamWindow`."""

    def _clear(self) -> None:
        """Removes all states; the information from earlier states on the first one stays."""
        super()._clear()
        self._columns = padded(2 * self.width + self.p + 1)
        self._across = (0, self.width, 2 * self.width)[: 3 if self.p else 2]  # columns of an interval's variables
        self._priors: list[list[FactorBatch]] = []  # of each state, and of its tracker's bias
        self._linear: list[LinearRows | None] = []  # of each state; None where they are to be made
        self._links: list[LinearRows] = []  # of each interval, between the tracker's biases, if there are any
        self._rows: list[Array] = []  # of each state: (r, columns) of all factors of which it is the first state
        self._room(0)
        self._answers: list[list[Answer]] = []  # of each: measurements and the interval after it
        self._stale: dict[int, bool] = {}  # states whose rows are to be written, and whether their answers are new
        if not self.first:
            self._summary: LinearFactors | None = None  # of the first state and the coefficients

    def _room(self, count: int) -> None:
        """Enlarges the arrays of the chain to twice as many states; eliminated rows stay."""
        w, p, size = self.width, self.p, 2 * count + 64
        shapes = ((size + 1, w, self._columns), (size + 1, p, self._columns), (size, w, 2 * w + p + 1))
        carries, shared, root = (np.zeros(shape) for shape in shapes)
        for new, kept in zip((carries, shared, root), self._chain if count else (), strict=False):
            held = min(len(new), len(kept))
            new[:held] = kept[:held]
        self._chain: tuple[Array, Array, Array] = carries, shared, root

    def copy(self, samples: Sequence[Sample]) -> Self:
        """An independent window with the same states and factors."""
        other = copy.copy(self)
        other.samples, other.intervals = list(samples), [copy.copy(interval) for interval in self.intervals]
        other._priors, other._rows = [list(batches) for batches in self._priors], list(self._rows)
        other._linear, other._links, other._answers = list(self._linear), list(self._links), list(self._answers)
        other._stale = dict(self._stale)
        other._room(len(self.samples))
        return other

    def _insert(self, arrivals: Sequence[Arrival]) -> None:
        """Takes in new states with their factors, one after another, and solves."""
        first = len(self.samples)
        for arrival in arrivals:
            sample, own = arrival.sample, list(arrival.priors)
            prepare(sample.measurements, np.tile(arrival.state, (len(sample.measurements), 1)))
            if self.biased and own and not self.samples:
                own.append(BiasStartFactors(np.zeros(1, dtype=np.int64), self.settings.bias_sigmas))
            if self.samples:
                self.intervals.append(arrival.interval)
                if self.biased:
                    at, dt = np.zeros(1, dtype=np.int64), np.array([sample.time - self.samples[-1].time])
                    link = BiasFactors(at, dt, self.settings.bias_sigmas, self.settings.memory_time)
                    self._links.append(LinearRows([link], self.width, self.p, self._columns))
            self.samples.append(sample)
            self._priors.append(own)
            self._rows.append(np.empty((0, self._columns)))
            self._answers.append([])
            self._linear.append(None)
        self.theta = np.concatenate((self.theta, np.array([arrival.state for arrival in arrivals])))
        self._renew(range(first, len(self.samples)))
        self._solve()

    def retract(self, count: int) -> None:
        """Removes the newest samples, with their states and factors."""
        for held in (self.samples, self._priors, self._linear, self._answers, self._rows):
            del held[count:]
        del self.intervals[count - 1 :], self._links[count - 1 :]
        self.theta, self._stale = self.theta[:count], {k: new for k, new in self._stale.items() if k < count}
        self._answers[-1] = [answer for answer in self._answers[-1] if not isinstance(answer.batch, DynamicsFactors)]
        self._renew([count - 1], moved=False)

    def append_all(self, samples: Sequence[Sample]) -> Array:
        """As the base's, after what was retracted or weighed anew."""
        if self._stale:
            self._solve()
        return super().append_all(samples)

    def attach(self, measurement: Measurement) -> Array:
        """Adds one more measurement of the newest sample, which holds it already."""
        self._relinearize(None)
        measurement.corrected(self.points[-1], self.newest_covariance[: self.width, : self.width])
        beside = self.samples[-1].measurements
        prepare(beside, np.tile(self.theta[-1], (len(beside), 1)))
        self._renew([len(self.samples) - 1])
        self._solve()
        return measurement.innovation

    def reweigh(self, numbers: list[int]) -> None:
        """Replaces the position factors of some samples of the window, whose noise has changed."""
        for k in numbers:
            self._linear[k] = None
        self._renew(numbers, moved=False)

    def shorten(self, keep: int) -> None:
        """Drops all but the newest states; the triangle at the cut keeps their information."""
        leaving = len(self.samples) - keep
        w, p, linked = self.width, self.p, self.intervals[leaving - 1] is not None
        carries, shared, _ = self._chain
        known = np.concatenate((carries[leaving] if linked else carries[leaving, :0], shared[leaving]))
        blocks = [known[:, :w], known[:, 2 * w : 2 * w + p]]
        points = [self.theta[leaving : leaving + 1], self.coefficient_theta[None]]
        self._summary = LinearFactors([0, COEFFICIENTS], points, blocks, known[:, -1], self.biased)
        self.first += leaving
        self.samples, self.intervals = self.samples[leaving:], self.intervals[leaving:]
        self._priors, self._linear = self._priors[leaving:], [None, *self._linear[leaving + 1 :]]
        self._links = self._links[leaving:]
        self._rows, self._answers = self._rows[leaving:], self._answers[leaving:]
        self.theta, self.delta = self.theta[leaving:], self.delta[leaving:]
        if self.biased and not linked:
            self._priors[0].append(BiasStartFactors(np.zeros(1, dtype=np.int64), self.settings.bias_sigmas))
            self._room(0)
            self._renew([0], moved=False)
            self._solve()
            return
        carries, shared, root = (held[leaving:] for held in self._chain)  # what stays is eliminated already
        carries[0], shared[0] = 0.0, 0.0  # the summary holds it
        self._chain = carries, shared, root
        self._renew([0], moved=False)
        self._write()

    def summaries(self) -> list[FactorBatch]:
        """The information of removed states, as one linear factor."""
        if not self.first or self._summary is None:
            return []
        if self.p:
            return [self._summary]
        known = self._summary  # without coefficients
        return [LinearFactors([0], known.points[:1], known.blocks[:1], known.b, known.sees_biases)]

    def _first_is_known(self) -> bool:
        return self._summary is not None and bool(self._summary.blocks[0].any())

    def _relinearize(self, new: Interval | None) -> Array:
        """As the base's; the chain's rows of all evaluated factors become stale."""
        before, shared = self.theta, self.coefficient_theta
        found = super()._relinearize(new)
        if self.coefficient_theta is not shared:
            self._renew(range(len(self.samples)))
        elif self.theta is not before:
            self._renew(np.flatnonzero((self.theta != before).any(axis=1)).tolist())
        return found

    def _renew(self, numbers: Sequence[int], moved: bool = True) -> None:
        """Marks the rows of some states as stale; if they moved, those of the states before as well."""
        for k in numbers:
            self._stale[k] = moved or self._stale.get(k, False)
            if moved and k:
                self._stale[k - 1] = True

    def _write(self) -> None:
        """Writes the rows of all stale states: those of the factors whose first state each is."""
        parts, numbers, begins = list[LinearRows](), list[int](), list[int]()
        answers, firsts, edges = list[Answer](), list[int](), [0]
        for k, moved in self._stale.items():
            self._answers[k] = self._ask(k) if moved else self._answers[k]
            own = self._linear[k] = self._linear[k] or self._linear_rows(k)
            row = edges[-1]
            for part in (own, *self._links[k : k + 1]):
                parts.append(part)
                numbers.append(k)
                begins.append(row)
                row += part.dim
            for answer in self._answers[k]:
                answers.append(answer)
                firsts.append(row)
                row += len(answer.residual)
            edges.append(row)
        written = np.zeros((edges[-1], self._columns))
        write_linear(parts, np.array(numbers), np.array(begins), self.theta, self.coefficient_theta, written)
        write_answers(answers, firsts, written)
        for k, (begin, end) in zip(self._stale, pairwise(edges), strict=True):
            self._rows[k] = written[begin:end]
        self._stale.clear()

    def _ask(self, k: int) -> list[Answer]:
        """The newest answers of a state's measurements and of the interval after it."""
        found = [
            Answer(m.batch, *m.bridge.kept(0), columns_of(m.batch, self.width)) for m in self.samples[k].measurements
        ]
        if k < len(self.intervals) and (interval := self.intervals[k]) is not None:
            found.append(Answer(interval.batch, *interval.bridge.kept(0), self._across))
        return found  # bridges are shared with copies of the window, results are not

    def _linear_rows(self, k: int) -> LinearRows:
        """The rows of a state's own linear factors: its position's and its priors, those of the first one's past."""
        batches = [*self._priors[k]]
        if self.samples[k].measured:
            batches.append(self._position_batch(self.samples[k], k))
        if k == 0 and self._summary is not None:
            batches.append(self._summary)
        elif k == 0 and self.p:
            batches.append(coefficient_prior(self._own_means, self._own_sigmas))
        return LinearRows(batches, self.width, self.p, self._columns)

    def _solve(self) -> None:
        """Eliminates from the first state whose rows have changed.

        Raises: RuntimeError: if the system is singular.
        """
        n = len(self.samples)
        begin = min(self._stale, default=n - 1)
        if n > len(self._chain[2]):
            self._room(n)
        self._write()
        rows = self._rows[begin:]
        start = np.zeros(len(rows) + 1, dtype=np.int64)
        np.cumsum([len(part) for part in rows], out=start[1:])
        carries, shared, root = self._chain
        part = (carries[begin : n + 1], shared[begin : n + 1], root[begin:n])
        eliminate_on(np.concatenate(rows), start, self.width, *part)
        delta, coefficients = solution_of(self._root(0))
        if not (np.isfinite(delta).all() and np.isfinite(coefficients).all()):
            raise RuntimeError("the linear system of the window is singular")
        self.delta, self.coefficient_delta = delta, coefficients
        self.newest_covariance = marginal_covariances(self._root(n - 1)).joint(0)

    def _root(self, first: int) -> Root:
        """The triangle of the states from one on, with the coefficients."""
        _, shared, root = self._chain
        n, end = len(self.samples), 2 * self.width + self.p
        return Root(root[first:n], np.concatenate((shared[n, :, :end], shared[n, :, -1:]), axis=1))
