"""Interpolates states and their derivatives between the nodes of trajectories.

Between two nodes a state is a sum of the nodes' states and slopes, with weights that depend on the time alone; so are
its derivatives, which need no dual arithmetic at the samples.
"""

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
import torch.autograd.forward_ad as forward
from torch import Tensor

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.dual import make_dual
from ballfg.diagnosis.fit.shooting import Arc
from ballfg.dynamics.compiled.samples import sample
from ballfg.state import STATE_DIM


class RepeatedMotion:
    """The motion of n balls, each repeated for d directions of a derivative, direction by direction.

    Args:
        arcs: of the motion.
        balls: n.
        directions: d.
        parts: 3; or 1 for positions alone, with states (n, k, 3).
    """

    def __init__(self, arcs: "Sequence[MovedArc]", balls: int, directions: int, parts: int) -> None:
        self.arcs, self.balls, self.directions, self.parts = arcs, balls, directions, parts

    def states(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """States at dual or plain times (k, n) or (k, d n) s, and their derivatives: (n, k, 9) and (n, k, 9, d)."""
        when, moved = _taken_apart(times)
        later = None if moved is None else moved.reshape(len(times), -1, self.balls).transpose(1, 2)
        return self.at(when[:, : self.balls], later)

    def at(self, when: Tensor, moved: Tensor | None = None) -> tuple[Tensor, Tensor]:
        """The same at times (k, n) s with derivatives (k, n, d); None: that do not move."""
        asked = np.ascontiguousarray(when.T.numpy())
        value = np.zeros((*asked.shape, 3 * self.parts))
        tangent = np.zeros((*value.shape, self.directions))
        later = np.zeros((*asked.shape, 0)) if moved is None else np.ascontiguousarray(moved.transpose(0, 1).numpy())
        for number, arc in enumerate(self.arcs):
            sample(number == 0, asked, later, *arc.arrays, self.parts, value, tangent)
        return torch.from_numpy(value), torch.from_numpy(tangent)

    def plain_states(self, times: Tensor) -> Tensor:
        """(k, n, 9) states at times (k, n) s, without derivatives."""
        return self.states(times)[0].transpose(0, 1)

    def dual_states(self, times: Tensor) -> Tensor:
        """(k, d n, 9) states as dual numbers, direction by direction."""
        value, tangent = self.states(times)
        repeated = value.transpose(0, 1).repeat(1, self.directions, 1)
        return make_dual(repeated, tangent.permute(1, 3, 0, 2).reshape(repeated.shape).contiguous())


@dataclass(frozen=True)
class MovedArc:
    """An arc of n balls with its derivatives in d directions.

    Attributes:
        rows: (n,) numbers of the balls.
        begun: (n,) s.
        began: (n, d) its derivatives.
        step: (n,) s.
        nodes: (n, j, 9) states.
        slopes: (n, j, 9) their derivatives by time.
        nodes_moved: (n, j, 9, d) derivatives of the nodes.
        slopes_moved: (n, j, 9, d) derivatives of the slopes.
    """

    rows: Index
    begun: Array
    began: Array
    step: Array
    nodes: Array
    slopes: Array
    nodes_moved: Array
    slopes_moved: Array

    @classmethod
    def of_dual(cls, arc: Arc, directions: int) -> Self:
        """An arc of d n rows in dual numbers, made within `dual_level()`: n balls repeated direction by direction."""
        n = len(arc.rows) // directions
        begun, began = _taken_apart(arc.begun)
        known = torch.zeros(n, directions) if began is None else began.reshape(directions, n).T
        nodes, nodes_moved = _balls_first(arc.nodes, n, directions)
        slopes, slopes_moved = _balls_first(arc.slopes, n, directions)
        parts = (arc.rows[:n], begun[:n], known.double(), arc.step[:n, 0], nodes, slopes, nodes_moved, slopes_moved)
        return cls(*(np.ascontiguousarray(part.numpy()) for part in parts))

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All arrays, in order."""
        return tuple(getattr(self, field.name) for field in fields(self))


def _balls_first(dual: Tensor, balls: int, directions: int) -> tuple[Tensor, Tensor]:
    """(n, j, 9) values at the nodes and their derivatives (n, j, 9, d), of dual numbers (j, d n, 9)."""
    value, moved = _taken_apart(dual)
    value = value[:, :balls].transpose(0, 1)
    if moved is None:
        return value, value.new_zeros((*value.shape, directions))
    return value, moved.reshape(len(moved), directions, balls, STATE_DIM).permute(2, 0, 3, 1)


def _taken_apart(dual: Tensor) -> tuple[Tensor, Tensor | None]:
    parts = forward.unpack_dual(dual)
    return parts.primal, parts.tangent
