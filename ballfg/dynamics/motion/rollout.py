"""Moves balls through free flight, exact contacts, rest and rolling, with several contacts in one step.

These rules complete the physics:
- A bounce that would rise for less than `REST_SPEED` ends in rest: the ball stays on the surface and rolls. So does one
  that meets a surface more than `MAX_CONTACTS` times within one step. A resting ball whose lift exceeds its weight
  takes off again.
- A ball that starts a little below a surface (its centre above it) and moves down bounces at the moment at which it
  went through; one that moves up leaves. One that can no longer come up is put on the surface, at rest.
- Over more than `LONGEST_MOTION` the ball stays where it was by then.
- A ball whose centre starts below the table's surface is beside the table; the floor is what it falls on. One that
  starts below the lowest surface by more than `DEEPEST` falls on and on.
- Whether a ball meets the table is decided by its centre's place over it at the moment of contact; edges are not hit. A
  ball that rolls over an end falls from the moment at which its centre is `OVER_AN_END` beyond.
"""

import math

import torch
from torch import Tensor

from ballfg.dynamics.compiled import motion
from ballfg.dynamics.model import BallModel, take_rows
from ballfg.dynamics.motion import by_machine_code
from ballfg.dynamics.motion.contact import contact_time
from ballfg.dynamics.motion.flight_step import rk4_step
from ballfg.dynamics.motion.integrate import batch_jacobian, fly, followed
from ballfg.dynamics.motion.limits import (
    END_STEPS,
    LONGEST_MOTION,
    MAX_CONTACTS,
    MIN_SPEED,
    OVER_AN_END,
    REST_GAP,
    REST_SPEED,
    TIME_TOLERANCE,
    step_count,
)
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import VELOCITY, VZ, Z


def is_resting(model: BallModel, state: Tensor, height: Tensor | float) -> Tensor:
    """(...) bool: the ball lies on the surface at `height`."""
    return (model.gap(state, height).abs() <= REST_GAP) & (state[..., VZ].abs() <= REST_SPEED / 2)


def place_on(model: BallModel, state: Tensor, height: Tensor | float) -> Tensor:
    """The state moved onto a surface, its vertical velocity zero."""
    placed = state.clone()
    placed[..., Z] = state[..., Z] - model.gap(state, height)
    placed[..., VZ] = 0.0
    return placed


def roll(model: BallModel, state: Tensor, dt: Tensor, height: Tensor | float) -> Tensor:
    """The state after `dt` (...) s on the surface at `height` m: sliding until it rolls, then rolling."""
    if not followed(state, dt, height) and (functions := motion.functions_of(model)) is not None:
        return by_machine_code.roll(model, functions, state, dt, height)
    state = place_on(model, state, height)
    steps = step_count(dt)
    h = (dt / steps).unsqueeze(-1)
    for _ in range(steps):
        state = rk4_step(model.roll, state, h)
    return state


def roll_jacobian(model: BallModel, state: Tensor, dt: Tensor, height: Tensor | float) -> tuple[Tensor, Tensor]:
    """`roll` of states (n, 9) over dt (n,) s, and its derivative (n, 9, 9) by the state; both detached."""
    return batch_jacobian(lambda at: roll(model, at, dt, height), state)


def advance(model: BallModel, state: Tensor, dt: Tensor, surfaces: Surfaces) -> Tensor:
    """The state after `dt`, through all contacts on the way.

    Args: state: (n, 9).  dt: (n,) s, not negative.
    Returns: (n, 9), differentiable in the state and the parameters, through the contact times too.
    Raises: ValueError: if a dt is negative or not a number.
    """
    _check_durations(dt)
    moved = _by_machine_code(model, state, dt[:, None], surfaces)
    return _advance(model, state, dt, surfaces) if moved is None else moved[:, 0]


def _advance(model: BallModel, state: Tensor, dt: Tensor, surfaces: Surfaces) -> Tensor:
    """`advance` in torch's own operations."""
    dt = dt.clamp_max(LONGEST_MOTION)
    steps = step_count(dt)
    for _ in range(steps):
        state = _advance_step(model, state, dt / steps, surfaces)
    return state


def _check_durations(dt: Tensor) -> None:
    low, high = (float(dt.min()), float(dt.max())) if dt.numel() else (0.0, 0.0)
    if not (low >= 0 and high < math.inf):
        raise ValueError(f"dt must be finite and not negative; got {low:g} to {high:g} s. Sort the times.")


def _advance_step(model: BallModel, state: Tensor, h: Tensor, surfaces: Surfaces) -> Tensor:
    """One step of at most `MAX_STEP`."""
    height = surfaces.level_below(state.detach(), model.surface_offset(state.detach()))
    remaining = h
    done = state
    active = torch.arange(state.shape[0], device=state.device)
    for contacts in range(MAX_CONTACTS + 1):
        after = fly(model, state, remaining)
        resting = stays(model, state.detach(), height, surfaces)
        height, landing = next_surface(model, state.detach(), after.detach(), height, ~resting, surfaces)
        if bool(resting.any()):
            part = take_rows(model, resting, len(state))
            rolled = _roll_on(part, state[resting], remaining[resting], height[resting], surfaces)
            after = after.index_put((resting.nonzero()[:, 0],), rolled)
        done = done.index_put((active,), after) if len(active) < len(done) else after
        if not bool(landing.any()):
            break
        model, active, height = take_rows(model, landing, len(state)), active[landing], height[landing]
        state, remaining = _land(model, state[landing], remaining[landing], height, last=contacts == MAX_CONTACTS - 1)
    return done


