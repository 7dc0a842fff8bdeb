"""Answers torch's motions, where no derivatives are asked, by machine code."""

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.compiled import motion
from ballfg.dynamics.compiled.functions import CompiledModel
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces


def fly(model: BallModel, functions: CompiledModel, state: Tensor, dt: Tensor) -> Tensor:
    """As `integrate.fly`, without derivatives."""
    if state.dim() == 2 and dt.shape == state.shape[:1]:
        after, _, _ = motion.Moving(model, functions, _plain(state), 0).travel(_plain(dt), motion.levels(len(state)))
        return torch.from_numpy(after)
    shape = np.broadcast_shapes(state.shape[:-1], dt.shape)  # torch's own imports sympy, which takes a second
    rows = state.detach().expand(*shape, -1).reshape(-1, state.shape[-1])
    durations = _plain(dt.detach().expand(shape).reshape(-1))
    after, _, _ = motion.Moving(model, functions, _plain(rows), 0).travel(durations, motion.levels(len(rows)))
    return torch.from_numpy(after).reshape(*shape, state.shape[-1])


def contact_time(
    model: BallModel, functions: CompiledModel, state: Tensor, height: Tensor | float, longest: Tensor | float
) -> Tensor:
    """As `contact.contact_time`, without derivatives."""
    shape = state.shape[:-1]
    moving = motion.Moving(model, functions, _plain(state.detach().reshape(-1, state.shape[-1])), 0)
    return torch.from_numpy(moving.meets(*(_numbers(given, shape) for given in (height, longest)))).reshape(shape)


def roll(model: BallModel, functions: CompiledModel, state: Tensor, dt: Tensor, height: Tensor | float) -> Tensor:
    """As `rollout.roll`, without derivatives."""
    shape = np.broadcast_shapes(state.shape[:-1], dt.shape)
    rows = state.detach().expand(*shape, -1).reshape(-1, state.shape[-1])
    durations, levels = (_numbers(given, torch.Size(shape)) for given in (dt, height))
    after, _ = motion.Moving(model, functions, _plain(rows), 0).roll(durations, levels)
    return torch.from_numpy(after).reshape(*shape, state.shape[-1])


def roll_out(model: BallModel, functions: CompiledModel, state: Tensor, steps: Tensor, surfaces: Surfaces) -> Tensor:
    """Durations (n, k) s one after another, as in `rollout.rollout`: states (n, k, 9)."""
    moving = motion.Moving(model, functions, _plain(state), 0)
    return torch.from_numpy(moving.roll_out(_plain(steps), motion.world_of(surfaces, functions.radius)))


def _numbers(given: Tensor | float, shape: torch.Size) -> Array:
    """(n,) from a scalar or from one number per ball."""
    if isinstance(given, Tensor):
        return np.ascontiguousarray(given.detach().expand(shape).reshape(-1).numpy(), dtype=np.float64)
    return np.full(shape.numel(), given, dtype=np.float64)


def fly_jacobian(model: BallModel, functions: CompiledModel, state: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
    """As `integrate.fly_jacobian`."""
    shape, width = state.shape, state.shape[-1]
    rows, durations = (state, dt) if dt.dim() == 1 else (state.reshape(-1, width), dt.reshape(-1))
    moving = motion.Moving(model, functions, _plain(rows), width)
    after, jacobian, _ = moving.travel(_plain(durations), motion.levels(len(rows)))
    return torch.from_numpy(after.reshape(shape)), torch.from_numpy(jacobian.reshape(*shape, width))


def _plain(given: Tensor) -> Array:
    """Numbers for machine code: contiguous, in double precision."""
    return np.ascontiguousarray(given.detach().numpy(), dtype=np.float64)
