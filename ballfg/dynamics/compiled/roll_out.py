"""Moves balls from time to time through contacts in machine code, by the rules of `motion.rollout`."""

import math

import numpy as np

from ballfg.dynamics.compiled.beliefs.edges import at_rest, gap_of, level_below, over_table
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.contacts import contacts
from ballfg.dynamics.compiled.flight import fly_one, fly_together, put, put_all
from ballfg.dynamics.compiled.signatures import (
    COUNTS,
    FLAG,
    FUNCTION,
    NOTHING,
    ONE,
    REAL,
    THREE,
    THREE_FUNCTIONS,
    THREE_VALUES,
    THREE_WEIGHTS,
    TWO,
)
from ballfg.dynamics.motion.limits import LONGEST_FALL, LONGEST_MOTION, MAX_CONTACTS, REST_SPEED, steps_over


@machine_code(FLAG(THREE_FUNCTIONS, THREE_VALUES, THREE_WEIGHTS, ONE, REAL, REAL, ONE, ONE))
def _through(functions, values, weights, x, level, h, world, after):
    """Moves a ball x (9,) by h s, at most one step, to `after` (9,); True if it rests or may come to rest.

    It starts in flight; `after` holds the state that the ball would have without the surface at `level` m.
    """
    rates, impact, surface = functions
    c, b, s = values
    w, wb, ws = weights
    n, none = np.zeros((1, 0)), np.empty((1, 9, 0))
    at, tau, bounced = x.copy().reshape(1, 9), np.empty(1), np.empty((1, 9))
    ct, bt, st = np.empty((1, c.shape[1], 0)), np.empty((1, b.shape[1], 0)), np.empty((1, s.shape[1], 0))
    longest, empty, remaining = np.full(1, LONGEST_FALL), np.empty((9, 0)), h
    for _ in range(MAX_CONTACTS - 1):
        contacts(
            rates, impact, surface, at, none, c, ct, b, bt, s, st, w, wb, ws, np.full(1, level), longest, world[2],
            tau, n, bounced, none.copy(),
        )  # fmt: skip
        if level == world[0] and not math.isnan(tau[0]):
            touch = at[0].copy()
            fly_one(rates, touch, c[0], w, empty, ct[0], tau[0], np.empty(0), 1)
            if not over_table(touch, world):  # beside the table: the ball falls on the floor
                level = world[1]
                if gap_of(surface, after, s[0], ws, level, world[2]) >= 0.0:
                    return False
                continue
        if math.isnan(tau[0]) or bounced[0, 5] < REST_SPEED:
            return True
        put(at[0], bounced[0])
        remaining -= tau[0]
        put(after, at[0])
        fly_one(rates, after, c[0], w, empty, ct[0], remaining, np.empty(0), 1)
        if at_rest(at[0], gap_of(surface, at[0], s[0], ws, level, world[2]), level, world):
            return True
        if not (gap_of(surface, after, s[0], ws, level, world[2]) < 0.0 and after[5] < 0.0):
            return False
    return True


@machine_code(NOTHING(*[FUNCTION] * 3, THREE_VALUES, THREE_WEIGHTS, TWO, TWO, ONE, THREE, COUNTS))
def roll_out(rates, impact, surface, values, weights, start, durations, world, states, reached):
    """Balls start (m, 9) after each of k durations (m, k) s, one after another.

    Args: world: table's and floor's height and radius in m, the table's ends, as in `Course`.
    Writes: states (m, k, 9); reached (m,), the number of valid ones: a ball that rests stays where it was.
    """
    functions, (c, b, s), (w, _, ws) = (rates, impact, surface), values, weights
    m, k = durations.shape
    x, after, still = start.copy(), np.empty((m, 9)), np.zeros((m, 0))
    none, ct, step = np.empty((m, 9, 0)), np.empty((m, c.shape[1], 0)), np.empty(m)
    for r in range(m):
        reached[r] = k
    for j in range(k):
        longest = 0.0
        for r in range(m):
            longest = max(longest, min(durations[r, j], LONGEST_MOTION))
        steps = steps_over(longest)
        for r in range(m):
            step[r] = min(durations[r, j], LONGEST_MOTION) / steps
        for _ in range(steps):
            put_all(after, x)
            fly_together(rates, after, none, c, ct, w, step, still, 1)
            for r in range(m):
                if reached[r] <= j:
                    continue
                level = level_below(x[r, 2], world)
                hard = at_rest(x[r], gap_of(surface, x[r], s[r], ws, level, world[2]), level, world)
                if not hard and after[r, 5] < 0.0 and gap_of(surface, after[r], s[r], ws, level, world[2]) < 0.0:
                    own = (c[r : r + 1], b[r : r + 1], s[r : r + 1])
                    hard = _through(functions, own, weights, x[r], level, step[r], world, after[r])
                if hard:
                    reached[r] = j
            put_all(x, after)
        for r in range(m):
            put(states[r, j], x[r])
