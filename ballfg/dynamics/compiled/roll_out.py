"""Moves balls from time to time through contacts and rest in machine code, by the rules of `motion.rollout`."""

import numpy as np
from numba.extending import register_jitable

from ballfg.dynamics.compiled.beliefs.edges import (
    carried,
    gap_of,
    is_slow,
    level_at,
    level_below,
    lies_on,
    over_table,
    stays,
)
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import (
    fly_together,
    glide,
    law_at,
    laws_of,
    laws_of_one,
    only,
    put,
    put_all,
)
from ballfg.dynamics.compiled.ground import advance_step, advance_still, place_on
from ballfg.dynamics.compiled.signatures import (
    ADDRESS,
    COUNT,
    COUNTS,
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
    Law,
)
from ballfg.dynamics.motion.limits import LONGEST_MOTION, MAX_CONTACTS, REST_SPEED, steps_over

NEWTON_STEPS = 30  # Largest number of steps to a plane on a cubic; four are enough
TIME_TOLERANCE = 1e-9  # of a step, of a crossing on a cubic


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


@machine_code(NOTHING(LAW, TWO, TWO, TWO, REAL, COUNTS))
def _push(surface, x, worlds, pushes, h, held):
    """Changes the velocities of balls x (m, 9) as pushes (m, 3) m/s^2 do within h s; at rest they stay on the surface.

    Rows of arrays are taken for the few balls at rest alone: numba counts who holds one, which takes longer than this.
    Writes: held (m,), 1 for the balls at rest; those that have 1 already stay.
    """
    for r in range(len(x)):
        if not held[r] and abs(x[r, 5]) <= REST_SPEED / 2:
            own = only(surface, r)
            held[r] = int(lies_on(own, x[r], level_below(own, x[r], worlds[r]), worlds[r]))
        x[r, 3] += h * pushes[r, 0]
        x[r, 4] += h * pushes[r, 1]
        if not held[r]:
            x[r, 5] += h * pushes[r, 2]


@machine_code(NOTHING(ONE, ONE, REAL, REAL, ONE))
def _within(x, after, h, t, at):
    """Writes the state at (9,) after a share t of a step of h s, on the cubic between its ends x and after (9,)."""
    for i in range(3):
        rise = after[i] - x[i]
        bend, twist = 3.0 * rise - h * (2.0 * x[3 + i] + after[3 + i]), h * (x[3 + i] + after[3 + i]) - 2.0 * rise
        at[i] = x[i] + t * (h * x[3 + i] + t * (bend + t * twist))
        at[3 + i] = x[3 + i] + t * (2.0 * bend + 3.0 * t * twist) / h
        at[6 + i] = x[6 + i] + t * (after[6 + i] - x[6 + i])


@machine_code(REAL(ONE, ONE, REAL, ONE, REAL, ONE))
def _crossed(x, after, h, normal, offset, at):
    """Time (s) in a step of h s at which a ball crosses normal . p = offset (m); its ends (9,) lie on both sides.

    Writes: the state at (9,) there, on the cubic.
    """
    low, high, t = 0.0, 1.0, 0.5
    above = normal[0] * x[0] + normal[1] * x[1] + normal[2] * x[2] > offset
    for _ in range(NEWTON_STEPS):
        _within(x, after, h, t, at)
        value = normal[0] * at[0] + normal[1] * at[1] + normal[2] * at[2] - offset
        slope = h * (normal[0] * at[3] + normal[1] * at[4] + normal[2] * at[5])
        low, high = (t, high) if (value > 0.0) == above else (low, t)
        sooner = t
        t -= value / slope
        if not low <= t <= high:
            t = 0.5 * (low + high)
        if abs(t - sooner) < TIME_TOLERANCE:
            break
    _within(x, after, h, t, at)
    return t * h


@machine_code(NOTHING(TWO, TWO, ONE, ONE, REAL, ONE, TWO))
def crossed_by_all(x, after, h, normal, offset, times, at):
    """The same for balls x and after (m, 9) in steps of h (m,) s. Writes: times (m,) s and states at (m, 9)."""
    for r in range(len(x)):
        times[r] = _crossed(x[r], after[r], h[r], normal, offset, at[r])


@machine_code(COUNT(LAWS, LAW, ONE, REAL, ONE, ONE, ONE, TWO))
def _bounces(laws, rolling, x, h, world, after, times, nodes):
    """Number of bounces of a ball x (9,) in a step of h s; writes after (9,), times and nodes as `scatter`."""
    at, levels = np.empty(MAX_CONTACTS), np.empty(MAX_CONTACTS)
    put(after, x)
    count = advance_step(laws, rolling, after, np.empty((9, 0)), h, world, at, levels)
    if count:
        put(nodes[0], x)
        put(nodes[1], after)
        times[0] = at[0]
        glide(laws.rates, nodes[0], times[0], 1)
        if after[5] != 0.0:  # else it came to rest after its last bounce, and did not fly to where it is
            times[1] = at[count - 1]
            glide(laws.rates, nodes[1], times[1] - h, 1)
    return count


