"""Motion with events: free flight, contacts at their exact times, several in one step, rest and rolling.

What is defined where nature is not asked:
- A bounce that would rise for less than `REST_SPEED` ends in rest: the ball stays on the surface and rolls.
- A ball that starts a little below a surface (its centre above it) and moves down bounces at the moment at which it
  went through; one that moves up leaves. One that can no longer come up is put on the surface, at rest.
- A ball whose centre starts below the table's surface is beside the table; the floor is what it falls on.
"""

from __future__ import annotations

import torch
from torch import Tensor

from ballfg.dynamics.contact import contact_time
from ballfg.dynamics.integrate import MAX_STEP, RateFunction, fly, rk4_step, step_count
from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import VZ, Z

REST_SPEED = 0.05
"""m/s. A ball that leaves a surface more slowly would be back within 10 ms, 0.13 mm high: it rests."""
REST_GAP = 2e-4
"""m. A ball this close to a surface and slower than `REST_SPEED` rests on it."""
MAX_CONTACTS_PER_STEP = 8
"""In 20 ms a ball that leaves at `REST_SPEED` or faster bounces at most three times; more is an error."""


def is_resting(model: BallModel, state: Tensor, height: Tensor | float) -> Tensor:
    """(...) bool: the ball lies on the surface at `height`."""
    return (model.gap(state, height).abs() <= REST_GAP) & (state[..., VZ].abs() <= REST_SPEED)


def place_on(model: BallModel, state: Tensor, height: Tensor | float) -> Tensor:
    """The state moved onto a surface, its vertical velocity zero."""
    z = state[..., Z] - model.gap(state, height)
    parts = (
        state[..., :Z],
        z[..., None],
        state[..., Z + 1 : VZ],
        torch.zeros_like(z)[..., None],
        state[..., VZ + 1 :],
    )
    return torch.cat(parts, dim=-1)


def roll(model: BallModel, state: Tensor, dt: Tensor, height: Tensor | float) -> Tensor:
    """The state after `dt` (...) s of resting on the surface at `height` m: sliding until it rolls, then rolling."""
    state = place_on(model, state, height)
    steps = step_count(dt)
    h = (dt / steps).unsqueeze(-1)
    rates: RateFunction = model.roll
    for _ in range(steps):
        state = rk4_step(rates, state, h)
    return state


def advance(model: BallModel, state: Tensor, dt: Tensor, surfaces: Surfaces) -> Tensor:
    """The state after `dt`, through whatever contacts happen on the way.

    Args:
        model: the ball.
        state: (n, 9).
        dt: (n,) s, not negative.
        surfaces: table and floor.
    Returns: (n, 9), differentiable in the state and the parameters, through the contact times too.
    Raises: ValueError: if a dt is negative.
    """
    if bool((dt < 0).any()):
        raise ValueError(f"dt must not be negative; got {float(dt.min()):g} s. Sort the times.")
    steps = step_count(dt)
    for _ in range(steps):
        state = _advance_step(model, state, dt / steps, surfaces)
    return state


def _advance_step(model: BallModel, state: Tensor, h: Tensor, surfaces: Surfaces) -> Tensor:
    """One step of at most `MAX_STEP`."""
    assert float(h.max()) <= MAX_STEP * (1 + 1e-6)
    height = surfaces.height_below(state.detach())
    remaining = h
    done = state
    active = torch.arange(state.shape[0])
    for _ in range(MAX_CONTACTS_PER_STEP):
        after = fly(model, state, remaining)
        resting = is_resting(model, state.detach(), height)
        landing = ~resting & (model.gap(after.detach(), height) < 0) & (after[..., VZ].detach() < 0)
        landing &= _lands_on_table(model, state, height, surfaces, landing)
        if bool(resting.any()):
            rolled = roll(model, state[resting], remaining[resting], height[resting])
            after = after.index_put((resting.nonzero()[:, 0],), rolled)
        done = done.index_put((active,), after) if len(active) < len(done) else after
        if not bool(landing.any()):
            return done
        active, height = active[landing], height[landing]
        state, remaining = _land(model, state[landing], remaining[landing], height)
    raise RuntimeError(f"a ball met a surface more than {MAX_CONTACTS_PER_STEP} times in one step")


def _lands_on_table(model: BallModel, state: Tensor, height: Tensor, surfaces: Surfaces, landing: Tensor) -> Tensor:
    """(n,) bool: False for a ball that comes below the table's height outside the table's extent."""
    keep = torch.ones_like(landing)
    if surfaces.extent is None:
        return keep
    on_table = landing & (height == surfaces.table_height)
    if bool(on_table.any()):
        with torch.no_grad():
            tau = contact_time(model, state[on_table], height[on_table])
            touch = fly(model, state[on_table], torch.nan_to_num(tau))
        keep[on_table] = surfaces.over_table(touch)
    return keep


def _land(model: BallModel, state: Tensor, remaining: Tensor, height: Tensor) -> tuple[Tensor, Tensor]:
    """States just after the next contact and the time then left; a bounce too small to rise ends in rest."""
    tau = contact_time(model, state, height)
    lost = tau.isnan()  # below the surface and never up again
    tau = torch.where(lost, torch.zeros_like(tau), tau)
    bounced = model.bounce(fly(model, state, tau))
    rest = (lost | (bounced[..., VZ] < REST_SPEED)).unsqueeze(-1)
    return torch.where(rest, place_on(model, bounced, height), bounced), remaining - tau


def rollout(model: BallModel, state: Tensor, times: Tensor, surfaces: Surfaces) -> Tensor:
    """The states at a sequence of times.

    Args:
        model: the ball.
        state: (n, 9) at time 0.
        times: (k,) or (n, k) s since then, not decreasing, not negative.
        surfaces: table and floor.
    Returns: (n, k, 9).
    Raises: ValueError: if the times are negative or decrease.
    """
    times = times.expand(state.shape[0], -1) if times.dim() == 1 else times
    steps = torch.diff(times, dim=-1, prepend=torch.zeros_like(times[:, :1]))
    if bool((steps < 0).any()):
        raise ValueError("times must start at 0 or later and must not decrease. Sort them.")
    states = []
    for dt in steps.unbind(-1):
        state = advance(model, state, dt, surfaces)
        states.append(state)
    return torch.stack(states, dim=1)
