"""Motion with events of one ball, with its Jacobian: what a filter's prediction and a belief's propagation need."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from ballfg.dynamics.contact import contact_time, fly_through_jacobian
from ballfg.dynamics.integrate import batch_jacobian, fly_jacobian, step_count
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.rollout import MAX_CONTACTS, REST_SPEED, next_surface, place_on, roll, stays
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import VZ


@dataclass(frozen=True)
class Motion:
    """A motion over an interval.

    Attributes:
        after: (1, d) the state at the end.
        jacobian: (d, d) its derivative by the state at the start, at fixed duration.
        contacts: time since the start, s, and the surface's height, m, of each contact.
    """

    after: Tensor
    jacobian: Tensor
    contacts: tuple[tuple[float, float], ...]


@torch.no_grad()
def advance_jacobian(model: BallModel, state: Tensor, dt: float, surfaces: Surfaces) -> Motion:
    """`rollout.advance` of one state (1, d) over dt s, with its Jacobian: flight, contacts, rest."""
    steps = step_count(torch.tensor([dt]))
    jacobian = torch.eye(state.shape[-1], dtype=state.dtype)
    contacts: list[tuple[float, float]] = []
    for i in range(steps):
        part = _advance_step(model, state, dt / steps, surfaces)
        state, jacobian = part.after, part.jacobian @ jacobian
        contacts += [(i * dt / steps + time, height) for time, height in part.contacts]
    return Motion(state, jacobian, tuple(contacts))


def _advance_step(model: BallModel, state: Tensor, h: float, surfaces: Surfaces) -> Motion:
    """One step of at most `integrate.MAX_STEP`, cut at its contacts, by the rules of `rollout`."""
    height = surfaces.level_below(state)
    jacobian: Tensor | None = None
    contacts: list[tuple[float, float]] = []
    elapsed, resting = 0.0, _stays(model, state, height, surfaces)
    while True:
        after, step = (_rolled if resting else _flown)(model, state, h - elapsed, height)
        height, landing = next_surface(model, state, after, height, torch.tensor([not resting]), surfaces)
        if not bool(landing):
            return Motion(after, step if jacobian is None else step @ jacobian, tuple(contacts))
        state, step, tau = _bounced(model, state, height)
        jacobian = step if jacobian is None else step @ jacobian
        elapsed += tau
        contacts.append((elapsed, float(height)))
        resting = float(state[0, VZ]) < REST_SPEED or len(contacts) == MAX_CONTACTS


def _stays(model: BallModel, state: Tensor, height: Tensor, surfaces: Surfaces) -> bool:
    """`rollout.stays`; a look at the vertical speed spares most states the rest of it."""
    return abs(float(state[0, VZ])) <= REST_SPEED and bool(stays(model, state, height, surfaces))


def _flown(model: BallModel, state: Tensor, dt: float, height: Tensor) -> tuple[Tensor, Tensor]:
    after, jacobian = fly_jacobian(model, state, state.new_tensor([dt]))
    return after, jacobian[0]


def _rolled(model: BallModel, state: Tensor, dt: float, height: Tensor) -> tuple[Tensor, Tensor]:
    def motion(x: Tensor) -> Tensor:
        return roll(model, x, x.new_tensor([dt]), height)

    after, jacobian = batch_jacobian(motion, state)
    return after, jacobian[0]


def _bounced(model: BallModel, state: Tensor, height: Tensor) -> tuple[Tensor, Tensor, float]:
    """State just after the next contact, Jacobian at that fixed time, the time since the start, s.

    A ball below the surface that never comes up again (its contact time is NaN) is there already, with no speed left.
    """
    tau = contact_time(model, state, height)
    if bool(tau.isnan()):
        after, impact = batch_jacobian(model.bounce, state)
        return place_on(model, after, height), impact[0], 0.0
    after, _, jacobian = fly_through_jacobian(model, state, tau, (height,))
    return after, jacobian[0], float(tau)
