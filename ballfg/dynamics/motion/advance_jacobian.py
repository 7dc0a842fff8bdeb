"""Moves one ball through events with its Jacobian, for a filter's prediction and a belief's propagation."""

from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.contact import contact_time, fly_through_jacobian
from ballfg.dynamics.motion.integrate import batch_jacobian, fly_jacobian
from ballfg.dynamics.motion.limits import LONGEST_MOTION, MAX_CONTACTS, REST_SPEED, step_count
from ballfg.dynamics.motion.rollout import advance, next_surface, roll, stays
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import VZ


@dataclass(frozen=True)
class Advance:
    """A motion over an interval."""

    after: Tensor  # (1, d) the state at the end
    jacobian: Tensor  # (d, d) its derivative by the state at the start, at fixed duration
    contacts: tuple[tuple[float, float], ...]
    """Time since the start, s, and the surface's height, m, of each bounce; a final landing does not count."""


@torch.no_grad()
def advance_jacobian(model: BallModel, state: Tensor, dt: float, surfaces: Surfaces) -> Advance:
    """`rollout.advance` of one state (1, d) over dt s, with its Jacobian: flight, contacts, rest."""
    dt = min(dt, LONGEST_MOTION)
    steps = step_count(torch.tensor([dt]))
    jacobian = torch.eye(state.shape[-1], dtype=state.dtype)
    contacts: list[tuple[float, float]] = []
    for i in range(steps):
        part = _advance_step(model, state, dt / steps, surfaces)
        state, jacobian = part.after, part.jacobian @ jacobian
        contacts += [(i * dt / steps + time, height) for time, height in part.contacts]
    return Advance(state, jacobian, tuple(contacts))


def _advance_step(model: BallModel, start: Tensor, h: float, surfaces: Surfaces) -> Advance:
    """One step of at most `integrate.MAX_STEP`, cut at its contacts, by the rules of `rollout`."""
    state, height = start, surfaces.level_below(start, model.surface_offset(start))
    # a check of the vertical speed first: most states need no more
    if abs(float(state[0, VZ])) <= REST_SPEED and bool(stays(model, state, height, surfaces)):
        after, jacobian = batch_jacobian(lambda at: roll(model, at, at.new_tensor([h]), height), state)
        return Advance(after, jacobian[0], ())
    so_far = torch.eye(state.shape[-1], dtype=state.dtype)
    contacts: list[tuple[float, float]] = []
    elapsed, flying = 0.0, torch.ones(1, dtype=torch.bool)
    while True:
        after, jacobian = fly_jacobian(model, state, state.new_tensor([h - elapsed]))
        height, landing = next_surface(model, state, after, height, flying, surfaces)
        if not bool(landing):
            return Advance(after, jacobian[0] @ so_far, tuple(contacts))
        tau = contact_time(model, state, height)
        rises = not bool(tau.isnan())  # NaN: below the surface and never up again
        if rises:
            state, _, jacobian = fly_through_jacobian(model, state, tau, (height,))
            rises = float(state[0, VZ]) >= REST_SPEED
        if not rises or len(contacts) + 1 == MAX_CONTACTS:
            after, jacobian = batch_jacobian(partial(_advanced, model, h, surfaces), start)
            return Advance(after, jacobian[0], tuple(contacts))
        so_far = jacobian[0] @ so_far
        elapsed += float(tau)
        contacts.append((elapsed, float(height)))


def _advanced(model: BallModel, h: float, surfaces: Surfaces, state: Tensor) -> Tensor:
    """`advance` on a batch with further leading dimensions, by plain autograd: balls rarely come to rest."""
    flat = state.reshape(-1, state.shape[-1])
    return advance(model, flat, torch.full_like(flat[:, 0], h), surfaces).reshape(state.shape)
