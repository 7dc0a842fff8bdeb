"""Moves balls from time to time through contacts in machine code, by the rules of `motion.rollout`."""

import math

import numpy as np

from ballfg.dynamics.compiled.beliefs.edges import at_rest, gap_of, is_slow, level_at, over_table
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.contacts import meet
from ballfg.dynamics.compiled.flight import fly_together, glide, laws_of, laws_of_one, put, put_all
from ballfg.dynamics.compiled.signatures import COUNTS, FLAG, GIVEN, LAWS, NOTHING, ONE, REAL, THREE, TWO
from ballfg.dynamics.motion.limits import LONGEST_FALL, LONGEST_MOTION, MAX_CONTACTS, REST_SPEED, steps_over


@machine_code(FLAG(LAWS, ONE, REAL, REAL, ONE, ONE))
def _through(laws, x, level, h, world, after):
    """Moves a ball x (9,) by h s, at most one step, to `after` (9,); True if it rests or may come to rest.

    It starts in flight; `after` holds the state that the ball would have without the surface at `level` m.
    """
    n, none = np.zeros((1, 0)), np.empty((1, 9, 0))
    at, tau, bounced = x.copy().reshape(1, 9), np.empty(1), np.empty((1, 9))
    longest, remaining = np.full(1, LONGEST_FALL), h
    for _ in range(MAX_CONTACTS - 1):
        meet(laws, at, none, np.full(1, level), longest, world[2], tau, n, bounced, none.copy())
        if level == world[0] and not math.isnan(tau[0]):
            touch = at[0].copy()
            glide(laws.rates, touch, tau[0], 1)
            if not over_table(touch, world):  # beside the table: the ball falls on the floor
                level = world[1]
                if gap_of(laws.surface, after, level, world[2]) >= 0.0:
                    return False
                continue
        if math.isnan(tau[0]) or bounced[0, 5] < REST_SPEED:
            return True
        put(at[0], bounced[0])
        remaining -= tau[0]
        put(after, at[0])
        glide(laws.rates, after, remaining, 1)
        if at_rest(laws.surface, at[0], level, world):
            return True
        if not (gap_of(laws.surface, after, level, world[2]) < 0.0 and after[5] < 0.0):
            return False
    return True


@machine_code(NOTHING(*GIVEN, TWO, TWO, ONE, THREE, COUNTS))
def roll_out(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, start, durations, world, states, reached):
    """Balls start (m, 9) after each of k durations (m, k) s, one after another, without derivatives.

    Args: world: table's and floor's height and radius in m, the table's ends, as in `Course`.
    Writes: states (m, k, 9); reached (m,), the number of valid ones: a ball that rests stays where it was.
    """
    (m, k), all_laws = durations.shape, laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    x, after, still = start.copy(), np.empty((m, 9)), np.zeros((m, 0))
    none, step, raised, unmoved = np.empty((m, 9, 0)), np.empty(m), np.empty((m, 3)), np.empty((m, 3, 0))
    under = raised.copy()
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
            all_laws.surface.compute(x, s, ws, none, st, under, unmoved)
            all_laws.surface.compute(after, s, ws, none, st, raised, unmoved)
            for r in range(m):
                level = level_at(x[r, 2] - under[r, 0], world)
                below = after[r, 5] < 0.0 and after[r, 2] - level - raised[r, 0] - world[2] < 0.0
                if reached[r] <= j or not (below or is_slow(x[r])):
                    continue
                laws = laws_of_one(all_laws, r)
                hard = at_rest(laws.surface, x[r], level, world)
                if not hard and below:
                    hard = _through(laws, x[r], level, step[r], world, after[r])
                if hard:
                    reached[r] = j
            put_all(x, after)
        for r in range(m):
            put(states[r, j], x[r])
