"""Derivatives of the states between the nodes of trajectories, without dual arithmetic at every sample.

Between two nodes a state is a sum of the nodes' states and slopes, with weights that depend on the time alone. In a
batch that repeats every row once per direction these weights are the same in each repetition. They are computed once,
and a product of two matrices for each row carries the derivatives of all nodes in all directions to all samples.
"""

from __future__ import annotations

from typing import Final

import torch
import torch.autograd.forward_ad as forward
from torch import Tensor

from ballfg.diagnosis.fit.dual import make_dual
from ballfg.diagnosis.fit.shooting import Arc, Trajectories
from ballfg.dynamics.motion.paths import hermite
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY

START: Final = torch.zeros((2, STATE_DIM), dtype=torch.float64)
"""State and slope from which `hermite` makes the weights: of position, velocity, acceleration; of spin and its rate."""
START[0, POSITION.start] = START[1, POSITION.start + 1] = START[1, VELOCITY.start + 2] = 1.0
START[0, SPIN.start] = START[1, SPIN.start + 1] = 1.0


class RepeatedMotion:
    """The motion of n balls, each repeated for d directions of a derivative, direction by direction.

    Args:
        motion: of d n rows, in dual numbers; made within `dual_level()`, which is still open.
        directions: d.
        positions_only: whether nobody asks for velocities and spins; they are zero then.
    """

    def __init__(self, motion: Trajectories, directions: int, *, positions_only: bool = False) -> None:
        self.directions, self.balls = directions, len(motion.contacts) // directions
        self.wanted = (POSITION,) if positions_only else (POSITION, VELOCITY, SPIN)
        self.arcs = [_RepeatedArc(arc, directions) for arc in motion.arcs]

    def states(self, times: Tensor) -> tuple[Tensor, Tensor]:
        """States at dual or plain times (k, n) or (k, d n) s, and their derivatives: (n, k, 9) and (n, k, 9, d)."""
        when, moved = _taken_apart(times)
        when = when[:, : self.balls].T
        if moved is not None:
            moved = moved.reshape(len(times), -1, self.balls).permute(2, 0, 1)
        shape = (*when.shape, STATE_DIM)
        value, tangent = when.new_zeros(shape), when.new_zeros((*shape, self.directions))
        for number, arc in enumerate(self.arcs):
            rows, asked = arc.rows, when[arc.rows]
            inside = (asked >= arc.begun[:, None]) | (number == 0)
            found = arc.states(asked, None if moved is None else moved[rows], self.wanted)
            for part, (own, moving) in zip(self.wanted, found, strict=True):
                value[rows, :, part] = torch.where(inside[..., None], own, value[rows, :, part])
                tangent[rows, :, part] = torch.where(inside[..., None, None], moving, tangent[rows, :, part])
        return value, tangent

    def dual_states(self, times: Tensor) -> Tensor:
        """(k, d n, 9) the same as dual numbers, direction by direction."""
        value, tangent = self.states(times)
        repeated = value.transpose(0, 1).repeat(1, self.directions, 1)
        return make_dual(repeated, tangent.permute(1, 3, 0, 2).reshape(repeated.shape).contiguous())


