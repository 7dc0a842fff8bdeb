"""Moves balls from time to time through contacts and rest in machine code, by the rules of `motion.rollout`."""

import numpy as np

from ballfg.dynamics.compiled.beliefs.edges import gap_of, is_slow, level_at, level_below, over_table
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import (
    evaluate,
    fly_together,
    glide,
    law_at,
    laws_of,
    laws_of_one,
    only,
    put,
    put_all,
)
from ballfg.dynamics.compiled.ground import advance_step, advance_still
from ballfg.dynamics.compiled.signatures import (
    COUNT,
    FLAG,
    FOUR,
    GIVEN,
    LAW,
    LAWS,
    NOTHING,
    ONE,
    REAL,
    ROLLING,
    THREE,
    TWO,
)
from ballfg.dynamics.motion.limits import LONGEST_MOTION, MAX_CONTACTS, REST_GAP, REST_SPEED, steps_over

NEWTON_STEPS = 30  # Largest number of steps to a contact on a cubic; four are enough
TIME_TOLERANCE = 1e-9  # of a step, of a contact on a cubic


@machine_code(NOTHING(*GIVEN, *ROLLING, TWO, TWO, ONE, THREE))
def roll_out(
    rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, rolling, g, gt, wg, start, durations, world, states
):
    """Balls start (m, 9) after each of k durations (m, k) s, one after another, without derivatives.

    Args: world: table's and floor's height and radius in m, the table's ends, as in `Course`.
    Writes: states (m, k, 9).
    """
    (m, k), all_laws = durations.shape, laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws)
    x, after, still = start.copy(), np.empty((m, 9)), np.zeros((m, 0))
    none, step, raised, unmoved = np.empty((m, 9, 0)), np.empty(m), np.empty((m, 3)), np.empty((m, 3, 0))
    under, grounded = raised.copy(), law_at(rolling, g, gt, wg)
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
                if below or is_slow(x[r]):
                    put(after[r], x[r])
                    advance_still(laws_of_one(all_laws, r), only(grounded, r), after[r], step[r], world)
            put_all(x, after)
        for r in range(m):
            put(states[r, j], x[r])


@machine_code(NOTHING(LAW, ONE, ONE, REAL, ONE))
def _push(surface, x, push, h, world):
    """Changes the velocity of a ball x (9,) as a push (3,) m/s^2 does within h s; at rest it stays on its surface."""
    x[3] += h * push[0]
    x[4] += h * push[1]
    if not (is_slow(x) and abs(gap_of(surface, x, level_below(surface, x, world), world[2])) <= REST_GAP):
        x[5] += h * push[2]


@machine_code(REAL(ONE, ONE, REAL, REAL))
def _time_down(x, after, z, h):
    """Time (s) at which a centre is at a height z (m) on the cubic between two states (9,) h s apart; NaN outside."""
    rise, t = after[2] - x[2], 0.5
    if not x[2] > z > after[2]:
        return np.nan
    bend, twist = 3.0 * rise - h * (2.0 * x[5] + after[5]), h * (x[5] + after[5]) - 2.0 * rise
    low, high = 0.0, 1.0
    for _ in range(NEWTON_STEPS):
        above = x[2] - z + t * (h * x[5] + t * (bend + t * twist))
        low, high = (t, high) if above > 0.0 else (low, t)
        slope = h * x[5] + t * (2.0 * bend + 3.0 * t * twist)
        sooner = t
        t -= above / slope
        if not low <= t <= high:
            t = 0.5 * (low + high)
        if abs(t - sooner) < TIME_TOLERANCE:
            break
    return t * h


@machine_code(FLAG(LAWS, ONE, ONE, REAL, REAL, REAL, ONE, ONE, TWO))
def _bounces_once(laws, x, after, level, raised, h, world, times, nodes):
    """Whether a ball x (9,) that comes down on a level in a step of h s passes it or bounces once and rises.

    Args: raised: m, of the surface above its level.  after (9,): the ball without surfaces; where it is true with them.
    Writes: after a bounce the states right before and after to nodes, and their time to times.
    """
    tau = _time_down(x, after, level + raised + world[2], h)
    if not 0.0 <= tau <= h:
        return False
    touch, left = x.copy(), np.empty(9)
    glide(laws.rates, touch, tau, 1)
    if level == world[0] and not over_table(touch, world):
        return gap_of(laws.surface, after, world[1], world[2]) >= 0.0
    evaluate(laws.impact, touch, np.empty((9, 0)), left, np.empty((9, 0)))
    if not left[5] >= REST_SPEED:
        return False
    put(nodes[0], touch)
    put(nodes[1], left)
    times[0] = times[1] = tau
    glide(laws.rates, left, h - tau, 1)
    put(after, left)
    return after[5] >= 0.0 or gap_of(laws.surface, after, level, world[2]) >= 0.0


