"""Computes `shoot` in machine code: many balls through known contacts, with many directional derivatives."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.shooting import steps_of_arc
from ballfg.diagnosis.fit.tangents import MovedArc
from ballfg.dynamics.compiled.contacts import contacts
from ballfg.dynamics.compiled.flight import fly_arcs
from ballfg.dynamics.compiled.functions import NONE, CompiledModel, Function
from ballfg.dynamics.motion.limits import LONGEST_FALL


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

    Args:
        model: the functions of an analytic model.
        coefficients: of each ball.
        start: (n, 9) at time 0.
        moved: (n, 9, d) its derivatives.
        heights: (n, c) m, declared heights of the surfaces in order of contact; NaN after the last.
        guesses: (n, c) s, approximate times of contact.
        ends: (n,) s, durations.
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
