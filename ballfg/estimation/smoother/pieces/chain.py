"""Solves the whole track as a small chain of the ends of its sections."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.smoother.pieces.reduction import Ends, Point
from ballfg.factors.batch import COEFFICIENTS, Rows, Values
from ballfg.factors.linear.covariance import NeighbourCovariances
from ballfg.factors.linear.elimination import Root
from ballfg.factors.linear.step import solve
from ballfg.factors.loss import Loss
from ballfg.state import STATE_DIM


@dataclass(frozen=True)
class Chain:
    """The solution for all ends.

    Attributes:
        states: (k + 1, w) target states at the ends of k sections.
        coefficients: (p,) target of the coefficients.
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
        found = self._known
        return [_joint(found, section) for section in range(len(self.states) - 1)]


def solve_chain(ends: Sequence[Ends], points: Sequence[Point], priors: Sequence[Rows], anchor: Array) -> Chain | None:
    """The step of all ends and coefficients to the minimum of the linearised objective.

    The sections may have different linearisation points.

    Args:
        ends: of each section.  points: linearisation point of each.
        priors: factors on the coefficients alone.
        anchor: (p,) linearisation point of the coefficients, in their own units; the solution is a step from there.
    Returns: None if the system is singular.
    """
    states = np.stack([*(point.first for point in points), points[-1].last])
    rows = [_moved(*each, anchor) for each in zip(ends, points, states[1:], strict=True)]
    k, w = len(ends), states.shape[1]
    blocks = [np.stack(column) for column in zip(*rows, strict=True)]
    columns = [np.arange(k), np.arange(1, k + 1)] + ([np.full(k, COEFFICIENTS)] if len(anchor) else [])
    chain = Rows(np.stack(columns, axis=1), -blocks[0], tuple(blocks[1 : 1 + len(columns)]), Loss())
    biases = states[:, STATE_DIM:] if w > STATE_DIM else None
    step = solve([chain, *priors], Values(states[:, :STATE_DIM], anchor, biases))
    if step is None:
        return None
    return Chain(states + step.states, anchor + step.coefficients, step.root)


def _moved(ends: Ends, point: Point, last: Array, coefficients: Array) -> tuple[Array, Array, Array, Array]:
    """Right side and blocks of a section's rows, relative to the common linearisation point."""
    y = ends.y - ends.by_last @ (last - point.last) - ends.by_coefficients @ (coefficients - point.coefficients)
    return y, ends.by_first, ends.by_last, ends.by_coefficients


def _joint(found: NeighbourCovariances, section: int) -> Array:
    """(2 w + p, 2 w + p) of a section's last end, the coefficients, its first end."""
    (first, last), w = found.states[section : section + 2], found.states.shape[-1]
    across, behind = np.split(found.cross[section], [w], axis=1)
    shared = found.cross[section + 1][:, w:]
    return np.block([[last, shared, across.T], [shared.T, found.coefficients, behind.T], [across, behind, first]])


def moved_rows(rows: Rows, step: Array) -> Rows:
    """Factors on the coefficients alone after a step (p,) of these."""
    return replace(rows, residual=rows.residual + rows.jacobians[0] @ step)
