"""Moves balls whose states are arrays: by machine code where a model has it, else by torch.

Estimators and predictions work on arrays alone, so that a ball with machine code needs no torch.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, plain
from ballfg.dynamics.compiled import motion
from ballfg.dynamics.motion import limits
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import VZ, Z

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel


class PreparedMotion:
    """The motion of balls in states (n, w), with what machine code needs looked up once; by torch where it has none.

    Args: model: the ball, with the coefficients that it has now.  width: w, 9 + p with those that travel.
    """

    def __init__(self, model: "BallModel", width: int) -> None:
        functions = motion.functions_of(model)
        self.model = model
        self._moving = None if functions is None else motion.Moving(model, functions, np.empty((0, width)), width)

    def fly(self, start: Array, dt: float) -> tuple[Array, Array]:
        """States (n, w) after dt s of free flight, and their Jacobians (n, w, w)."""
        start, durations = plain(start), np.full(len(start), dt)
        if self._moving is None:
            return fly_jacobian(self.model, start, durations)
        after, moved, _ = self._moving.at(start).travel(durations, motion.levels(len(start)))
        return after, moved

    def bounce(self, start: Array, dt: float, height: float) -> tuple[Array, Array, Array]:
        """States (n, w) after dt s with a contact with a surface (m) on the way, its times (n,) s, and the Jacobians.

        NaN for a ball that never comes down to it.
        """
        start, durations = plain(start), np.full(len(start), dt)
        if self._moving is None:
            after, times, moved = fly_through_jacobian(self.model, start, durations, (height,))
            return after, times[:, 0], moved
        after, moved, times = self._moving.at(start).travel(durations, motion.levels(len(start), (height,)))
        return after, times[:, 0], moved

    def gaps(self, states: Array, height: float) -> tuple[Array, Array]:
        """(n,) m from a surface (m) up to balls' lowest points, and the derivatives (n, w)."""
        if self._moving is None:
            return gap_jacobian(self.model, states, height)
        return self._moving.at(plain(states)).gaps(height)


def gaps(model: "BallModel", states: Array, height: Array | float) -> Array:
    """(n,) m from surfaces at a height (m) or heights (n,) up to the lowest points of balls in states (n, 9 + p)."""
    if (moving := _moving(model, states)) is not None:
        return moving.gaps(height)[0]
    found: Array = _by_torch(type(model).gap, model, states, height)
    return found


def surface_offsets(model: "BallModel", states: Array) -> Array:
    """(n,) m by which surfaces lie above their declared heights under balls in states (n, 9 + p)."""
    if (moving := _moving(model, states)) is not None:
        return moving.offsets()

    def offsets(ball: "BallModel", at: Any) -> Any:
        return ball.surface_offset(at) + at.new_zeros(len(at))

    found: Array = _by_torch(offsets, model, states)
    return found


def acceleration(model: "BallModel", states: Array) -> Array:
    """(n, 3) m/s^2 of balls in flight, in states (n, 9 + p)."""
    if (moving := _moving(model, states)) is not None:
        return moving.rates()[:, :3]
    found: Array = _by_torch(lambda ball, at: ball.rates(at)[0], model, states)
    return found


def bounced(model: "BallModel", states: Array) -> Array:
    """(n, 9 + p) states right after an impact."""
    if (moving := _moving(model, states)) is not None:
        return moving.after_bounce()
    found: Array = _by_torch(type(model).after_bounce, model, states)
    return found


def fly_through(model: "BallModel", states: Array, dt: Array, heights: Sequence[Array | float]) -> tuple[Array, Array]:
    """As `contact.fly_through`: states (n, 9 + p) after dt (n,) s, and the times (n, k) s of k contacts on the way."""
    if (moving := _moving(model, states)) is not None:
        after, _, times = moving.travel(plain(dt), motion.levels(len(states), heights))
        return after, times
    from ballfg.dynamics.motion.contact import fly_through as in_torch

    after, times = _by_torch(in_torch, model, states, dt, tuple(heights))
    return after, times


def roll_out(model: "BallModel", states: Array, steps: Array, surfaces: Surfaces) -> Array:
    """States (n, k, 9 + p) after durations (n, k) s one after another, through flight, contacts and rest."""
    if (moving := _moving(model, states)) is not None:
        return moving.roll_out(steps, motion.world_of(surfaces, model.radius))
    from ballfg.dynamics.motion.rollout import rollout as in_torch

    found: Array = _by_torch(in_torch, model, states, steps.cumsum(axis=1), surfaces)
    return found


def contact_times(model: "BallModel", states: Array, height: float) -> Array:
    """As `contact.contact_time`: (n,) s until balls in states (n, 9 + p) touch a surface (m); NaN without a contact."""
    if (moving := _moving(model, states)) is not None:
        return moving.meets(np.full(len(states), height), np.full(len(states), limits.LONGEST_FALL))
    from ballfg.dynamics.motion.contact import contact_time as in_torch

    found: Array = _by_torch(in_torch, model, states, height)
    return found


def is_resting(model: "BallModel", states: Array, height: Array | float) -> NDArray[np.bool_]:
    """As `rollout.is_resting`: which balls in states (n, 9 + p) lie on surfaces at a height (m) or heights (n,)."""
    lies = np.abs(gaps(model, states, height)) <= limits.REST_GAP
    return lies & (np.abs(states[:, VZ]) <= limits.REST_SPEED / 2)