@register_jitable
def _rows(law, which):
    """A law of some of its balls, which (n,), without tangents."""
    n, p = len(which), law.c.shape[1]
    c = np.empty((n, p))
    for i in range(n):
        put(c[i], law.c[which[i]])
    return Law(law.compute, c, np.empty((n, p, 0)), law.w)


@machine_code(NOTHING(ADDRESS, LAWS, COUNTS, TWO, ONE, TWO, TWO))
def _leave(rates, laws, which, touch, rest, left, after):
    """Balls in rows which (n,) bounce at states touch (n, 9) and fly on for rest (n,) s.

    Writes: left (n, 9), the states right after the bounce; after (n, 9), those at the end.
    """
    n, calm = len(which), np.empty((len(which), 9, 0))
    impact, flying = _rows(laws.impact, which), _rows(laws.rates, which)
    impact.compute(touch, impact.c, impact.w, calm, impact.ct, left, calm)
    put_all(after, left)
    fly_together(rates, after, calm, flying.c, flying.ct, flying.w, rest, np.zeros((n, 0)), 1)


@machine_code(FLAG(LAW, ONE, ONE, REAL, ONE))
def _stays_above(surface, left, after, level, world):
    """Whether a ball that left (9,) a level rises, and is above it at the end (9,) of the step."""
    return left[5] >= REST_SPEED and (after[5] >= 0.0 or gap_of(surface, after, level, world[2]) >= 0.0)


@machine_code(COUNT(LAWS, TWO, TWO, REAL, TWO, COUNTS, ONE, TWO, ONE, COUNTS))
def _coming_down(laws, x, after, h, worlds, which, tau, touch, level, doubtful):
    """How many balls x (m, 9) come down on a surface in a step of h s after which they are at after (m, 9).

    Writes: to the first places which, tau and touch, their rows, times (s) and states (9,) there, and the levels (m) of
        all; doubtful (m,), 1 where a closer look is needed: a ball that may be at rest, or falls to the floor.
    """
    m, n, none, unmoved = len(x), 0, np.empty((len(x), 9, 0)), np.empty((len(x), 3, 0))
    under, raised, surface, up = np.empty((m, 3)), np.empty((m, 3)), laws.surface, np.ones(3)
    surface.compute(x, surface.c, surface.w, none, surface.ct, under, unmoved)
    surface.compute(after, surface.c, surface.w, none, surface.ct, raised, unmoved)
    for r in range(m):
        doubtful[r] = int(abs(x[r, 5]) <= REST_SPEED / 2)
        if doubtful[r] or not after[r, 5] < 0.0:
            continue
        world = worlds[r]
        level[n] = level_at(x[r, 2] - under[r, 0], world)
        height = level[n] + raised[r, 0] + world[2]
        if not after[r, 2] < height:
            continue
        if not x[r, 2] > level[n] + under[r, 0] + world[2]:
            doubtful[r] = 1
            continue
        up[0], up[1] = -raised[r, 1], -raised[r, 2]
        tau[n] = _crossed(x[r], after[r], h, up, height + up[0] * after[r, 0] + up[1] * after[r, 1], touch[n])
        if level[n] == world[0] and not over_table(touch[n], world):
            doubtful[r] = int(gap_of(only(surface, r), after[r], world[1], world[2]) < 0.0)
        else:
            which[n] = r
            n += 1
    return n


@machine_code(NOTHING(ADDRESS, LAWS, LAW, TWO, TWO, REAL, TWO, COUNTS))
def _roll_together(address, laws, rolling, x, after, h, worlds, doubtful):
    """Moves those balls x (m, 9) on for h s that lie on a surface all the time, without passing an end of it.

    Writes: after (m, 9), and doubtful (m,) 0, of these among the doubtful ones.
    """
    m, n, none = len(x), 0, np.empty((9, 0))
    which, at, level = np.empty(m, dtype=np.int64), np.empty((m, 9)), np.empty(m)
    for r in range(m):
        if not doubtful[r]:
            continue
        surface = only(laws.surface, r)
        level[n] = level_below(surface, x[r], worlds[r])
        if stays(only(laws.rates, r), surface, x[r], level[n], worlds[r]):
            which[n] = r
            put(at[n], x[r])
            place_on(surface, at[n], none, level[n], worlds[r, 2])
            n += 1
    if n == 0:
        return
    own, calm = _rows(rolling, which[:n]), np.empty((n, 9, 0))
    fly_together(address, at[:n], calm, own.c, own.ct, own.w, np.full(n, h), np.zeros((n, 0)), steps_over(h))
    for i in range(n):
        if level[i] != worlds[which[i], 0] or carried(at[i], worlds[which[i]]):
            put(after[which[i]], at[i])
            doubtful[which[i]] = 0


