"""What a model says each sample should be, and how that changes with first states and coefficients.

Derivatives are torch's forward mode: the batch is repeated once per direction, with a dual number in that direction.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
import torch
import torch.autograd.forward_ad as forward
from numpy.typing import NDArray
from torch import Tensor

from ballfg.diagnosis.fit.dual import dual_level, make_dual
from ballfg.diagnosis.fit.shooting import Trajectories, shoot
from ballfg.diagnosis.fit.stretches import Stretches
from ballfg.dynamics.model import BallModel, substitute
from ballfg.state import SPIN, STATE_DIM

MOST_ROWS = 3000
"""Rows of one forward pass: more are cut into several; memory is some 50 kB a row."""

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Predicted:
    """What should have been measured, for n stretches of k samples.

    Attributes:
        positions: (n, k, 3) m.
        labels: (n, 3) rad/s.
        contacts: (n, c) s, when each contact happens; NaN where there is none.
    """

    positions: Array
    labels: Array
    contacts: Array


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of `Predicted` by d directions: positions (n, k, 3, d), labels (n, 3, d)."""

    positions: Array
    labels: Array


def predict(model: BallModel, stretches: Stretches, starts: Array, values: Mapping[str, float]) -> Predicted:
    """What a model says, with some of its coefficients replaced.

    Args:
        model: the ball.  stretches: stamps and contacts.
        starts: (n, 9) states at the first samples.
        values: coefficients by name as in `model.named_parameters()`.
    """
    with torch.no_grad():
        columns = {name: torch.full((len(stretches), 1), value, dtype=torch.float64) for name, value in values.items()}
        positions, labels, motion = _measured(substitute(model, columns), stretches, torch.from_numpy(starts))
    return Predicted(positions.numpy(), labels.numpy(), motion.contacts.numpy())


def sensitivity(
    model: BallModel,
    stretches: Stretches,
    starts: Array,
    values: Mapping[str, float],
    names: Sequence[str],
    *,
    by_start: bool = True,
    shapes: Sequence[Mapping[str, float]] = (),
) -> Sensitivity:
    """Derivatives by the nine components of the first state (unless not `by_start`), then by the named coefficients.

    Args:
        names: coefficients among `values`; one that is named again has one derivative for each of its shapes.
        shapes: for each name, values of other coefficients with which that derivative is taken; empty: none.
        Others as for `predict`.
    """
    wanted = [_Direction(number, None, {}) for number in range(STATE_DIM if by_start else 0)]
    wanted += [_Direction(None, name, shape) for name, shape in zip(names, shapes or [{}] * len(names), strict=True)]
    size = max(1, MOST_ROWS // len(stretches))
    parts = [
        _directions(model, stretches, starts, values, wanted[first : first + size])
        for first in range(0, len(wanted), size)
    ]
    return Sensitivity(
        np.concatenate([p.positions for p in parts], axis=-1), np.concatenate([p.labels for p in parts], axis=-1)
    )


@dataclass(frozen=True)
class _Direction:
    """What a derivative is taken by: a component of the first state, or a coefficient, with others at some values."""

    component: int | None
    name: str | None
    values: Mapping[str, float]


def _directions(
    model: BallModel,
    stretches: Stretches,
    starts: Array,
    values: Mapping[str, float],
    wanted: Sequence[_Direction],
) -> Sensitivity:
    n, d = len(stretches), len(wanted)
    repeated = stretches.take(np.tile(np.arange(n), d))
    state = torch.from_numpy(np.tile(starts, (d, 1)))
    state_tangent = torch.zeros_like(state)
    primals = {name: torch.full((n * d, 1), value, dtype=torch.float64) for name, value in values.items()}
    tangents = {name: torch.zeros(n * d, 1, dtype=torch.float64) for name in values}
    for block, direction in enumerate(wanted):
        rows = slice(block * n, (block + 1) * n)
        if direction.component is not None:
            state_tangent[rows, direction.component] = 1.0
        if direction.name is not None:
            tangents[direction.name][rows] = 1.0
        for name, value in direction.values.items():
            primals[name][rows] = value
    with dual_level():
        columns = {name: make_dual(primals[name], tangents[name]) for name in values}
        dual = make_dual(state, state_tangent)
        positions, labels, _ = _measured(substitute(model, columns), repeated, dual)
        moved, relabelled = _tangent(positions), _tangent(labels)
    k = positions.shape[1]
    return Sensitivity(
        np.moveaxis(moved.numpy().reshape(d, n, k, 3), 0, -1), np.moveaxis(relabelled.numpy().reshape(d, n, 3), 0, -1)
    )


def _tangent(dual: Tensor) -> Tensor:
    tangent = forward.unpack_dual(dual).tangent
    return torch.zeros_like(dual) if tangent is None else tangent


def _measured(model: BallModel, stretches: Stretches, starts: Tensor) -> tuple[Tensor, Tensor, Trajectories]:
    """Positions (r, k, 3) and labels (r, 3) as they are measured, and the motion behind them."""
    # stamps run along the first axis: a coefficient of shape (r, 1) then goes with (k, r, 1)
    times = model.true_stamps(stretches.times.T.unsqueeze(-1)).squeeze(-1)
    motion = shoot(model, starts, stretches.heights, stretches.contacts, stretches.ends)

    def later(delay: Tensor | float) -> Tensor:
        shift = delay.squeeze(-1) if isinstance(delay, Tensor) and delay.dim() else delay
        return motion.states(times + shift)

    positions = model.measured(motion.states(times), later)
    return positions.transpose(0, 1), model.labelled(starts[:, SPIN]), motion
