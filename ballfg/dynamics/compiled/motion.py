"""Moves batches of balls through flight and contacts in machine code, with Jacobians."""

from __future__ import annotations

import copy
import threading
import weakref
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, Final

import numpy as np

from ballfg.arrays import Array, Index, plain
from ballfg.dynamics.compiled.contacts import coefficients_of, contact_times, travel
from ballfg.dynamics.compiled.ground import advance_one, roll_rows
from ballfg.dynamics.compiled.kept_model import CompiledModel, KeptModel, carried
from ballfg.dynamics.compiled.places import Numbers, numbers_of
from ballfg.dynamics.compiled.roll_out import roll_out as roll_out_rows
from ballfg.dynamics.motion.limits import MAX_CONTACTS, steps_over
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import POSITION, STATE_DIM, VELOCITY, Z

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

RATES, IMPACT, SURFACE, ROLLING = range(4)  # The places of a model's functions in `CompiledModel.parts`


class Moving:
    """Balls that machine code moves, with the derivatives of their states by the initial ones.

    Args:
        model: the ball; coefficients that travel with the states are columns of the states.  functions: of the model.
        start: (n, 9 + p), not changed.  width: d, 9 + p, or 0 for no derivatives.
    """

    def __init__(self, model: BallModel, functions: CompiledModel, start: Array, width: int) -> None:
        inner, names = carried(model)
        self.functions, self.start, self.width = functions, np.ascontiguousarray(start, dtype=np.float64), width
        *self.addresses, self._rolling = functions.addresses
        *self.weights, self._rolling_weights = functions.weights(inner)
        self._own, self._places = _present(inner, functions, names)

    def at(self, start: Array) -> Moving:
        """Other balls (n, 9 + p) of the model, with the coefficients that it had when these were made."""
        other = copy.copy(self)
        other.start = start
        return other

    def travel(self, dt: Array, levels: Array) -> tuple[Array, Array, Array]:
        """Where the balls are after dt (n,) s, with a contact at each surface on the way; their heights are (n, k) m.

        Returns: states (n, 9 + p), their derivatives (n, 9 + p, d) and the contact times (n, k) s; NaN after a contact
            that never comes.
        Raises: ValueError: if a duration is infinite.
        """
        start = self.start
        after, moved, times = np.empty_like(start), np.empty((*start.shape, self.width)), np.empty_like(levels)
        own, places = self._own[:ROLLING], self._places[:ROLLING]
        given = (*self.addresses, *own, *places, *self.weights, start, dt, levels)
        if not travel(*given, self.functions.radius, after, moved, times):
            raise ValueError("dt must be finite; got inf. Check the times.")
        return after, moved, times

    def meets(self, height: Array, longest: Array) -> Array:
        """(n,) s until the next contact with surfaces at some heights (n,) m; NaN if there is none."""
        rates, _, surface = self.addresses
        c, s = (self.coefficients(part)[0] for part in (RATES, SURFACE))
        w, _, ws = self.weights
        states, tau = np.ascontiguousarray(self.start[:, :STATE_DIM]), np.empty(len(self.start))
        contact_times(rates, surface, states, c, s, w, ws, height, longest, self.functions.radius, tau)
        return tau

    def gaps(self, height: Array | float) -> tuple[Array, Array]:
        """(n,) m from surfaces up to the balls' lowest points, and the derivatives (n, d). Args: height: m or (n,)."""
        offset, slopes = self._value(SURFACE)
        by_state = -slopes[:, 0]
        by_state[:, Z : Z + 1] += 1.0 if self.width else 0.0
        return self.start[:, Z] - height - offset[:, 0] - self.functions.radius, by_state

    def offsets(self) -> Array:
        """(n,) m by which surfaces lie above their declared heights under the balls."""
        return self._value(SURFACE)[0][:, 0]

    def rates(self) -> Array:
        """(n, 6) m/s^2 and rad/s^2 in flight at the start."""
        return self._value(RATES)[0]

    def slopes(self, states: Array, part: int = RATES) -> tuple[Array, Array]:
        """(n, 9 + p) derivatives by time in flight, or on a surface for `ROLLING`, and (n, 9 + p, d) by the states.

        Args: states: (n, 9 + p) other states of the same balls, d = 9 + p, with the coefficients of the start.
        """
        rates, by_state = self._value(part, states)
        slopes, jacobians = np.zeros_like(states), np.zeros((*states.shape, self.width))
        slopes[:, POSITION], slopes[:, VELOCITY.start : STATE_DIM] = states[:, VELOCITY], rates
        jacobians[:, POSITION, VELOCITY], jacobians[:, VELOCITY.start : STATE_DIM] = np.eye(3), by_state
        return slopes, jacobians

    def after_bounce(self) -> Array:
        """(n, 9 + p) states right after an impact."""
        after = self.start.copy()
        after[:, :STATE_DIM] = self._value(IMPACT)[0]
        return after

    def _value(self, part: int, states: Array | None = None) -> tuple[Array, Array]:
        """(n, m) of a function at the start, or at other states of the balls, and its derivatives (n, m, d)."""
        n, d, function = len(self.start), self.width, self.functions.parts[part]
        own, moved = self._states()
        at = own if states is None else np.ascontiguousarray(states[:, :STATE_DIM])
        value, slopes = np.zeros((n, function.size)), np.zeros((n, function.size, d))
        c, ct = self.coefficients(part)
        weights = self._rolling_weights if part == ROLLING else self.weights[part]
        function.compute(at, c, weights, moved, ct, value, slopes)
        return value, slopes

    def all_coefficients(self) -> list[Array]:
        """`coefficients` of rates, impact and surface, one behind another."""
        return [array for part in (RATES, IMPACT, SURFACE) for array in self.coefficients(part)]

    @property
    def laws(self) -> tuple[Any, ...]:
        """All laws of the balls for machine code: `signatures.GIVEN`, then `ROLLING`."""
        rolling = (self._rolling, *self.coefficients(ROLLING), self._rolling_weights)
        return (*self.addresses, *self.all_coefficients(), *self.weights, *rolling)

    def roll(self, dt: Array, level: Array) -> tuple[Array, Array]:
        """Where the balls are after rolling dt (n,) s at heights (n,) m, and the derivatives, as `travel` has them."""
        x, moved = self._states()
        roll_rows(*self.laws, dt, level, self.functions.radius, x, moved)
        return self._whole(x, moved)

    def roll_out(self, steps: Array, world: Array) -> Array:
        """States (n, k, 9 + p) after durations (n, k) s one after another, through flight, contacts and rest."""
        states, first = np.empty((*steps.shape, STATE_DIM)), np.ascontiguousarray(self.start[:, :STATE_DIM])
        roll_out_rows(*self.laws, first, plain(steps), world, states)
        coefficients = self.start[:, None, STATE_DIM:].repeat(steps.shape[1], axis=1)
        return np.concatenate((states, coefficients), axis=2) if coefficients.shape[2] else states

    def advance(self, dt: float, world: Array) -> tuple[Array, Array, Array]:
        """Where one ball is after dt s, the derivatives, and time (s) and height (m) of each bounce (k, 2) it made."""
        (x, moved), steps = self._states(), steps_over(dt)
        met = np.empty((2, steps * MAX_CONTACTS))
        count = advance_one(*self.laws, dt / steps, steps, world, x[0], moved[0], *met)
        return *self._whole(x, moved), met[:, :count].T

    def _states(self) -> tuple[Array, Array]:
        """Copies of the states (n, 9) without coefficients, and their derivatives (n, 9, d)."""
        moved = np.zeros((len(self.start), STATE_DIM, self.width))
        if self.width:
            moved[:, range(STATE_DIM), range(STATE_DIM)] = 1.0
        return self.start[:, :STATE_DIM].copy(), moved

    def _whole(self, x: Array, moved: Array) -> tuple[Array, Array]:
        """States (n, 9) and derivatives (n, 9, d) with the coefficients, which stay."""
        after, jacobian = self.start.copy(), np.zeros((*self.start.shape, self.width))
        after[:, :STATE_DIM], jacobian[:, :STATE_DIM] = x, moved
        jacobian[:, range(STATE_DIM, self.width), range(STATE_DIM, self.width)] = 1.0
        return after, jacobian

    def coefficients(self, part: int) -> tuple[Array, Array]:
        """(n, p) coefficients of a function for each ball, and their tangents (n, p, d)."""
        c, ct = coefficients_of(self._own[part], self._places[part], self.start, self.width)
        return c, ct


