"""Computes many balls through known contacts in machine code, with many directional derivatives, at any times.

`shoot_compiled` is `shooting.shoot` in machine code. Between two nodes of a trajectory a state is a sum of the nodes'
states and slopes, with weights that depend on the time alone; so are its derivatives, which need no dual arithmetic at
the samples.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from typing import Self

import numpy as np
import torch
import torch.autograd.forward_ad as forward
from torch import Tensor

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.shooting import Arc, steps_of_arc
from ballfg.dynamics.compiled.contacts import contacts
from ballfg.dynamics.compiled.flight import fly_arcs
from ballfg.dynamics.compiled.functions import NONE, CompiledModel, Function
from ballfg.dynamics.compiled.samples import sample
from ballfg.dynamics.motion.limits import LONGEST_FALL
from ballfg.state import STATE_DIM


def make_dual(primal: Tensor, tangent: Tensor) -> Tensor:
    """A tensor with a tangent, within torch's `dual_level()`.

    The first call makes torch 2.13 compile its own rules with `torch.jit.script`, whose deprecation warning callers
    cannot avoid; it would be an error in a process that turns warnings into errors.
    """
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "`torch.jit.script` is deprecated", DeprecationWarning)
        return forward.make_dual(primal, tangent)


class RepeatedMotion:
    """The motion of n balls, each repeated for d directions of a derivative, direction by direction.

    Args: balls: n.  directions: d.  parts: 3; or 1 for positions alone, with states (n, k, 3).
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
    """An arc of n balls with its derivatives in d directions."""

    rows: Index  # (n,) numbers of the balls
    begun: Array  # (n,) s
    began: Array  # (n, d) its derivatives
    step: Array  # (n,) s
    nodes: Array  # (n, j, 9) states
    slopes: Array  # (n, j, 9) their derivatives by time
    nodes_moved: Array  # (n, j, 9, d) derivatives of the nodes
    slopes_moved: Array  # (n, j, 9, d) derivatives of the slopes

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


@dataclass(frozen=True)
class Coefficients:
    """Coefficients of n balls by parameter name, (n,) each, and their tangents (n, d); zero for the others."""

    values: Mapping[str, Array]
    tangents: Mapping[str, Array]

    def of(self, function: Function, rows: Index, directions: int) -> tuple[Array, Array]:
        """Coefficients of some rows for a compiled function, with tangents: (m, p) and (m, p, d)."""
        m, p = len(rows), len(function.names)
        values, tangents = np.empty((m, p)), np.zeros((m, p, directions))
        for place, name in enumerate(function.names):
            values[:, place] = self.values[name][rows]
            if name in self.tangents:
                tangents[:, place] = self.tangents[name][rows]
        return values, tangents


@dataclass(frozen=True)
class MovedShot:
    """Arcs of a motion with their derivatives, and the times (n, c) s of contacts; NaN without one."""

    arcs: list[MovedArc]
    contacts: Tensor


def shoot_compiled(
    model: CompiledModel,
    coefficients: Coefficients,
    start: Array,
    moved: Array,
    heights: Tensor,
    guesses: Tensor,
    ends: Tensor,
) -> MovedShot:
    """The motion of n balls, as `shooting.shoot`, with its derivatives in d directions.

    Args: start: (n, 9) at time 0.  moved: (n, 9, d) its derivatives.  heights, guesses, ends: as of `shoot`.
    """
    n, _, d = moved.shape
    rows, begun, began = np.arange(n, dtype=np.int64), np.zeros(n), np.zeros((n, d))
    met = np.concatenate((heights.numpy(), np.full((n, 1), np.nan)), axis=1)
    about = np.concatenate((guesses.numpy(), np.full((n, 1), np.nan)), axis=1)
    found, arcs = np.full(heights.shape, np.nan), list[MovedArc]()
    for number in range(met.shape[1]):
        meets = ~np.isnan(met[rows, number])
        until = np.where(meets, about[rows, number], ends.numpy()[rows])
        arc = _flown(model, coefficients, rows, start, moved, begun, began, until - begun)
        arcs.append(arc)
        if not meets.any():
            break
        near, nearer = (np.ascontiguousarray(a[:, -1][meets]) for a in (arc.nodes, arc.nodes_moved))
        lasted = (arc.nodes.shape[1] - 1) * arc.step[meets]
        rows, begun, began = rows[meets], begun[meets] + lasted, began[meets]
        m = len(rows)
        tau, slower, start, moved = np.empty(m), np.empty((m, d)), np.empty((m, 9)), np.empty((m, 9, d))
        functions = (model.rates, model.impact, model.surface)
        given = [array for function in functions for array in coefficients.of(function, rows, d)]
        level = np.ascontiguousarray(met[rows, number])
        addresses = (function.compute.address for function in functions)
        longest = np.full(m, LONGEST_FALL)
        contacts(
            *addresses, near, nearer, *given, NONE, NONE, NONE, level, longest, model.radius, tau, slower, start, moved
        )
        found[rows, number] = begun + tau
        begun, began = begun + np.nan_to_num(tau), began + slower
    return MovedShot(arcs, torch.from_numpy(found))


def _flown(
    model: CompiledModel,
    coefficients: Coefficients,
    rows: Index,
    start: Array,
    moved: Array,
    begun: Array,
    began: Array,
    duration: Array,
) -> MovedArc:
    count, step = steps_of_arc(torch.from_numpy(start), torch.from_numpy(duration))
    m, _, d = moved.shape
    nodes, slopes = np.empty((m, count + 1, 9)), np.empty((m, count + 1, 9))
    nodes_moved, slopes_moved = np.empty((m, count + 1, 9, d)), np.empty((m, count + 1, 9, d))
    given = coefficients.of(model.rates, rows, d)
    rates = model.rates.compute.address
    fly_arcs(rates, start, moved, *given, NONE, step.numpy(), count, nodes, nodes_moved, slopes, slopes_moved)
    return MovedArc(rows, begun, began, step.numpy(), nodes, slopes, nodes_moved, slopes_moved)
