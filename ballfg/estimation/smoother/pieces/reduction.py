"""Reduces the linear problem of a section to its two ends and the coefficients, and recovers its states.

The inner states are eliminated; the first state waits among the coefficients. The remaining rows of the two ends and
the coefficients are exactly the section's information for the rest of the track. Once the rest has been solved, the
inner states follow.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ballfg.arrays import Array
from ballfg.factors.batch import COEFFICIENTS, Rows, Values
from ballfg.factors.linear.covariance import Covariances, NeighbourCovariances, marginal_covariances
from ballfg.factors.linear.elimination import Root, eliminate
from ballfg.factors.linear.step import WAITING, damped_rows, solve
from ballfg.factors.linear.substitution import substitute_back
from ballfg.factors.loss import Loss
from ballfg.state import STATE_DIM


@dataclass(frozen=True)
class Point:
    """A point or step: ends of a section (w,), which biases follow, and coefficients (p,) in their own units."""

    first: Array
    last: Array
    coefficients: Array

    @classmethod
    def of(cls, values: Values) -> "Point":
        """The ends of a section's values."""
        whole = values.states if values.biases is None else np.concatenate((values.states, values.biases), axis=1)
        return cls(whole[0], whole[-1], values.coefficients)

    def since(self, other: "Point") -> "Point":
        """The step from another point to this one."""
        return Point(self.first - other.first, self.last - other.last, self.coefficients - other.coefficients)


@dataclass(frozen=True)
class Ends:
    """A section's information on its ends: |by_first d_first + by_last d_last + by_coefficients d_c - y|^2.

    Attributes:
        by_first, by_last: (w + w + p, w) or less rows, whitened, per unit of the state.
        by_coefficients: (.., p) whitened, per unit of each coefficient.  y: (..,) whitened.
    """

    by_first: Array
    by_last: Array
    by_coefficients: Array
    y: Array

    def change(self, step: Point) -> Array:
        """(..,) whitened change of the rows along a step of the ends and the coefficients."""
        return self.by_first @ step.first + self.by_last @ step.last + self.by_coefficients @ step.coefficients


@dataclass(frozen=True)
class Response:
    """Dependence of a section's states on its ends and the coefficients.

    Attributes:
        alone: (n, w) step of the states for fixed ends and coefficients.
        by_first, by_last: (r, w, w) effect of a step of an end on the states next to it, in the track's order. Beyond
            those it is neglected: the section's next linearisation compensates for it.
        by_coefficients: (n, w, p) effect of a step of the coefficients.
    """

    alone: Array
    by_first: Array
    by_last: Array
    by_coefficients: Array

    def steps(self, ends: Point) -> Array:
        """(n, w) steps of all states for a step of the ends and the coefficients."""
        steps = self.alone + self.by_coefficients @ ends.coefficients
        steps[1 : 1 + len(self.by_first)] += self.by_first @ ends.first
        steps[len(steps) - 1 - len(self.by_last) : -1] += self.by_last @ ends.last
        steps[0], steps[-1] = ends.first, ends.last
        return steps


class Reduction:
    """A section with eliminated inner states.

    Args: linearized: the section's factors, at values.  values: of its n states, at least two, and the coefficients.

    Attributes:
        root: of the states but the first, followed by the coefficients and the first state.
        inner: predicted decrease of the objective by the inner states alone.
    """

    def __init__(self, linearized: Sequence[Rows], values: Values) -> None:
        self.width, self.coefficients = values.width, len(values.coefficients)
        w, p, m = self.width, self.coefficients + self.width, len(values.states) - 1
        point = Values(values.states[1:], np.zeros(p), None if values.biases is None else values.biases[1:])
        behind = []  # state 0 behind the coefficients, and the others counted from state 1
        for rows in linearized:
            waiting = np.where(rows.variables == COEFFICIENTS, COEFFICIENTS, WAITING)
            behind.append(replace(rows, variables=np.where(rows.variables > 0, rows.variables - 1, waiting)))
        system, start, _ = damped_rows(behind, point, 0.0, held=w)
        self.root = Root.empty(m, w, p)
        eliminate(system, start, w, w, self.root)
        self.inner = 0.5 * float((self.root.states[:-1, :, -1] ** 2).sum())

    @property
    def ends(self) -> Ends:
        """The section's rows of its ends and the coefficients."""
        w, p = self.width, self.coefficients
        last, shared = self.root.states[-1], self.root.coefficients
        rows = np.concatenate((last, np.concatenate((np.zeros((len(shared), w)), shared[:, w:]), axis=1)))
        behind = rows[:, 2 * w : -1]
        return Ends(behind[:, p:], rows[:, :w], behind[:, :p], rows[:, -1])

    def steps(self, ends: Point) -> Array:
        """(n, w) steps of all states for a step of the ends and the coefficients."""
        w, inner = self.width, self.root.states[:-1]
        right = inner[..., -1] - inner[..., 2 * w : -1] @ np.concatenate((ends.coefficients, ends.first))
        right[-1:] -= inner[-1:, :, w : 2 * w] @ ends.last
        return np.concatenate((ends.first[None], _solved(inner, right), ends.last[None]))

    def response(self, reach: int) -> Response:
        """The dependence of the states. Args: reach: largest number of states that an end moves."""
        w, p, inner = self.width, self.coefficients, self.root.states[:-1]
        near, far = inner[:reach], inner[max(len(inner) - reach, 0) :]
        by_end = np.zeros((*far.shape[:2], w))
        by_end[-1:] = far[-1:, :, w : 2 * w]
        edge = np.zeros((1, w))
        return Response(
            np.concatenate((edge, _solved(inner, inner[..., -1]), edge)),
            -_solved(near, near[..., 2 * w + p : -1]),
            -_solved(far, by_end),
            np.pad(-_solved(inner, inner[..., 2 * w : 2 * w + p]), ((1, 1), (0, 0), (0, 0))),
        )

    def covariances(self, ends: Array) -> Covariances:
        """Covariances of all states, from (w + p + w, w + p + w) of the last, the coefficients, the first."""
        w, p, triangle = self.width, self.coefficients, _triangle(ends)
        known, below = self.root.states.copy(), np.zeros_like(self.root.coefficients)
        known[-1] = 0.0
        known[-1, :, :w], known[-1, :, 2 * w : -1] = triangle[:w, :w], triangle[:w, w:]
        below[:, 2 * w : -1] = triangle[w:, w:]
        found = marginal_covariances(Root(known, below))
        shared = found.coefficients
        states = np.concatenate((shared[None, p:, p:], found.states))
        cross = np.concatenate((shared[None, p:, :p], found.cross[:, :, :p]))
        return Covariances(states, shared[:p, :p], cross)


