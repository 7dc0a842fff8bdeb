"""Adds hypotheses with events that no surface explains: starts, hits, tracker shifts, a ball that leaves its rest."""

import math
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, NOTHING, ONE, REAL
from ballfg.estimation.segmentation.bank import (
    BANK,
    FLYING,
    LOG,
    ONE_HYPOTHESIS,
    SURFACES,
    USED,
    WRITTEN,
    Record,
    Records,
    add,
    pass_through,
)
from ballfg.estimation.segmentation.events import HIT, LEAVE, OUTLIER, REST, SHIFT
from ballfg.estimation.segmentation.evidence import AS_OUTLIER, rank, update
from ballfg.estimation.segmentation.motion import lift, put_down
from ballfg.estimation.segmentation.scene import SCENE

SHORTEST_STEP: Final = 1e-3
"""s. Least interval for the price of an event."""
SHIFTED_PREDICTIONS: Final = 3
"""Number of best predictions that are tried with a shift; beside a bounce the right one may be the third."""
MOST_ADDED: Final = 2 + 2 * SHIFTED_PREDICTIONS
"""Largest number of hypotheses from these events, besides one for each surface."""


@machine_code(NOTHING(BANK, COUNTS, LOG, COUNT, REAL, ONE, ONE, COUNT, REAL, SCENE, SURFACES))
def start(
    bank: Records,
    fill: Index,
    log: Records,
    tip: int,
    score: float,
    position: Array,
    sigma: Array,
    sample: int,
    time: float,
    scene: Record,
    surfaces: Records,
) -> None:
    """Hypotheses after a first sample: the ball flies, rests on a surface nearby, or the sample is an outlier.

    All expect the ball within the spread of outliers around the sample, so that their evidences are comparable.

    Args:
        bank, fill, log: empty; filled with those hypotheses.
        tip: the previous event.
        score: nats, of the previous hypothesis.
        position: (3,) m.
        sigma: (3,) m, its noise.
        sample: index of the sample.
        time: s, its stamp.
        scene, surfaces: of a `Scene`.
    """
    fill[USED] = 1
    _forget(bank[0], position, scene.outlier_spread**2, scene)
    bank[0].score, bank[0].tip = score, tip
    _rested(bank, fill, log, 0, position, sample - 1, time, scene, surfaces)
    flying = bank[:1].copy()
    update(bank, fill, log, 0, position, sigma, sample, time, scene)
    lost = bank[add(bank, fill, flying, 0)]
    lost.score += scene.log_shares[AS_OUTLIER] - 3.0 * math.log(scene.outlier_spread)
    pass_through(lost, log, fill, OUTLIER, sample, -1, time)


@machine_code(NOTHING(BANK, COUNTS, LOG, BANK, ONE, REAL, COUNT, REAL, SCENE, SURFACES))
def hit(
    bank: Records,
    fill: Index,
    log: Records,
    before: Records,
    position: Array,
    dt: float,
    interval: int,
    time: float,
    scene: Record,
    surfaces: Records,
) -> None:
    """Adds the best explanation of the past with a forgotten velocity, in the air and on nearby surfaces.

    Over a short interval the ball reappears close to where it was; over a long one it may be anywhere.
    """
    row = add(bank, fill, before, 0)
    h = bank[row]
    at = h.mean[:, 0].copy() if dt < scene.short_gap else position
    reach = scene.hit_spread**2 + (scene.velocity_spread * min(dt, scene.short_gap)) ** 2
    _forget(h, at, reach, scene)
    h.score -= _rarity(scene.hit_rate, dt) + scene.hit_cost * math.exp(-dt / scene.short_gap)
    pass_through(h, log, fill, HIT, interval, -1, time)
    _rested(bank, fill, log, row, position, interval, time, scene, surfaces)


