"""Finds an event on the way of one ball in machine code: a contact, or a linear function that falls to zero."""

import math

import numpy as np

from ballfg.dynamics.compiled.beliefs.carry import bounce, fly_belief, roll_off
from ballfg.dynamics.compiled.beliefs.edges import (
    come_down,
    falls_past,
    gap_of,
    level_below,
    over_table,
    stays,
    time_to_end,
)
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import fly_one, glide, law_at, laws_of, put, put_all, value_of
from ballfg.dynamics.compiled.signatures import (
    COUNT,
    FLAG,
    GIVEN,
    LAW,
    LAWS,
    NOTHING,
    ONE,
    REAL,
    ROLLING,
    THREE,
    TWO,
    several,
)
from ballfg.dynamics.motion.limits import MAX_STEP

LOOKS = 16  # Number of looks in a step of `MAX_STEP`: two crossings within 1.25 ms may pass unseen
NEWTON_STEPS = 20  # Largest number of steps to a crossing; three or four are enough
TIME_TOLERANCE = 1e-12  # s. Accuracy of the time of a crossing
INSTANT = 1e-9  # s, within which a ball that has already touched a surface bounces
NONE, FOUND, HARD = 0.0, 1.0, 2.0
"""Ends of a search: nothing within the horizon; the event; a step other than flight, rest or a plain bounce."""


@machine_code(NOTHING(LAW, LAW, FLAG, ONE, ONE))
def _rates_at(rates, rolling, resting, x, rate):
    """The rate of change (9,) of a state (9,) in flight or at rest."""
    if resting:
        value_of(rolling, x, rate[3:])
    else:
        value_of(rates, x, rate[3:])
    put(rate[:3], x[3:6])


@machine_code(several(REAL, 2)(LAW, LAW, FLAG, ONE, ONE, REAL))
def _value(rates, rolling, resting, x, normal, offset):
    """Normal . x - offset at a state (9,), and its time derivative."""
    change, value, rate = np.empty(9), -offset, 0.0
    _rates_at(rates, rolling, resting, x, change)
    for i in range(9):
        value += normal[i] * x[i]
        rate += normal[i] * change[i]
    return value, rate


@machine_code(NOTHING(LAW, LAW, FLAG, ONE, REAL))
def _move_on(rates, rolling, resting, x, h):
    """Moves a state (9,) on by h s of flight or of rest."""
    if resting:  # with tangents, though unused: exported C is shorter with one form
        d = rolling.ct.shape[2]
        fly_one(rolling, x, np.zeros((9, d)), h, np.zeros(d), 1)
    else:
        glide(rates, x, h, 1)


@machine_code(REAL(LAW, LAW, FLAG, ONE, ONE, REAL, REAL, REAL))
def _exact(rates, rolling, resting, x, normal, offset, low, high):
    """The time (s) between two others at which the value is zero on the way from x; NaN where Newton leaves them."""
    at, tau, margin = np.empty(9), 0.5 * (low + high), 0.5 * (high - low)
    for _ in range(NEWTON_STEPS):
        put(at, x)
        _move_on(rates, rolling, resting, at, tau)
        value, rate = _value(rates, rolling, resting, at, normal, offset)
        move = -value / rate
        tau += move
        if not low - margin <= tau <= high + margin:
            return np.nan
        if abs(move) < TIME_TOLERANCE:
            return tau
    return tau if abs(move) < 1e3 * TIME_TOLERANCE else np.nan


