"""Moves balls from time to time through contacts and rest in machine code, by the rules of `motion.rollout`."""

import numpy as np

from ballfg.dynamics.compiled.beliefs.edges import is_slow, level_at
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import fly_together, law_at, laws_of, laws_of_one, only, put, put_all
from ballfg.dynamics.compiled.ground import advance_still
from ballfg.dynamics.compiled.signatures import GIVEN, NOTHING, ONE, ROLLING, THREE, TWO
from ballfg.dynamics.motion.limits import LONGEST_MOTION, steps_over


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