@machine_code(COUNT(LAWS, LAW, ONE, REAL, ONE, ONE, ONE, TWO))
def _bounces(laws, rolling, x, h, world, after, times, nodes):
    """Number of bounces of a ball x (9,) in a step of h s; writes after (9,), times and nodes as `scatter`."""
    at, levels = np.empty(MAX_CONTACTS), np.empty(MAX_CONTACTS)
    put(after, x)
    count = advance_step(laws, rolling, after, np.empty((9, 0)), h, world, at, levels)
    if count:
        put(nodes[0], x)
        put(nodes[1], after)
        times[0], times[1] = at[0], at[count - 1]
        glide(laws.rates, nodes[0], times[0], 1)
        glide(laws.rates, nodes[1], times[1] - h, 1)
    return count


@machine_code(NOTHING(*GIVEN, *ROLLING, TWO, REAL, THREE, TWO, TWO, FOUR, THREE, THREE))
def scatter(
    rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, rolling, g, gt, wg,
    start, h, pushes, kicks, worlds, nodes, times, met,
):  # fmt: skip
    """Balls start (m, 9) over k steps of h s, each with its own random accelerations and kicks at bounces.

    Args:
        pushes: (m, k, 3) m/s^2, in each step.  kicks: (m, 3) m/s, at a bounce; at its next one a ball has its
            neighbour's.  worlds: (m, 11), as in `Carrier`.
    Writes: nodes (m, k, 3, 9): in each step the states before its first bounce, after its last one and at its end; all
        at the end without a bounce. times (m, k, 3) s, of these since the start; met (m, k, 3), bounces so far.
    """
    m, k = len(start), pushes.shape[1]
    all_laws, grounded = laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws), law_at(rolling, g, gt, wg)
    x, after, none, calm = start.copy(), np.empty((m, 9)), np.empty((m, 9, 0)), np.zeros((m, 0))
    under, raised, unmoved, step = np.empty((m, 3)), np.empty((m, 3)), np.empty((m, 3, 0)), np.full(m, h)
    for j in range(k):
        for r in range(m):
            _push(only(all_laws.surface, r), x[r], pushes[r, j], 0.5 * h, worlds[r])
        put_all(after, x)
        fly_together(rates, after, none, c, ct, w, step, calm, 1)
        all_laws.surface.compute(x, s, ws, none, st, under, unmoved)
        all_laws.surface.compute(after, s, ws, none, st, raised, unmoved)
        for r in range(m):
            world, before, bounced = worlds[r], 0.0 if j == 0 else met[r, j - 1, 2], 0
            level = level_at(x[r, 2] - under[r, 0], world)
            slow, below = is_slow(x[r]), after[r, 5] < 0.0 and after[r, 2] - level - raised[r, 0] - world[2] < 0.0
            times[r, j] = h
            if slow or below:
                laws = laws_of_one(all_laws, r)
                if not slow and _bounces_once(
                    laws, x[r], after[r], level, raised[r, 0], h, world, times[r, j], nodes[r, j]
                ):
                    bounced = int(times[r, j, 0] < h)
                else:
                    times[r, j] = h
                    bounced = _bounces(laws, only(grounded, r), x[r], h, world, after[r], times[r, j], nodes[r, j])
            if bounced:
                for i in range(3):
                    kick = kicks[(r + int(before)) % m, i]
                    nodes[r, j, 1, 3 + i] += kick
                    after[r, i] += kick * (h - times[r, j, 1])
                    after[r, 3 + i] += kick
            _push(only(all_laws.surface, r), after[r], pushes[r, j], 0.5 * h, world)
            put(nodes[r, j, 2], after[r])
            if not bounced:
                put(nodes[r, j, 0], after[r])
                put(nodes[r, j, 1], after[r])
            met[r, j, 0], met[r, j, 1], met[r, j, 2] = before, before + bounced, before + bounced
            times[r, j] += j * h
        put_all(x, after)
