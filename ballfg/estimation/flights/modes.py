"""Moves hypotheses on the mode of a ball over a time step, and branches them where the mode may change."""

import math
from typing import Any, Final

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FLAG, NOTHING, REAL, several
from ballfg.estimation.segmentation.bank import FLYING, ONE_HYPOTHESIS, SCENE, Record
from ballfg.estimation.segmentation.surface_contact import carry, slack_spread, transform

HANDLED: Final = 1  # Value of `surface` for a ball that a hand moves quickly: throws, catches, pushes
CARRIED: Final = 2  # For a ball that a hand moves slowly
SWAYED: Final = 3  # For a ball in a hand that hardly moves
ROLLING: Final = 4  # For a ball that rolls at a constant height
STILL: Final = 5  # For a ball that does not move
MODES: Final = (FLYING, HANDLED, CARRIED, SWAYED, ROLLING, STILL)

BOUNCE: Final = 1  # Kind of an event: a flying ball bounces on something level
STRIKE: Final = 2  # A flying ball is hit, and flies on
CHANGE: Final = 3  # The mode changes
SHIFT: Final = 4  # The measurements of a flying ball jump, its velocity stays: the tracker follows something else

SHORT: Final = 0.02
"""Time constants up to which a series is exact to 2 % and better than differences of rounded numbers."""
PULLS: Final = (0.0, 30.0, 8.0, 1.0, 0.3, 0.0)
"""m/s^2. Spread of the acceleration, per axis, by mode: of a hand that throws or catches, of one that carries, of one
that holds the ball, of a rolling ball along the ground; none of a ball that does not move, `slack_spread` in
flight."""
MEMORIES: Final = (0.0, 0.08, 0.15, 0.3)  # s. Time constants of the accelerations of hands, by mode
STOPPING: Final = 120.0  # m/s^2. Spread of the acceleration at the start of a catch
HAND_SPEED: Final = 2.0  # m/s. Spread of the velocity of a hand, per axis
SLOPE: Final = 0.02
"""m/s. Spread of the vertical velocity of a rolling ball: the surface or the frame is not quite level."""
ROLLING_DRIFT: Final = 0.02  # m/s per sqrt(s). Random walk of its horizontal velocity
LANDING: Final = 0.3  # m/s. Spread of the vertical speed with which a ball begins to roll or stops
STIR: Final = 1e-3  # m per sqrt(s). Random walk of a ball that does not move

RESTITUTION: Final = 0.75  # Of a bounce of any ball on any surface
RESTITUTION_SIGMA: Final = 0.2
KEPT: Final = 0.9  # Share of the tangential velocity that a bounce leaves
SLIDE: Final = 0.4  # Spread of its change, as a share of the normal speed
BOUNCE_JITTER: Final = 0.1  # m/s
SLOWEST_FALL: Final = 0.3  # m/s. Slower balls are not tried with a bounce
STRIKE_SPEED: Final = 8.0  # m/s. Spread of the velocity after a strike, per axis


@machine_code(NOTHING(ONE_HYPOTHESIS, REAL, SCENE))
def move(h: Record, dt: float, scene: Record) -> None:
    """A hypothesis dt s later, in its mode."""
    if h.surface == FLYING:
        carry(h, dt, scene)
    elif HANDLED <= h.surface <= SWAYED:
        _wander(h, dt, PULLS[h.surface], MEMORIES[h.surface])
    elif h.surface == ROLLING:
        for axis in range(3):
            transform(h, axis, dt, 0.5 * dt * dt, 1.0, dt, 1.0)  # constant acceleration
        for axis in range(2):
            h.cov[axis, 1, 1] += ROLLING_DRIFT**2 * dt
        h.cov[2, 0, 0] += STIR**2 * dt
    else:
        for axis in range(3):
            h.cov[axis, 0, 0] += STIR**2 * dt


@machine_code(NOTHING(ONE_HYPOTHESIS, REAL, REAL, REAL))
def _wander(h: Record, t: float, spread: float, tau: float) -> None:
    """A hand for t s: its acceleration forgets itself with a time constant tau s and has a spread m/s^2."""
    memory = math.exp(-t / tau)
    gain = tau * (1.0 - memory)
    half = tau * (t - gain)
    pp, pv, pb, vv, vb, bb = _wandered(t / tau)
    scale = spread * spread
    for axis in range(3):
        transform(h, axis, t, half, 1.0, gain, memory)
        cov = h.cov[axis]
        cov[0, 0] += scale * tau**4 * pp
        cov[1, 1] += scale * tau**2 * vv
        cov[2, 2] += scale * bb
        for i, k, more in ((0, 1, tau**3 * pv), (0, 2, tau**2 * pb), (1, 2, tau * vb)):
            cov[i, k] += scale * more
            cov[k, i] += scale * more


