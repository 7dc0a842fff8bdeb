"""Predicts samples, and differentiates them by first states and coefficients.

Motion in machine code has its derivatives there, and the chain rule gives those of what the instrument writes. Others
are torch's forward mode: the batch is repeated once per direction, with a dual number in that direction.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
import torch
import torch.autograd.forward_ad as forward
from torch import Tensor

from ballfg.arrays import Array, Index
from ballfg.diagnosis.fit.shooting import shoot
from ballfg.diagnosis.fit.stretches import Stretches, of_similar_length
from ballfg.diagnosis.fit.tangents import Coefficients, MovedArc, RepeatedMotion, make_dual, shoot_compiled
from ballfg.dynamics import BallModel
from ballfg.dynamics.compiled.functions import CompiledModel, compiled
from ballfg.dynamics.model import substitute
from ballfg.parallel.parts import in_parts
from ballfg.state import SPIN, STATE_DIM

MOST_ROWS = 3000  # Largest number of rows in one forward pass. A row needs some 50 kB of memory


@dataclass(frozen=True)
class Predicted:
    """Predicted samples: positions (n, k, 3) m, labels (n, 3) rad/s, and the times of contacts (n, c) s.

    A time is NaN without a contact.
    """

    positions: Array
    labels: Array
    contacts: Array


@dataclass(frozen=True)
class Sensitivity:
    """Derivatives of `Predicted` by d directions: positions (n, k, 3, d), labels (n, 3, d)."""

    positions: Array
    labels: Array

    def first(self, count: int) -> "Sensitivity":
        """Those by the first directions."""
        return Sensitivity(self.positions[..., :count], self.labels[..., :count])


def predict(model: BallModel, stretches: Stretches, starts: Array, values: Mapping[str, float | Array]) -> Predicted:
    """The samples of a model, from states (n, 9) at the first samples.

    Args: values: of some coefficients, the same for all stretches or (n,) one for each.
    """
    functions, n = compiled(model), len(stretches)
    with torch.no_grad():
        valued, state = with_values(model, values, n), torch.from_numpy(starts)
        times = _true_times(valued, stretches)
        if functions is None:
            motion = shoot(valued, state, stretches.heights, stretches.contacts, times[-1])
            states, contacts = motion.states, motion.contacts
        else:
            known, still = coefficients_of(model, n, values), np.zeros((*starts.shape, 0))
            shot = shoot_compiled(functions, known, starts, still, stretches.heights, stretches.contacts, times[-1])
            parts = 1 if model.measures_plainly else 3
            states, contacts = RepeatedMotion(shot.arcs, n, 0, parts).plain_states, shot.contacts
        positions = valued.measured(states(times), partial(_later, states, times)).transpose(0, 1)
        labels = valued.labelled(state[:, SPIN])
    return Predicted(positions.numpy(), labels.numpy(), contacts.numpy())


def with_values(model: BallModel, values: Mapping[str, float | Array], count: int) -> BallModel:
    """The model with other values of some coefficients, one for all or one for each row of a batch of `count`."""
    return substitute(model, {name: _column(value, count) for name, value in values.items()})


def _column(value: float | Array, count: int) -> Tensor:
    """(count, 1) of one number, or of as many."""
    return torch.from_numpy(np.broadcast_to(np.asarray(value, dtype=np.float64), count).reshape(count, 1).copy())


@dataclass(frozen=True)
class _Direction:
    """A component of the first state or a coefficient, with values of other coefficients for its derivative."""

    component: int | None = None
    name: str | None = None
    values: Mapping[str, float] = field(default_factory=dict)


def sensitivity(
    model: BallModel,
    stretches: Stretches,
    starts: Array,
    values: Mapping[str, float | Array],
    names: Sequence[str],
    *,
    by_start: bool = True,
    shapes: Sequence[Mapping[str, float]] = (),
    most_rows: int = MOST_ROWS,
) -> Sensitivity:
    """Derivatives by the nine components of the first state (unless not `by_start`), then by the named coefficients.

    Args:
        model, stretches, starts, values: as for `predict`.
        names: coefficients among `values`; a repeated one has one derivative for each of its shapes.
        shapes: for each name, values of other coefficients for that derivative; empty: none.
    """
    wanted = [_Direction(component=number) for number in range(STATE_DIM if by_start else 0)]
    wanted += [_Direction(None, name, shape) for name, shape in zip(names, shapes or [{}] * len(names), strict=True)]
    asked = _Asked(model, stretches, starts, values, wanted)
    # a fit takes many steps with one model, a score test one step each with many
    functions = compiled(model) if by_start and not shapes else None
    if functions is not None:
        positions, labels = np.zeros((*stretches.positions.shape, len(wanted))), np.zeros((len(starts), 3, len(wanted)))
        for rows, count in of_similar_length(stretches.used.numpy()):
            found = _compiled_derivatives(functions, asked.of_rows(rows, count))
            positions[rows, :count], labels[rows] = found.positions, found.labels
        return Sensitivity(positions, labels)
    size = max(1, most_rows // len(stretches))
    some = [replace(asked, wanted=wanted[first : first + size]) for first in range(0, len(wanted), size)]
    parts = list(in_parts(_derivatives, some, 1))
    both = ([getattr(part, name) for part in parts] for name in ("positions", "labels"))
    return Sensitivity(*(np.concatenate(one, axis=-1) for one in both))


@dataclass(frozen=True)
class _Asked:
    """The arguments of `sensitivity`, with the directions of the derivatives."""

    model: BallModel
    stretches: Stretches
    starts: Array
    values: Mapping[str, float | Array]
    wanted: Sequence[_Direction]

    def of_rows(self, rows: Index, count: int) -> "_Asked":
        """The same of some stretches, with `count` samples each."""
        own = {n: v[rows] if isinstance(v, np.ndarray) and v.ndim else v for n, v in self.values.items()}
        part = self.stretches.take(rows).cropped(count)
        return replace(self, stretches=part, starts=self.starts[rows], values=own)

    def with_leaves(self, *rows: int) -> tuple[BallModel, list[Tensor]]:
        """The model with its coefficients, and those of the directions, (*rows, n, 1) each, as leaves of a graph."""
        known = {name: _column(value, len(self.stretches)) for name, value in self.values.items()}
        names = [direction.name for direction in self.wanted if direction.name is not None]
        leaves = [known[name].repeat(*rows, 1, 1).requires_grad_() for name in names]
        return substitute(self.model, known | dict(zip(names, leaves, strict=True))), leaves

    def repeated(self) -> tuple[Stretches, BallModel, Tensor]:
        """Stretches, model and first states (d n, 9), repeated direction by direction, as dual numbers."""
        n, d = len(self.stretches), len(self.wanted)
        repeated = self.stretches.take(np.tile(np.arange(n), d))
        state = torch.from_numpy(np.tile(self.starts, (d, 1)))
        state_tangent = torch.zeros_like(state)
        primals = {name: _column(value, n).repeat(d, 1) for name, value in self.values.items()}
        tangents = {name: torch.zeros(n * d, 1, dtype=torch.float64) for name in self.values}
        for block, direction in enumerate(self.wanted):
            rows = slice(block * n, (block + 1) * n)
            if direction.component is not None:
                state_tangent[rows, direction.component] = 1.0
            if direction.name is not None:
                tangents[direction.name][rows] = 1.0
            for name, value in direction.values.items():
                primals[name][rows] = value
        columns = {name: make_dual(primals[name], tangents[name]) for name in self.values}
        return repeated, substitute(self.model, columns), make_dual(state, state_tangent)


def _compiled_derivatives(functions: CompiledModel, asked: _Asked) -> Sensitivity:
    """All derivatives with the motion in machine code; measurement effects stay in torch."""
    model, stretches, starts, wanted = asked.model, asked.stretches, asked.starts, asked.wanted
    n, plainly = len(stretches), model.measures_plainly
    with torch.no_grad():
        ends = _true_times(with_values(model, asked.values, n), stretches)[-1]
    directions = [*wanted] if plainly else [*wanted, _Direction()]  # along the last one only delays grow
    moved = np.zeros((*starts.shape, len(directions)))
    for block, direction in enumerate(wanted):
        if direction.component is not None:
            moved[:, direction.component, block] = 1.0
    known = coefficients_of(model, n, asked.values, directions)
    shot = shoot_compiled(functions, known, starts, moved, stretches.heights, stretches.contacts, ends)
    motion = RepeatedMotion(shot.arcs, n, len(directions), 1 if plainly else 3)
    if plainly:
        return Sensitivity(motion.at(stretches.times.T)[1].numpy(), moved[:, SPIN])
    return _written(asked, motion, torch.from_numpy(moved[:, SPIN, :-1]))


def _written(asked: _Asked, motion: RepeatedMotion, spins_moved: Tensor) -> Sensitivity:
    """The derivatives of what the instrument writes, by the chain rule.

    Torch's reverse mode gives its slopes by the states at a sample and at delays after it and by coefficients, machine
    code the derivatives of the states.

    Args: motion: with the direction along which delays grow last.  spins_moved: (n, 3, d) of the first spins.
    """
    stretches, d = asked.stretches, len(asked.wanted)
    blocks = [block for block, direction in enumerate(asked.wanted) if direction.name is not None]
    model, own = asked.with_leaves(stretches.times.shape[1])
    times, seen = _true_times(model, stretches), list[tuple[Tensor, Tensor]]()
    moved = torch.zeros((*times.shape, d + 1), dtype=torch.float64)
    moved[..., blocks] = _slopes(times.unsqueeze(-1), own)[..., 0, :]
    moved[..., d] = 1.0

    def at(delay: Tensor | float) -> Tensor:
        shift = torch.as_tensor(delay, dtype=torch.float64)
        shift = shift.squeeze(-1) if shift.dim() > times.dim() else shift  # a coefficient as it is
        value, tangent = (one.transpose(0, 1) for one in motion.at((times + shift).detach(), moved))
        leaf = value.contiguous().requires_grad_()
        seen.append((leaf, tangent[..., :d]))
        return leaf + tangent[..., d] * (shift - shift.detach()).unsqueeze(-1)

    measured = model.measured(at(0.0), at)
    slopes = _slopes(measured, [*(leaf for leaf, _ in seen), *own])
    positions = torch.zeros((*measured.shape, d), dtype=torch.float64)
    for number, (_, tangent) in enumerate(seen):
        by_state = slopes[..., number * STATE_DIM : (number + 1) * STATE_DIM]
        for axis, part in np.argwhere(np.any(by_state.numpy(), axis=(0, 1))):  # most slopes are zero everywhere
            positions[..., axis, :] += by_state[..., axis, part, None] * tangent[..., part, :]
    positions[..., blocks] += slopes[..., len(seen) * STATE_DIM :]

    model, own = asked.with_leaves()
    spin = torch.from_numpy(asked.starts[:, SPIN]).requires_grad_()
    slopes = _slopes(model.labelled(spin), [spin, *own])
    labels = slopes[..., :3] @ spins_moved
    labels[..., blocks] += slopes[..., 3:]
    return Sensitivity(positions.transpose(0, 1).numpy(), labels.numpy())


def _slopes(outputs: Tensor, leaves: Sequence[Tensor]) -> Tensor:
    """(..., m, p) derivatives of outputs (..., m) by all components of leaves (..., c): each row by its own one."""
    if not (outputs.requires_grad and leaves):
        return outputs.new_zeros((*outputs.shape, sum(leaf.shape[-1] for leaf in leaves)))
    columns = (outputs[..., part].sum() for part in range(outputs.shape[-1]))
    found = (torch.autograd.grad(c, leaves, retain_graph=True, materialize_grads=True) for c in columns)
    return torch.stack([torch.cat(one, dim=-1) for one in found], dim=-2)


def _derivatives(asked: _Asked) -> Sensitivity:
    with forward.dual_level():
        repeated, dual, state = asked.repeated()
        times, d = _true_times(dual, repeated), len(asked.wanted)
        motion = shoot(dual, state, repeated.heights, repeated.contacts, times[-1].detach())
        arcs = [MovedArc.of_dual(arc, d) for arc in motion.arcs]
        moved = RepeatedMotion(arcs, len(asked.stretches), d, 1 if asked.model.measures_plainly else 3)
        return Sensitivity(*_measured(dual, moved, times, state))


def coefficients_of(
    model: BallModel, n: int, values: Mapping[str, float | Array], wanted: Sequence[_Direction] = ()
) -> Coefficients:
    """All coefficients of a model for each of n balls, and the direction of the nonzero tangent of each."""
    own = {name: p for name, p in model.named_parameters() if p.dim() == 0}
    known = {name: np.full(n, float(p.detach())) for name, p in own.items()}
    known |= {name: np.array(np.broadcast_to(value, n), dtype=np.float64) for name, value in values.items()}
    moving: dict[str, Array] = {}
    for block, direction in enumerate(wanted):
        if direction.name is not None:
            moving.setdefault(direction.name, np.zeros((n, len(wanted))))[:, block] = 1.0
    return Coefficients(known, moving)


def _measured(model: BallModel, motion: RepeatedMotion, times: Tensor, starts: Tensor) -> tuple[Array, Array]:
    """Derivatives (n, k, 3, d) of measured positions and (n, 3, d) of labels; all given as dual numbers."""
    if model.measures_plainly:
        positions = motion.states(times)[1].numpy()
    else:
        measured = model.measured(motion.dual_states(times), partial(_later, motion.dual_states, times))
        positions = _by_direction(_tangent(measured).transpose(0, 1), motion.directions)
    return positions, _by_direction(_tangent(model.labelled(starts[:, SPIN])), motion.directions)


def _by_direction(tangent: Tensor, directions: int) -> Array:
    """(n, ..., d) of (d n, ...)."""
    return np.moveaxis(tangent.numpy().reshape(directions, -1, *tangent.shape[1:]), 0, -1)


def _tangent(dual: Tensor) -> Tensor:
    tangent = forward.unpack_dual(dual).tangent
    return torch.zeros_like(dual) if tangent is None else tangent


def _true_times(model: BallModel, stretches: Stretches) -> Tensor:
    """(k, r) s of true time, of the samples."""
    # stamps run along the first axis: a coefficient of shape (r, 1) then fits (k, r, 1)
    return model.true_stamps(stretches.times.T.unsqueeze(-1)).squeeze(-1)


def _later(states: Callable[[Tensor], Tensor], times: Tensor, delay: Tensor | float) -> Tensor:
    shift = delay.squeeze(-1) if isinstance(delay, Tensor) and delay.dim() else delay
    return states(times + shift)