def _solved(rows: Array, right: Array) -> Array:
    """Solves the rows of R (m, w, ..) for some states, with the one after them fixed; right (m, w) or (m, w, k)."""
    root, found = Root(rows, np.empty((0, rows.shape[2]))), np.empty_like(right)
    for k in np.ndindex(right.shape[2:]):
        states = right[..., *k].copy()
        substitute_back(root, states, np.empty(0))
        found[..., *k] = states
    return found


def _triangle(covariance: Array) -> Array:
    """The upper triangle R with (R^T R)^-1 = C, for a C that may have lost its last digits."""
    scale = np.sqrt(np.diagonal(covariance))
    size, axes = np.linalg.eigh((covariance / (scale[:, None] * scale))[::-1, ::-1])
    size = np.maximum(size, len(size) * np.finfo(float).eps * size[-1])
    lower = np.linalg.qr((axes * np.sqrt(size)).T)[1].T
    return np.asarray(np.linalg.inv(lower[::-1, ::-1]) / scale)


@dataclass(frozen=True)
class Chain:
    """The solution for all ends.

    Attributes:
        states: (k + 1, w) target states at the ends of k sections.  coefficients: (p,) target of the coefficients.
        root: of the linear problem.
    """

    states: Array
    coefficients: Array
    root: Root

    def target(self, section: int) -> Point:
        """Target of a section's ends."""
        return Point(self.states[section], self.states[section + 1], self.coefficients)

    @cached_property
    def _known(self) -> NeighbourCovariances:
        return NeighbourCovariances.of(self.root)

    @property
    def coefficient_covariance(self) -> Array:
        """(p, p) in the products of the coefficients' units."""
        return self._known.coefficients

    def covariances(self) -> list[Array]:
        """For each section the joint covariance of its last end, the coefficients, its first end."""
        found, w, joints = self._known, self.states.shape[-1], []
        for section in range(len(self.states) - 1):
            first, last = found.states[section : section + 2]
            across, behind = np.split(found.cross[section], [w], axis=1)
            shared = found.cross[section + 1][:, w:]
            rows = [[last, shared, across.T], [shared.T, found.coefficients, behind.T], [across, behind, first]]
            joints.append(np.block(rows))
        return joints


def solve_chain(ends: Sequence[Ends], points: Sequence[Point], priors: Sequence[Rows], anchor: Array) -> Chain | None:
    """The step of all ends and coefficients to the minimum of the linearised objective; None if it is singular.

    Args:
        ends, points: of each section, and its linearisation point.  priors: factors on the coefficients alone.
        anchor: (p,) linearisation point of the coefficients, in their own units; the solution is a step from there.
    """
    states = np.stack([*(point.first for point in points), points[-1].last])
    right = [  # relative to the common linearisation point
        one.y - one.by_last @ (last - point.last) - one.by_coefficients @ (anchor - point.coefficients)
        for one, point, last in zip(ends, points, states[1:], strict=True)
    ]
    k, w = len(ends), states.shape[1]
    blocks = [np.stack([getattr(one, name) for one in ends]) for name in ("by_first", "by_last", "by_coefficients")]
    columns = [np.arange(k), np.arange(1, k + 1)] + ([np.full(k, COEFFICIENTS)] if len(anchor) else [])
    chain = Rows(np.stack(columns, axis=1), -np.stack(right), tuple(blocks[: len(columns)]), Loss())
    biases = states[:, STATE_DIM:] if w > STATE_DIM else None
    step = solve([chain, *priors], Values(states[:, :STATE_DIM], anchor, biases))
    if step is None:
        return None
    return Chain(states + step.states, anchor + step.coefficients, step.root)