@machine_code(several(REAL, 6)(REAL))
def _wandered(s: float) -> Any:
    """Covariance of position, velocity and acceleration after s time constants, of an acceleration of spread one.

    Source: R. A. Singer, Estimating optimal tracking filter performance for manned maneuvering targets, 1970, eq. 14.
    """
    if s < SHORT:  # the first terms of its series: a random walk of the acceleration
        return s**5 / 10.0, s**4 / 4.0, s**3 / 3.0, 2.0 * s**3 / 3.0, s * s, 2.0 * s
    e = math.exp(-s)
    return (
        1.0 - e * e + 2.0 * s + 2.0 * s**3 / 3.0 - 2.0 * s * s - 4.0 * s * e,
        (1.0 - e) ** 2 - 2.0 * s * (1.0 - e) + s * s,
        1.0 - e * e - 2.0 * s * e,
        4.0 * e - 3.0 - e * e + 2.0 * s,
        (1.0 - e) ** 2,
        1.0 - e * e,
    )


@machine_code(NOTHING(ONE_HYPOTHESIS, COUNT, COUNT, REAL, REAL))
def _forget(h: Record, axis: int, order: int, mean: float, spread: float) -> None:
    """Forgets the velocity (order 1, m/s) or the acceleration (order 2, m/s^2) of an axis: mean and spread."""
    h.mean[axis, order] = mean
    for k in range(3):
        h.cov[axis, order, k] = h.cov[axis, k, order] = 0.0
    h.cov[axis, order, order] = spread * spread


@machine_code(NOTHING(ONE_HYPOTHESIS, COUNT, SCENE))
def enter(h: Record, mode: int, scene: Record) -> None:
    """Changes the mode of a hypothesis; place and velocity stay, as far as the new mode has one."""
    before = h.surface
    h.surface = mode
    if not (HANDLED <= before <= SWAYED and HANDLED <= mode <= SWAYED):
        h.age = 0
    for axis in range(3):
        if mode == FLYING:
            _forget(h, axis, 2, 0.0, slack_spread(h, scene))
        elif mode <= SWAYED or (mode == ROLLING and axis < 2):
            _forget(h, axis, 2, 0.0, STOPPING if mode == HANDLED and before == FLYING else PULLS[mode])
        else:
            spread = LANDING * LANDING + h.cov[axis, 1, 1]
            h.score -= 0.5 * h.mean[axis, 1] ** 2 / spread
            _forget(h, axis, 1, 0.0, SLOPE if mode == ROLLING else 0.0)
            _forget(h, axis, 2, 0.0, 0.0)


@machine_code(NOTHING(ONE_HYPOTHESIS, REAL))
def stop(h: Record, dt: float) -> None:
    """A ball stops suddenly in a hand, at some time of the next interval of dt s."""
    for axis in range(3):
        h.cov[axis, 0, 0] += (h.mean[axis, 1] * dt) ** 2 / 3.0
        _forget(h, axis, 1, 0.0, HAND_SPEED)


@machine_code(NOTHING(ONE_HYPOTHESIS, REAL, SCENE))
def strike(h: Record, dt: float, scene: Record) -> None:
    """A ball is struck at some time of the next interval of dt s, and flies on."""
    h.surface, h.age = FLYING, 0
    reach = scene.hit_spread**2 + (STRIKE_SPEED * min(dt, scene.short_gap)) ** 2
    for axis in range(3):
        h.cov[axis, 0, 0] += reach
        _forget(h, axis, 1, 0.0, STRIKE_SPEED)
        _forget(h, axis, 2, 0.0, scene.slack)


@machine_code(NOTHING(ONE_HYPOTHESIS, SCENE))
def shift(h: Record, scene: Record) -> None:
    """The measurements jump by an unknown offset."""
    h.age = 0
    for axis in range(3):
        h.cov[axis, 0, 0] += scene.shift_spread**2


@machine_code(FLAG(ONE_HYPOTHESIS, REAL, SCENE))
def bounce(h: Record, dt: float, scene: Record) -> bool:
    """A falling ball bounces on something level, at some time of the next interval of dt s; False if it is too slow."""
    fall = -(h.mean[2, 1] - scene.gravity * 0.5 * dt)
    if fall < SLOWEST_FALL:
        return False
    h.age = 0
    # the place of the turn within the interval is uniform: the average path between no turn and one at its start
    turn = (1.0 + RESTITUTION) * fall
    up = RESTITUTION * fall
    h.mean[2, 0] -= 0.5 * turn * dt  # `move` adds the new velocity over all of the interval
    h.cov[2, 0, 0] += (turn * dt) ** 2 / 12.0 + scene.surface_sigma**2
    _forget(h, 2, 1, up, math.sqrt((RESTITUTION_SIGMA * fall) ** 2 + BOUNCE_JITTER**2 + h.cov[2, 1, 1]))
    for axis in range(2):
        h.mean[axis, 1] *= KEPT
        h.cov[axis, 1, 1] += (SLIDE * fall + BOUNCE_JITTER) ** 2
    for axis in range(3):
        h.cov[axis, 2, 2] += slack_spread(h, scene) ** 2
    return True
