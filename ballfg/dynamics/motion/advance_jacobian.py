"""Moves one ball through events with its Jacobian, for a filter's prediction and a belief's propagation."""

from dataclasses import dataclass

import torch
from torch import Tensor

from ballfg.dynamics.compiled.in_torch import functions_for, raise_errors
from ballfg.dynamics.compiled.motion import Moving, world_of
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.limits import LONGEST_MOTION
from ballfg.dynamics.surfaces import Surfaces


@dataclass(frozen=True)
class Advance:
    """A motion over an interval."""

    after: Tensor  # (1, d) the state at the end
    jacobian: Tensor  # (d, d) its derivative by the state at the start, at fixed duration
    contacts: tuple[tuple[float, float], ...]
    """Time since the start, s, and the surface's height, m, of each bounce; a final landing does not count."""


def advance_jacobian(model: BallModel, state: Tensor, dt: float, surfaces: Surfaces) -> Advance:
    """`rollout.advance` of one state (1, d) over dt s, with its Jacobian: flight, contacts, rest."""
    functions = functions_for(model)
    moving = Moving(model, functions, state, state.shape[-1])
    after, jacobian, contacts = moving.advance(min(dt, LONGEST_MOTION), world_of(surfaces, functions.radius))
    raise_errors()
    met = tuple((time, height) for time, height in contacts.tolist())
    return Advance(torch.from_numpy(after), torch.from_numpy(jacobian[0]), met)