def _roll_on(model: BallModel, state: Tensor, dt: Tensor, height: Tensor, surfaces: Surfaces) -> Tensor:
    """`roll` of at most one step on surfaces with ends: a ball that rolls over one falls."""
    rolled = roll(model, state, dt, height)
    over = (height == surfaces.table_height) & ~_carried(rolled.detach(), surfaces) & (dt.detach() > 0.0)
    if not bool(over.any()):
        return rolled
    part, state, dt, height = take_rows(model, over, len(state)), state[over], dt[over], height[over]
    tau, longest = dt.detach(), dt.detach()
    with torch.no_grad():
        for _ in range(END_STEPS):
            beyond, speed = _beyond_end(roll(part, state, tau, height), surfaces)
            before, tau = tau, (tau + (OVER_AN_END - beyond) / speed).clamp(torch.zeros_like(tau), longest)
            if float((tau - before).abs().max()) < TIME_TOLERANCE:
                break
    beyond, speed = _beyond_end(roll(part, state, tau, height), surfaces)
    tau = tau - (beyond - beyond.detach()) / speed.detach()  # the same time, with its derivatives
    fallen = fly(part, roll(part, state, tau, height), dt - tau)
    return rolled.index_put((over.nonzero()[:, 0],), fallen)


def _carried(state: Tensor, surfaces: Surfaces) -> Tensor:
    """(n,) bool: balls that lie on the table stay up."""
    if surfaces.extent is None:
        return torch.ones(len(state), dtype=torch.bool, device=state.device)
    return _beyond_end(state, surfaces)[0] <= OVER_AN_END


def _beyond_end(state: Tensor, surfaces: Surfaces) -> tuple[Tensor, Tensor]:
    """How far (n,) m balls (n, 9) are beyond the end of the table that they are farthest over, and their speed there.

    The speed, m/s outwards, is at least `MIN_SPEED`.
    """
    assert surfaces.extent is not None
    x_low, x_high, y_low, y_high = surfaces.extent
    x, y, _, vx, vy = state[..., : VELOCITY.start + 2].unbind(-1)
    beyond, end = torch.stack((x_low - x, x - x_high, y_low - y, y - y_high), dim=-1).max(dim=-1)
    speed = torch.stack((-vx, vx, -vy, vy), dim=-1).gather(-1, end.unsqueeze(-1))[..., 0]
    return beyond, speed.clamp_min(MIN_SPEED)


def stays(model: BallModel, state: Tensor, height: Tensor, surfaces: Surfaces) -> Tensor:
    """(n,) bool: the ball rests on the surface at `height`, and its weight keeps it there."""
    resting = is_resting(model, state, height)
    if bool(resting.any()):
        with torch.no_grad():
            resting &= model.rates(state)[0][..., Z] <= 0
        resting &= (height != surfaces.table_height) | _carried(state, surfaces)
    return resting


def next_surface(
    model: BallModel, state: Tensor, after: Tensor, height: Tensor, flying: Tensor, surfaces: Surfaces
) -> tuple[Tensor, Tensor]:
    """Heights (n,) m of the next surfaces and whether (n,) the flying balls come down on them within this step."""
    landing = flying & (model.gap(after, height) < 0) & (after[..., VZ] < 0)
    to_check = landing & (height == surfaces.table_height)
    if surfaces.extent is None or not bool(to_check.any()):
        return height, landing
    part = take_rows(model, to_check, len(state))
    with torch.no_grad():
        tau = contact_time(part, state[to_check], height[to_check])
        touch = fly(part, state[to_check], torch.nan_to_num(tau))
    beside = torch.zeros_like(landing)
    beside[to_check] = ~surfaces.over_table(touch)
    height = torch.where(beside, surfaces.lowest(), height)
    return height, landing & (model.gap(after, height) < 0)


def _land(model: BallModel, state: Tensor, remaining: Tensor, height: Tensor, *, last: bool) -> tuple[Tensor, Tensor]:
    """States right after the next contact and the remaining time; a bounce too small to rise ends in rest."""
    tau = contact_time(model, state, height)
    lost = tau.isnan()  # below the surface and never up again
    tau = torch.where(lost, torch.zeros_like(tau), tau)
    bounced = model.after_bounce(fly(model, state, tau))
    rest = (lost | (bounced[..., VZ] < REST_SPEED) | last).unsqueeze(-1)
    return torch.where(rest, place_on(model, bounced, height), bounced), remaining - tau


def rollout(model: BallModel, state: Tensor, times: Tensor, surfaces: Surfaces) -> Tensor:
    """The states at a sequence of times.

    Args:
        model: the ball.
        state: (n, 9) at time 0.
        times: (k,) or (n, k) s since then, not decreasing, not negative.
        surfaces: table and floor.
    Returns: (n, k, 9) states.
    Raises: ValueError: if the times are negative or decrease.
    """
    times = times.expand(state.shape[0], -1) if times.dim() == 1 else times
    steps = torch.diff(times, dim=-1, prepend=torch.zeros_like(times[:, :1]))
    if steps.numel() and not float(steps.min()) >= 0:
        raise ValueError("times must start at 0 or later and must not decrease. Sort them.")
    _check_durations(steps)
    moved = _by_machine_code(model, state, steps, surfaces)
    if moved is not None:
        return moved
    states = []
    for dt in steps.unbind(-1):
        state = _advance(model, state, dt, surfaces)
        states.append(state)
    return torch.stack(states, dim=1)


def _by_machine_code(model: BallModel, state: Tensor, steps: Tensor, surfaces: Surfaces) -> Tensor | None:
    """The states (n, k, 9) after each of the durations (n, k) s; None if torch must compute them."""
    if not steps.numel() or followed(state, steps):
        return None
    functions = motion.functions_of(model)
    return None if functions is None else by_machine_code.roll_out(model, functions, state, steps, surfaces)