_Places = dict[tuple[str, ...], tuple[Index, ...]]
_Present = tuple[CompiledModel, Numbers, list[float], tuple[Array, ...], _Places]
"""Functions of a model; its numbers, and their values; these as `_present` gives them, and their places by the names
of the coefficients that travel."""
_known: weakref.WeakKeyDictionary[BallModel, _Present] = weakref.WeakKeyDictionary()


def _present(
    model: BallModel, functions: CompiledModel, travelling: tuple[str, ...]
) -> tuple[tuple[Array, ...], tuple[Index, ...]]:
    """(p,) the present coefficients of each function of a model, and (p,) where they travel, for machine code.

    Args: model: without substituted parameters.  functions: of it.  travelling: names behind the states.
    """
    numbers = numbers_of(model)
    values, known = numbers.values(), _known.get(model)
    if known is None or known[0] is not functions or known[1] is not numbers or known[2] != values:
        named = dict(zip(numbers.scalars, values, strict=True))
        own = tuple(np.array([named[name] for name in part.names]) for part in functions.parts)
        known = _known[model] = (functions, numbers, values, own, {})
    places = known[4].get(travelling)
    if places is None:
        places = known[4][travelling] = tuple(_places(part.names, travelling) for part in functions.parts)
    return known[3], places


def _places(names: tuple[str, ...], travelling: tuple[str, ...]) -> Index:
    """(p,) the columns behind the states in which coefficients travel; -1 for the others."""
    return np.array([STATE_DIM + travelling.index(n) if n in travelling else -1 for n in names], dtype=np.int64)