@machine_code(REAL(LAW, LAW, FLAG, ONE, ONE, REAL, ONE, REAL, REAL, REAL, FLAG))
def _zero(rates, rolling, resting, x, flown, duration, normal, offset, h, earliest, either_way):
    """The first time after `earliest` in h s, of free flight or of rest, at which the value goes through zero, or NaN.

    Looks are at the cubic through the values and their rates at both ends, which is right to a micrometre.

    Args: x (9,): the state at the beginning.  flown (9,): that after a duration (s) of flight, which h often is.
    """
    end = flown.copy()
    if resting or h < duration:
        put(end, x)
        _move_on(rates, rolling, resting, end, h)
    low, low_rate = _value(rates, rolling, resting, x, normal, offset)
    high, high_rate = _value(rates, rolling, resting, end, normal, offset)
    before = low
    for look in range(1, LOOKS + 1):
        t = look / LOOKS
        bend = (1.0 - t) * (low_rate * h - (high - low)) - t * (high_rate * h - (high - low))
        value = low + t * (high - low) + t * (1.0 - t) * bend
        if (before > 0.0 and value <= 0.0) or (either_way and before < 0.0 and value >= 0.0):
            tau = _exact(rates, rolling, resting, x, normal, offset, (look - 1) * h / LOOKS, look * h / LOOKS)
            if tau > earliest:
                return tau
        before = value
    return np.nan


@machine_code(REAL(LAW, LAW, FLAG, ONE, ONE, REAL, REAL, REAL, REAL, ONE, REAL, FLAG, ONE), makes_arrays=False)
def _first_zero(rates, rolling, resting, x, flown, duration, h, rolls, earliest, normal, offset, either_way, at):
    """`_zero` of a ball that flies for h s, or that rolls and then may fall over an end of the table.

    Args: duration: s, of `flown`.  rolls: s, for which it rolls.  earliest: s, from which events count.
    Writes: to at (9,).
    """
    until = min(h, rolls)
    event = _zero(rates, rolling, resting, x, flown, duration, normal, offset, until, earliest, either_way)
    if until < h and not math.isfinite(event):
        put(at, x)
        _move_on(rates, rolling, resting, at, until)
        left, since = h - until, earliest - until
        event = until + _zero(rates, rolling, False, at, at, np.inf, normal, offset, left, since, either_way)
    return event


@machine_code(several(REAL, 3)(LAWS, REAL, ONE, ONE, REAL, ONE, ONE), makes_arrays=False)
def _contact_within(laws, low, x, after, h, world, touch):
    """The level (m) that a ball (9,) comes down on within h s and when; h if it does not, NaN if that is unclear.

    It is unclear if the ball falls past the table to the floor within the step. The third number is the time at which
    it falls past the table, else NaN; writes its state there to touch (9,).

    Args: after (9,): the state after h s without surfaces.
    """
    if after[5] >= 0.0 or gap_of(laws.surface, after, low, world[2]) >= 0.0:
        return np.nan, h, np.nan
    tau = come_down(laws, x, low, world, touch)
    if low == world[0] and not over_table(touch, world):
        if gap_of(laws.surface, after, world[1], world[2]) >= 0.0:
            return np.nan, h, tau
        return world[1], np.nan, tau
    return low, tau, np.nan


@machine_code(several(REAL, 4)(LAWS, LAW, ONE, TWO, REAL, ONE, ONE, ONE, TWO, ONE))
def _go(laws, grounded, mean, covariance, h, world, noise, after, spread, touch):
    """The level, the two times of `_contact_within` a ball in flight, and NaN; of one at rest how long (s) it rolls.

    Writes: the belief after h s of flight; if the ball is at rest, it is placed on its surface instead.
    """
    x = mean[:9]
    low = level_below(laws.surface, x, world)
    if stays(laws.rates, laws.surface, x, low, world):
        x[2] -= gap_of(laws.surface, x, low, world[2])
        x[5] = 0.0
        return low, h, np.nan, time_to_end(grounded, x, h, world) if low == world[0] else h
    fly_belief(laws.rates, mean, covariance, h, noise, after, spread)  # nearly always the whole step
    low, tau, past = _contact_within(laws, low, x, after[:9], h, world, touch)
    return low, tau, past, np.nan


@machine_code(FLAG(ONE, TWO, THREE, COUNT, REAL, ONE, TWO))
def _take_step(ends, means, spreads, step, until, after, spread):
    """Whether the flight up to a time (s) is known as a step of `find`; writes the belief then if it is."""
    if step >= len(ends) or ends[step] != until:
        return False
    put(after, means[step])
    put_all(spread, spreads[step])
    return True