@machine_code(NOTHING(BANK, COUNTS, LOG, BANK, ONE, ONE, REAL, COUNT, REAL, SCENE))
def shift(
    bank: Records,
    fill: Index,
    log: Records,
    predicted: Records,
    position: Array,
    sigma: Array,
    dt: float,
    interval: int,
    time: float,
    scene: Record,
) -> None:
    """Adds the best predictions with an unknown offset of the measurements, from now on or until now.

    Only the next surface shows which of the two holds.
    """
    n, first = len(predicted), fill[USED]
    rows = np.empty(n, np.int64)
    rank(predicted, 0, n, rows)
    for row in rows[:SHIFTED_PREDICTIONS]:
        h = bank[add(bank, fill, predicted, row)]
        h.score = h.score - _rarity(scene.shift_rate, dt) - scene.shift_cost
        h.age = 0
        pass_through(h, log, fill, SHIFT, interval, -1, time)
        for axis in range(3):
            h.cov[axis, 0, 0] += scene.shift_spread**2
            # the shift's expectation, not the innovation: after a gap the path's own uncertainty dominates that
            known = scene.shift_spread**2 / (h.cov[axis, 0, 0] + sigma[axis] ** 2)
            offset = (position[axis] - h.mean[axis, 0]) * known
            h.shift[axis] += offset
            log[fill[WRITTEN] - 1].offset[axis] = offset
    for row in range(first, fill[USED]):
        right = bank[add(bank, fill, bank, row)]
        for axis in range(3):
            right.shift[axis] = 0.0


@machine_code(NOTHING(BANK, COUNTS, LOG, BANK, REAL, COUNT, REAL, SCENE))
def leave(
    bank: Records,
    fill: Index,
    log: Records,
    predicted: Records,
    dt: float,
    interval: int,
    time: float,
    scene: Record,
) -> None:
    """Adds the best resting prediction, in the air from now on."""
    best = -1
    for row in range(len(predicted)):
        if predicted[row].surface != FLYING and (best < 0 or predicted[row].score > predicted[best].score):
            best = row
    if best < 0:
        return
    h = bank[add(bank, fill, predicted, best)]
    pass_through(h, log, fill, LEAVE, interval, h.surface, time)
    lift(h, scene)
    h.score = h.score - _rarity(scene.hit_rate, dt) - scene.leave_cost
    h.age = 0


@machine_code(NOTHING(ONE_HYPOTHESIS, ONE, REAL, SCENE))
def _forget(h: Record, position: Array, variance: float, scene: Record) -> None:
    """Makes a hypothesis fly at a position (3,) m with a variance m^2, with all else unknown."""
    h.surface, h.age = FLYING, 0
    for axis in range(3):
        h.shift[axis] = 0.0
        for i in range(3):
            h.mean[axis, i] = 0.0
            for k in range(3):
                h.cov[axis, i, k] = 0.0
        h.mean[axis, 0] = position[axis]
        h.cov[axis, 0, 0] = variance
        h.cov[axis, 1, 1] = scene.velocity_spread**2
        h.cov[axis, 2, 2] = scene.slack**2


@machine_code(NOTHING(BANK, COUNTS, LOG, COUNT, ONE, COUNT, REAL, SCENE, SURFACES))
def _rested(
    bank: Records,
    fill: Index,
    log: Records,
    row: int,
    position: Array,
    interval: int,
    time: float,
    scene: Record,
    surfaces: Records,
) -> None:
    """Adds a flying hypothesis as a resting one, for each surface near the sample."""
    for surface in range(len(surfaces)):
        if abs(position[2] - surfaces[surface].centre) < scene.rest_range:
            down = bank[add(bank, fill, bank, row)]
            put_down(down, surface, surfaces)
            down.score -= scene.start_at_rest_cost
            pass_through(down, log, fill, REST, interval, surface, time)


@machine_code(REAL(REAL, REAL))
def _rarity(rate: float, dt: float) -> float:
    """nats, minus log probability of an event with a rate (1/s) in an interval."""
    return -math.log(-math.expm1(-rate * max(dt, SHORTEST_STEP)))