@machine_code(NOTHING(ADDRESS, ADDRESS, LAWS, LAW, TWO, TWO, REAL, TWO, TWO, THREE, COUNTS))
def _bounce(rates, rolls, laws, rolling, x, after, h, worlds, times, nodes, bounced):
    """Moves balls x (m, 9), which would be at after (m, 9) in h s without surfaces, through their bounces.

    Balls that bounce once and rise, or that roll on, nearly all, are moved together; the others one by one, by the
    rules of rollout.
    Writes: after; times (m, 3) and nodes (m, 3, 9), as a step of `scatter`; bounced (m,), the numbers of bounces.
    """
    m = len(x)
    which, doubtful = np.empty(m, dtype=np.int64), np.empty(m, dtype=np.int64)
    tau, touch, level, left, end = np.empty(m), np.empty((m, 9)), np.empty(m), np.empty((m, 9)), np.empty((m, 9))
    n = _coming_down(laws, x, after, h, worlds, which, tau, touch, level, doubtful)
    if n:
        _leave(rates, laws, which[:n], touch[:n], h - tau[:n], left[:n], end[:n])
    for i in range(n):
        r = which[i]
        if not _stays_above(only(laws.surface, r), left[i], end[i], level[i], worlds[r]):
            doubtful[r] = 1
            continue
        bounced[r] = 1
        put(after[r], end[i])
        put(nodes[r, 0], touch[i])
        put(nodes[r, 1], left[i])
        times[r, 0] = times[r, 1] = tau[i]
    _roll_together(rolls, laws, rolling, x, after, h, worlds, doubtful)
    for r in range(m):
        if doubtful[r]:
            bounced[r] = _bounces(
                laws_of_one(laws, r), only(rolling, r), x[r], h, worlds[r], after[r], times[r], nodes[r]
            )


@machine_code(NOTHING(ONE, REAL, ONE, ONE))
def _kick(kick, rest, left, after):
    """Changes the velocity of a ball that left (9,) a surface, rest s before it is at after (9,), by kick (3,) m/s."""
    for i in range(3):
        left[3 + i] += kick[i]
        after[i] += kick[i] * rest
        after[3 + i] += kick[i]


@machine_code(NOTHING(*GIVEN, *ROLLING, TWO, REAL, THREE, TWO, TWO, FOUR, THREE, THREE))
def scatter(
    rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws, rolling, g, gt, wg,
    start, h, pushes, kicks, worlds, nodes, times, met,
):  # fmt: skip
    """Balls start (m, 9) over k steps of h s, each with its own random accelerations and kicks at bounces.

    Args:
        pushes: (k, m, 3) m/s^2, in each step.  kicks: (m, 3) m/s, at a bounce; at its next one a ball has its
            neighbour's.  worlds: (m, 11), as in `Carrier`.
    Writes: nodes (m, k, 3, 9): in each step the states before its first bounce, after its last one and at its end; all
        at the end without a bounce. times (m, k, 3) s, of these since the start; met (m, k, 3), bounces so far.
    """
    m, k = len(start), len(pushes)
    all_laws, grounded = laws_of(rates, impact, surface, c, ct, b, bt, s, st, w, wb, ws), law_at(rolling, g, gt, wg)
    x, after, bounced = start.copy(), np.empty((m, 9)), np.empty(m, dtype=np.int64)
    none, calm, step, so_far = np.empty((m, 9, 0)), np.zeros((m, 0)), np.full(m, h), np.zeros(m, dtype=np.int64)
    until, at, held = np.empty((m, 3)), np.empty((m, 3, 9)), np.empty(m, dtype=np.int64)
    for j in range(k):
        held[:] = 0
        _push(all_laws.surface, x, worlds, pushes[j], 0.5 * h, held)
        put_all(after, x)
        fly_together(rates, after, none, c, ct, w, step, calm, 1)
        until[:], bounced[:] = h, 0
        _bounce(rates, rolling, all_laws, grounded, x, after, h, worlds, until, at, bounced)
        for r in range(m):
            if bounced[r]:
                _kick(kicks[(r + so_far[r]) % m], h - until[r, 1], at[r, 1], after[r])
        _push(all_laws.surface, after, worlds, pushes[j], 0.5 * h, held)  # a ball that fell did for less than a step
        for r in range(m):
            for i in range(3):
                for column in range(9):
                    nodes[r, j, i, column] = at[r, i, column] if bounced[r] and i < 2 else after[r, column]
                met[r, j, i] = so_far[r] + (bounced[r] if i else 0)
                times[r, j, i] = j * h + until[r, i]
            so_far[r] += bounced[r]
        put_all(x, after)