def functions_of(model: BallModel) -> CompiledModel | None:
    """The functions of a model, also for coefficients that travel with the state.

    A subclass of `AugmentedModel` may compute anything, or draw random numbers: torch evaluates it, and coefficients
    by which machine code has no derivatives.
    """
    inner, names = carried(model)
    if inner is not model and type(model) is not KeptModel:
        from ballfg.dynamics.augmented import AugmentedModel

        if type(model) is not AugmentedModel or not numbers_of(inner).scalars.keys() >= set(names):
            return None
    return compiled(inner)


def compiled(model: BallModel) -> CompiledModel | None:
    """The functions of a model whose coefficients do not travel, as `functions.compiled` has them."""
    if type(model) is KeptModel and "whole" not in vars(model):
        return model.functions
    from ballfg.dynamics.compiled.functions import compiled as made

    return made(model)


def world_of(surfaces: Surfaces, radius: float) -> Array:
    """(11,) m: heights of table and floor, radius, the table's ends, their standard deviations, for machine code."""
    ends = surfaces.extent or (-np.inf, np.inf, -np.inf, np.inf)
    return np.array([surfaces.table_height, surfaces.lowest(), radius, *ends, *surfaces.edge_sigmas])


def levels(count: int, heights: Sequence[Array | float] = ()) -> Array:
    """(n, k) m from k heights of surfaces, each in m or (n,), for n states."""
    found = np.empty((count, len(heights)))
    for k, height in enumerate(heights):
        found[:, k] = height
    return found


def functions_for(model: BallModel) -> CompiledModel:
    """The functions of a model, whose coefficients may travel: machine code where there is any, else torch."""
    inner, _ = carried(model)
    if (functions := compiled(inner)) is not None:
        return functions
    from ballfg.dynamics.compiled.in_torch import in_torch

    return in_torch(inner)


class _Failed(threading.local):
    """Errors that the machine code of this thread has met."""

    def __init__(self) -> None:
        self.errors: list[Exception] = []


FAILED: Final = _Failed()


def raise_errors() -> None:
    """Raises the error that torch raised while machine code was running."""
    if FAILED.errors:
        first = FAILED.errors[0]
        FAILED.errors.clear()
        raise first