class _RepeatedArc:
    """An arc of n rows, repeated for d directions.

    Attributes:
        rows: (n,) numbers of the balls.  begun: (n,) s.  step: (n,) s.
        began: (n, d) derivatives of `begun`; None where the arc starts at time zero.
        nodes, slopes: (n, j, 9) states and their derivatives by time; nodes_moved, slopes_moved: (n, j, 9, d).
    """

    def __init__(self, arc: Arc, directions: int) -> None:
        n = len(arc.rows) // directions
        self.directions = directions
        self.rows, self.step = arc.rows[:n], arc.step[:n, 0]
        begun, began = _taken_apart(arc.begun)
        self.begun = begun[:n]
        self.began = None if began is None else began.reshape(directions, n).T
        self.nodes, self.nodes_moved = self._rows_first(arc.nodes)
        self.slopes, self.slopes_moved = self._rows_first(arc.slopes)

    def _rows_first(self, dual: Tensor) -> tuple[Tensor, Tensor]:
        """(n, j, 9) values at the nodes and their derivatives (n, j, 9, d), of dual numbers (j, d n, 9)."""
        value, moved = _taken_apart(dual)
        n = len(self.rows)
        value = value[:, :n].transpose(0, 1)
        if moved is None:
            return value, value.new_zeros((*value.shape, self.directions))
        return value, moved.reshape(len(moved), self.directions, n, STATE_DIM).permute(2, 0, 3, 1)

    def states(self, times: Tensor, moved: Tensor | None, wanted: tuple[slice, ...]) -> list[tuple[Tensor, Tensor]]:
        """Parts (n, k, 3) of the states at times (n, k) s and their derivatives (n, k, 3, d); moved: (n, k, d)."""
        place = (times - self.begun[:, None]) / self.step[:, None]
        index = place.floor().clamp(0, self.nodes.shape[1] - 2).long()
        still = moved is None and self.began is None
        weights, slopes = _weights((place - index).unsqueeze(-1), self.step[:, None, None], still)
        shift = None
        if not still:
            began = torch.zeros(()) if self.began is None else self.began[:, None, :]
            shift = ((0.0 if moved is None else moved) - began) / self.step[:, None, None]
        found = []
        for part in wanted:
            sources = self._sources(part)
            spread = _spread(weights[..., part], index, self.nodes.shape[1])
            own, moving = (_product(spread, table) for table in sources)
            if shift is not None:
                faster = _product(_spread(slopes[..., part], index, self.nodes.shape[1]), sources[0])
                moving = moving + faster[..., None] * shift[:, :, None, :]
            found.append((own, moving))
        return found

    def _sources(self, part: slice) -> tuple[Tensor, Tensor]:
        """(n, j, 3, 3) what a part of the state is made of at each node, and its derivatives (n, j, 3, 3, d)."""
        if part == SPIN:
            of_nodes, of_slopes = (SPIN,), (SPIN, SPIN)  # the weight of the last is zero
        else:
            of_nodes, of_slopes = (POSITION,), (POSITION, VELOCITY)
        value = [self.nodes[:, :, p] for p in of_nodes] + [self.slopes[:, :, p] for p in of_slopes]
        moved = [self.nodes_moved[:, :, p] for p in of_nodes] + [self.slopes_moved[:, :, p] for p in of_slopes]
        return torch.stack(value, dim=2), torch.stack(moved, dim=2)


def _weights(theta: Tensor, step: Tensor, still: bool) -> tuple[Tensor, Tensor]:
    """(n, k, 2, 9) weights of what a step's start and end are made of, and their derivatives by theta (n, k, 1)."""
    nothing = torch.zeros_like(START[0])
    moving = theta if still else make_dual(theta, torch.ones_like(theta))
    ends = (
        hermite(moving, step, START[0], START[1], nothing, nothing),
        hermite(moving, step, nothing, nothing, START[0], START[1]),
    )
    values, slopes = zip(*(_taken_apart(end) for end in ends), strict=True)
    weights = torch.stack(values, dim=2)
    return weights, weights if still else torch.stack(slopes, dim=2)


def _spread(weights: Tensor, index: Tensor, nodes: int) -> Tensor:
    """(n, k, j, 3) weights (n, k, 2, 3) of the two nodes (n, k) about each time, as weights of all nodes."""
    spread = weights.new_zeros((*index.shape, nodes, weights.shape[-1]))
    for end in (0, 1):
        where = (index + end)[..., None, None].expand(-1, -1, 1, weights.shape[-1])
        spread.scatter_(2, where, weights[:, :, end : end + 1])
    return spread


def _product(weights: Tensor, table: Tensor) -> Tensor:
    """(n, k, 3, ...) sums over nodes and sources of weights (n, k, j, 3) and a table (n, j, 3, 3, ...)."""
    n, k = weights.shape[:2]
    flat = weights.reshape(n, k, -1) @ table.reshape(n, table.shape[1] * 3, -1)
    return flat.reshape(n, k, *table.shape[3:])


def _taken_apart(dual: Tensor) -> tuple[Tensor, Tensor | None]:
    parts = forward.unpack_dual(dual)
    return parts.primal, parts.tangent