@machine_code(NOTHING(ONE, TWO, THREE, COUNT, FLAG, REAL, ONE, TWO))
def _keep_step(ends, means, spreads, step, known, until, mean, covariance):
    """Keeps the belief at the end of a step of `find` unless it is known, if there is room."""
    if step < len(ends) and not known:
        ends[step] = until
        put(means[step], mean)
        put_all(spreads[step], covariance)


@machine_code(
    several(REAL, 2)(*GIVEN, *ROLLING, FLAG, FLAG, ONE, REAL, REAL, REAL, ONE, ONE, ONE, TWO, ONE, ONE, TWO, THREE)
)
def find(
    rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, rolling, g, gt, wg,
    contact, either_way, normal, offset, earliest, horizon, world, noise, mean, covariance, rate, ends, means, spreads,
):  # fmt: skip
    """Carries one ball to an event, in place: its next contact, or the time when normal . x falls through an offset.

    Args:
        c, b, s, g: coefficients of rates, impact, surface and rolling, (1, p) with tangents (1, p, d); w, wb, ws, wg:
            their weights.
        contact: look for the next contact.  either_way: count a rise through the offset too.  normal (9,).
        earliest, horizon: s from the start; only events after the one and up to the other count.
        world (11,), noise (5,): as `beliefs.carry`.
    Writes: mean (d,) and covariance (d, d) at the event, or where the search ended; the mean's rate of change there in
        flight, or at rest, to rate (9,). Of up to m steps the end (s) to ends (m,), and the belief then to means (m, d)
        and spreads (m, d, d): a later search from the same start, with the same arrays, takes the steps of plain
        flight; the ends of the others are negative.
    Returns: `NONE`, `FOUND` or `HARD`, and the time (s) since the start.
    """
    d, passed, laws = len(mean), 0.0, laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    after, spread, x, touch = np.empty(d), np.empty((d, d)), mean[:9], np.empty(9)
    grounded, step = law_at(rolling, g, gt, wg), 0
    while passed < horizon:
        h = min(MAX_STEP, horizon - passed)
        known = _take_step(ends, means, spreads, step, passed + h, after, spread)
        low, tau, past, rolls = np.nan, h, np.nan, np.nan
        if not known:
            low, tau, past, rolls = _go(laws, grounded, mean, covariance, h, world, noise, after, spread, touch)
        resting = math.isfinite(rolls)
        touched = tau < 0.0 and math.isfinite(low)  # before this moment: it bounces at once
        if not (touched or 0.0 <= tau <= h):
            return HARD, passed
        flown, event = h, np.nan
        h = INSTANT if touched else tau
        if not touched and not contact:
            still, since = rolls if resting else h, earliest - passed
            event = _first_zero(
                laws.rates, grounded, resting, x, after[:9], flown, h, still, since, normal, offset, either_way, touch
            )
        elif not touched and not resting and math.isfinite(low) and passed + h > earliest:
            event = h
        h = event if math.isfinite(event) else h
        if resting:
            roll_off(laws, grounded, mean, covariance, h, low, world, noise, after, spread)
            resting = h <= rolls
        elif math.isfinite(low) and not math.isfinite(event):
            if not bounce(laws, x, covariance, h, low, world, noise, after[:9], spread):
                return HARD, passed
            after[9:] = mean[9:]
        else:
            if h < flown:
                fly_belief(laws.rates, mean, covariance, h, noise, after, spread)
            beside = contact and low == world[0] and not over_table(after[:9], world)
            if beside or (past <= h and not falls_past(laws, covariance, touch, past, h, world, after, spread)):
                return HARD, passed
        put(mean, after)
        put_all(covariance, spread)
        passed += h
        plain = h == MAX_STEP and math.isnan(low) and math.isnan(past) and math.isnan(rolls)
        _keep_step(ends, means, spreads, step, known, passed if plain else -passed, mean, covariance)
        step += 1
        if math.isfinite(event):
            _rates_at(laws.rates, grounded, resting, x, rate)
            return FOUND, passed
    return NONE, passed
