"""Moves batches of balls through flight and contacts in machine code, with Jacobians."""

from collections.abc import Sequence

import numpy as np
import torch
from torch import Tensor

from ballfg.arrays import Array
from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.compiled.contacts import contact_times, contacts
from ballfg.dynamics.compiled.flight import fly_together
from ballfg.dynamics.compiled.functions import CompiledModel, Function, compiled
from ballfg.dynamics.compiled.places import numbers_of
from ballfg.dynamics.compiled.roll_out import roll_out as roll_out_rows
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.motion.limits import BEYOND, step_count
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import STATE_DIM, Z


class Moving:
    """Balls that machine code moves, with the derivatives of their states by the initial ones.

    Args:
        model: the ball; coefficients that travel with the states are columns of the states.  functions: of the model.
        states: (n, 9 + p).  width: d, 9 + p, or 0 for no derivatives.

    Attributes:
        states: (n, 9) where the balls are.  moved: (n, 9, d) derivatives by the initial states.
        elapsed, slower: (n,) s so far, and (n, d) its derivatives: contacts come sooner or later.
    """

    def __init__(self, model: BallModel, functions: CompiledModel, states: Tensor, width: int) -> None:
        n = len(states)
        names = model.names if isinstance(model, AugmentedModel) else ()
        inner = model.model if isinstance(model, AugmentedModel) else model
        self.weights = functions.weights(inner)
        self.functions, self.travelling = functions, states.numpy()[:, STATE_DIM:]
        self.computes = (functions.rates.compute, functions.impact.compute, functions.surface.compute)
        self.states = np.array(states.numpy()[:, :STATE_DIM], order="C")  # moved in place
        self.moved = np.zeros((n, STATE_DIM, width))
        own = range(min(STATE_DIM, width))
        self.moved[:, own, own] = 1.0
        self.elapsed, self.slower = np.zeros(n), np.zeros((n, width))
        self._places = {name: k for k, name in enumerate(names)}
        self._numbers = numbers_of(inner)
        self._known: dict[tuple[str, ...], tuple[Array, Array]] = {}

    def fly(self, dt: Array) -> None:
        """Moves on by dt (n,) s, less the elapsed time."""
        left, earlier = np.ascontiguousarray(dt - self.elapsed), -self.slower
        steps = step_count(left)
        rates = self.functions.rates
        given = (self.states, self.moved, *self.coefficients(rates), self.weights[0], left, earlier, steps)
        fly_together(rates.compute, *given)

    def bounce(self, height: Array, longest: Array) -> None:
        """Moves on through the next contact with surfaces at some heights (n,) m; NaN if there is none."""
        n, _, width = self.moved.shape
        tau, slower = np.empty(n), np.empty((n, width))
        after, moved = np.empty_like(self.states), np.empty_like(self.moved)
        given = (*self.computes, self.states, self.moved, *self.all_coefficients(), *self.weights)
        contacts(*given, height, longest, self.functions.radius, tau, slower, after, moved)
        self.states, self.moved = after, moved
        self.elapsed, self.slower = self.elapsed + tau, self.slower + slower

    def meets(self, height: Array, longest: Array) -> Array:
        """(n,) s until the next contact with surfaces at some heights (n,) m; NaN if there is none."""
        rates, surface, tau = self.functions.rates, self.functions.surface, np.empty(len(self.states))
        c, s = (self.coefficients(function)[0] for function in (rates, surface))
        w, _, ws = self.weights
        radius = self.functions.radius
        contact_times(rates.compute, surface.compute, self.states, c, s, w, ws, height, longest, radius, tau)
        return tau

    def gaps(self, height: float) -> tuple[Array, Array]:
        """(n,) m from a surface up to the balls' lowest points, and the derivatives (n, d)."""
        n, _, width = self.moved.shape
        surface, offset, moved = self.functions.surface, np.zeros((n, 3)), np.zeros((n, 3, width))
        values, tangents = self.coefficients(surface)
        surface.compute(self.states, values, self.weights[2], self.moved, tangents, offset, moved)
        gap = self.states[:, Z] - height - offset[:, 0] - self.functions.radius
        return gap, self.moved[:, Z] - moved[:, 0]

    def whole(self) -> Tensor:
        """(n, 9 + p) states with their coefficients."""
        return torch.from_numpy(np.concatenate((self.states, self.travelling), axis=1))

    def results(self) -> tuple[Tensor, Tensor]:
        """States (n, 9 + p) and Jacobians (n, 9 + p, 9 + p)."""
        n, _, width = self.moved.shape
        jacobian = np.zeros((n, width, width))
        jacobian[:, :STATE_DIM] = self.moved
        own = np.arange(STATE_DIM, width)
        jacobian[:, own, own] = 1.0
        return self.whole(), torch.from_numpy(jacobian)

    def all_coefficients(self) -> list[Array]:
        """`coefficients` of rates, impact and surface, one behind another."""
        parts = (self.functions.rates, self.functions.impact, self.functions.surface)
        return [array for part in parts for array in self.coefficients(part)]

    def coefficients(self, function: Function) -> tuple[Array, Array]:
        """(n, p) coefficients of a function for each ball, and their tangents (n, p, d)."""
        if function.names not in self._known:
            n, _, width = self.moved.shape
            values, moved = np.empty((n, len(function.names))), np.zeros((n, len(function.names), width))
            for place, name in enumerate(function.names):
                if name in self._places:
                    values[:, place] = self.travelling[:, self._places[name]]
                    if width:
                        moved[:, place, STATE_DIM + self._places[name]] = 1.0
                else:
                    values[:, place] = self._numbers.value(name)
            self._known[function.names] = values, moved
        return self._known[function.names]