def place_on(model: "BallModel", states: Array, height: Array | float) -> Array:
    """States (n, 9 + p) moved onto surfaces at a height (m) or heights (n,), their vertical velocity zero."""
    placed = states.copy()
    placed[:, Z] -= gaps(model, states, height)
    placed[:, VZ] = 0.0
    return placed


def motion_rates(model: "BallModel", states: Array, *, rolls: bool) -> Array:
    """(n, 9 + p) derivatives by time of states, in flight, or on a surface."""
    if (moving := _moving(model, states, states.shape[1])) is not None:
        return moving.slopes(states, motion.ROLLING if rolls else motion.RATES)[0]
    from ballfg.dynamics.motion.flight_step import derivative

    law = model.roll if rolls else model.rates
    found: Array = _by_torch(lambda _, at: derivative(law, at), model, states)
    return found


def fly(model: "BallModel", states: Array, dt: Array) -> Array:
    """States (n, 9 + p) after dt (n,) s of free flight."""
    return fly_through(model, states, dt, ())[0]


def gap_jacobian(model: "BallModel", states: Array, height: Array | float) -> tuple[Array, Array]:
    """Gaps (n,) m as `gaps`, and their derivatives (n, 9 + p)."""
    if (moving := _moving(model, states, states.shape[1])) is not None:
        return moving.gaps(height)
    from ballfg.dynamics.motion.contact import gap_jacobian as in_torch

    gap, slopes = _by_torch(in_torch, model, states, height)
    return gap, slopes


def fly_jacobian(model: "BallModel", states: Array, dt: Array) -> tuple[Array, Array]:
    """States (n, 9 + p) after dt (n,) s of free flight, and their derivatives (n, 9 + p, 9 + p)."""
    if (moving := _moving(model, states, states.shape[1])) is not None:
        after, jacobian, _ = moving.travel(plain(dt), motion.levels(len(states)))
        return after, jacobian
    from ballfg.dynamics.motion.integrate import fly_jacobian as in_torch

    after, jacobian = _by_torch(in_torch, model, states, dt)
    return after, jacobian


def fly_through_jacobian(
    model: "BallModel", states: Array, dt: Array, heights: Sequence[Array | float]
) -> tuple[Array, Array, Array]:
    """As `fly_through`, and the derivatives (n, 9 + p, 9 + p) of the states after it."""
    if (moving := _moving(model, states, states.shape[1])) is not None:
        after, jacobian, times = moving.travel(plain(dt), motion.levels(len(states), heights))
        return after, times, jacobian
    from ballfg.dynamics.motion.contact import fly_through_jacobian as in_torch

    after, times, jacobian = _by_torch(in_torch, model, states, dt, tuple(heights))
    return after, times, jacobian


def roll_jacobian(model: "BallModel", states: Array, dt: Array, height: Array) -> tuple[Array, Array]:
    """States (n, 9 + p) after dt (n,) s on surfaces at heights (n,) m, sliding, then rolling; and their derivatives."""
    if (moving := _moving(model, states, states.shape[1])) is not None:
        return moving.roll(plain(dt), plain(height))
    from ballfg.dynamics.motion.rollout import roll_jacobian as in_torch

    after, jacobian = _by_torch(in_torch, model, states, dt, height)
    return after, jacobian


@dataclass(frozen=True)
class Advance:
    """A motion over an interval."""

    after: Array  # (d,) the state at the end
    jacobian: Array  # (d, d) its derivative by the state at the start, at fixed duration
    contacts: tuple[tuple[float, float], ...]
    """Time since the start, s, and the surface's height, m, of each bounce; a final landing does not count."""


def advance_jacobian(model: "BallModel", state: Array, dt: float, surfaces: Surfaces) -> Advance:
    """`rollout.advance` of one state (d,) over dt s, with its Jacobian: flight, contacts, rest."""
    functions = motion.functions_for(model)
    moving = motion.Moving(model, functions, state[None], len(state))
    after, jacobian, contacts = moving.advance(
        min(dt, limits.LONGEST_MOTION), motion.world_of(surfaces, functions.radius)
    )
    motion.raise_errors()
    met = tuple((time, height) for time, height in contacts.tolist())
    return Advance(after[0], jacobian[0], met)


def _moving(model: "BallModel", states: Array, width: int = 0) -> motion.Moving | None:
    """Balls in states (n, 9 + p) for machine code, with derivatives by width numbers; None without machine code."""
    functions = motion.functions_of(model)
    return None if functions is None else motion.Moving(model, functions, states, width)


def _by_torch(function: Callable[..., Any], model: "BallModel", *given: Any) -> Any:
    """What a function of a model and tensors gives, in arrays."""
    import torch

    with torch.no_grad():
        found = function(model, *(_tensor(one) for one in given))
    return tuple(one.numpy() for one in found) if isinstance(found, tuple) else found.numpy()


def _tensor(given: Any) -> Any:
    """A tensor from an array, tensors from a tuple of arrays; a number stays."""
    import torch

    if isinstance(given, tuple):
        return tuple(_tensor(one) for one in given)
    return torch.from_numpy(plain(given)) if isinstance(given, np.ndarray) else given