def functions_of(model: BallModel) -> CompiledModel | None:
    """The functions of a model, also for coefficients that travel with the state.

    A subclass of `AugmentedModel` may compute anything, or draw random numbers: torch evaluates it.
    """
    if isinstance(model, AugmentedModel):
        return compiled(model.model) if type(model) is AugmentedModel else None
    return compiled(model)


def fly(model: BallModel, functions: CompiledModel, state: Tensor, dt: Tensor) -> Tensor:
    """As `integrate.fly`, without derivatives."""
    shape = np.broadcast_shapes(state.shape[:-1], dt.shape)  # torch's own imports sympy, which takes a second
    rows = state.detach().expand(*shape, -1).reshape(-1, state.shape[-1])
    moving = Moving(model, functions, rows, 0)
    moving.fly(dt.detach().expand(shape).reshape(-1).numpy())
    return moving.whole().reshape(*shape, state.shape[-1])


def contact_time(
    model: BallModel, functions: CompiledModel, state: Tensor, height: Tensor | float, longest: Tensor | float
) -> Tensor:
    """As `contact.contact_time`, without derivatives."""
    shape = state.shape[:-1]
    moving = Moving(model, functions, state.detach().reshape(-1, state.shape[-1]), 0)
    return torch.from_numpy(moving.meets(*(_numbers(given, shape) for given in (height, longest)))).reshape(shape)


def roll_out(
    model: BallModel, functions: CompiledModel, state: Tensor, steps: Tensor, surfaces: Surfaces
) -> tuple[Tensor, Tensor]:
    """Durations (n, k) s one after another, as in `rollout.rollout`: states (n, k, 9) and how many are valid (n,).

    A ball that rests, or may come to rest, stays where that duration began.
    """
    n, width = state.shape
    moving = Moving(model, functions, state.detach(), 0)
    states, reached = np.empty((n, steps.shape[1], STATE_DIM)), np.empty(n, dtype=np.int64)
    durations, world = np.ascontiguousarray(steps.detach().numpy()), world_of(surfaces, functions.radius)
    given = (*moving.computes, *moving.all_coefficients(), *moving.weights)
    roll_out_rows(*given, moving.states, durations, world, states, reached)
    travelling = np.broadcast_to(moving.travelling[:, None], (n, steps.shape[1], width - STATE_DIM))
    return torch.from_numpy(np.concatenate((states, travelling), axis=2)), torch.from_numpy(reached)


def world_of(surfaces: Surfaces, radius: float) -> Array:
    """(11,) m: heights of table and floor, radius, the table's ends, their standard deviations, for machine code."""
    ends = surfaces.extent or (-np.inf, np.inf, -np.inf, np.inf)
    return np.array([surfaces.table_height, surfaces.lowest(), radius, *ends, *surfaces.edge_sigmas])


def _numbers(given: Tensor | float, shape: torch.Size) -> Array:
    """(n,) from a scalar or from one number per ball."""
    if isinstance(given, Tensor):
        return np.ascontiguousarray(given.detach().expand(shape).reshape(-1).numpy(), dtype=np.float64)
    return np.full(shape.numel(), given, dtype=np.float64)


def fly_jacobian(model: BallModel, functions: CompiledModel, state: Tensor, dt: Tensor) -> tuple[Tensor, Tensor]:
    """As `integrate.fly_jacobian`."""
    width = state.shape[-1]
    moving = Moving(model, functions, state.detach().reshape(-1, width), width)
    moving.fly(dt.detach().reshape(-1).numpy())
    after, jacobian = moving.results()
    return after.reshape(state.shape), jacobian.reshape(*state.shape, width)


def fly_through(
    model: BallModel, functions: CompiledModel, state: Tensor, dt: Tensor, heights: Sequence[Tensor | float]
) -> tuple[Tensor, Tensor]:
    """As `contact.fly_through`, without derivatives."""
    moving = Moving(model, functions, state.detach(), 0)
    times = _through(moving, dt, heights)
    return moving.whole(), times


def fly_through_jacobian(
    model: BallModel, functions: CompiledModel, state: Tensor, dt: Tensor, heights: Sequence[Tensor | float]
) -> tuple[Tensor, Tensor, Tensor]:
    """As `contact.fly_through_jacobian`."""
    moving = Moving(model, functions, state.detach(), state.shape[-1])
    times = _through(moving, dt, heights)
    after, jacobian = moving.results()
    return after, times, jacobian


def _through(moving: Moving, dt: Tensor, heights: Sequence[Tensor | float]) -> Tensor:
    """Moves balls by dt (n,) s with a contact at each height on the way; returns the contact times (n, k) s."""
    whole, times = np.ascontiguousarray(dt.detach().numpy()), []
    for height in heights:
        moving.bounce(np.full(whole.shape, height, dtype=np.float64), np.abs(whole) + BEYOND)
        times.append(torch.from_numpy(moving.elapsed))
    moving.fly(whole)
    return torch.stack(times, dim=-1) if times else dt.new_zeros((*dt.shape, 0))
