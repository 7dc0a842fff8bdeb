"""Explains samples in machine code: every hypothesis branches, is weighed, and the unlikely are dropped."""

import math
from typing import Any, Final

import numpy as np
from numba import types

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, NOTHING, ONE, REAL, TWO
from ballfg.estimation.segmentation import bank
from ballfg.estimation.segmentation.log import chain, compact, decide
from ballfg.estimation.segmentation.result import HIT, LEAVE, OUTLIER, REST, RESTART, SHIFT
from ballfg.estimation.segmentation.surface_contact import Step, advance, forget, lift, may_meet, put_down

SHORTEST_STEP: Final = 1e-3
"""s. Least interval for the price of an event."""
SHIFTED_PREDICTIONS: Final = 3
"""Number of best predictions that are tried with a shift; beside a bounce the right one may be the third."""
MOST_ADDED: Final = 2 + 2 * SHIFTED_PREDICTIONS
"""Largest number of hypotheses from these events, besides one for each surface."""


@machine_code(NOTHING(bank.WORK, COUNT, REAL, bank.SAMPLE, bank.SCENE, bank.SURFACES))
def start(
    work: bank.Work, tip: int, score: float, sample: bank.Sample, scene: bank.Record, surfaces: bank.Records
) -> None:
    """Hypotheses after a first sample: a flying ball, one that rests on a surface nearby, or the sample an outlier.

    All expect the ball within the spread of outliers around the sample, so that their evidences are comparable.

    Args: work: empty; afterwards those hypotheses.  tip: the last event before.  score: nats, carried on.
    """
    work.fill[bank.USED] = 1
    held = work.bank
    forget(held[0], bank.FLYING, sample.position, scene.outlier_spread**2, scene.velocity_spread, scene.slack)
    held[0].score, held[0].tip = score, tip
    _rested(work, 0, sample, scene, surfaces)
    flying = held[:1].copy()
    bank.update(work, 0, sample, scene)
    lost = held[bank.add(work, flying, 0)]
    lost.score += scene.log_shares[bank.AS_OUTLIER] - 3.0 * math.log(scene.outlier_spread)
    bank.pass_through(lost, work, OUTLIER, sample.number, -1, sample.time)


@machine_code(NOTHING(bank.WORK, bank.BANK, bank.SAMPLE, REAL, bank.SCENE, bank.SURFACES))
def hit(
    work: bank.Work, before: bank.Records, sample: bank.Sample, dt: float, scene: bank.Record, surfaces: bank.Records
) -> None:
    """Adds the best hypothesis without its velocity, in the air and on a near surface; after a gap it is anywhere."""
    row = bank.add(work, before, 0)
    h = work.bank[row]
    at = h.mean[:, 0].copy() if dt < scene.short_gap else sample.position
    reach = scene.hit_spread**2 + (scene.velocity_spread * min(dt, scene.short_gap)) ** 2
    forget(h, bank.FLYING, at, reach, scene.velocity_spread, scene.slack)
    h.score -= hit_price(scene.hit_rate, scene.hit_cost, scene.short_gap, dt)
    bank.pass_through(h, work, HIT, sample.number - 1, -1, sample.time)
    _rested(work, row, sample, scene, surfaces)


@machine_code(NOTHING(bank.WORK, bank.BANK, bank.SAMPLE, REAL, bank.SCENE))
def shift(work: bank.Work, predicted: bank.Records, sample: bank.Sample, dt: float, scene: bank.Record) -> None:
    """Adds the best predictions, with the measurements jumping by an unknown offset: from now on, or until now."""
    n, held, first = len(predicted), work.bank, work.fill[bank.USED]
    rows = np.empty(n, np.int64)
    bank.rank(predicted, 0, n, rows)
    for row in rows[:SHIFTED_PREDICTIONS]:
        h = held[bank.add(work, predicted, row)]
        h.score = h.score - _rarity(scene.shift_rate, dt) - scene.shift_cost
        h.age = 0
        bank.pass_through(h, work, SHIFT, sample.number - 1, -1, sample.time)
        for axis in range(3):
            h.cov[axis, 0, 0] += scene.shift_spread**2
            # the shift's expectation, not the innovation: after a gap most of that is the path's own uncertainty
            known = scene.shift_spread**2 / (h.cov[axis, 0, 0] + sample.sigma[axis] ** 2)
            offset = (sample.position[axis] - h.mean[axis, 0]) * known
            h.shift[axis] += offset
            work.log[work.fill[bank.WRITTEN] - 1].offset[axis] = offset
    for row in range(first, work.fill[bank.USED]):
        right = held[bank.add(work, held, row)]
        for axis in range(3):
            right.shift[axis] = 0.0


@machine_code(NOTHING(bank.WORK, bank.BANK, bank.SAMPLE, REAL, bank.SCENE))
def leave(work: bank.Work, predicted: bank.Records, sample: bank.Sample, dt: float, scene: bank.Record) -> None:
    """Adds the best resting prediction, in the air from now on."""
    best = -1
    for row in range(len(predicted)):
        if predicted[row].surface != bank.FLYING and (best < 0 or predicted[row].score > predicted[best].score):
            best = row
    if best < 0:
        return
    h = work.bank[bank.add(work, predicted, best)]
    bank.pass_through(h, work, LEAVE, sample.number - 1, h.surface, sample.time)
    lift(h, scene)
    h.score = h.score - _rarity(scene.hit_rate, dt) - scene.leave_cost
    h.age = 0


@machine_code(NOTHING(bank.WORK, COUNT, bank.SAMPLE, bank.SCENE, bank.SURFACES))
def _rested(work: bank.Work, row: int, sample: bank.Sample, scene: bank.Record, surfaces: bank.Records) -> None:
    """Adds a flying hypothesis as one that rests, for each surface that the sample is near."""
    for surface in range(len(surfaces)):
        if abs(sample.position[2] - surfaces[surface].centre) < scene.rest_range:
            down = work.bank[bank.add(work, work.bank, row)]
            put_down(down, surface, scene, surfaces)
            down.score -= scene.start_at_rest_cost
            bank.pass_through(down, work, REST, sample.number - 1, surface, sample.time)


@machine_code(REAL(REAL, REAL))
def _rarity(rate: float, dt: float) -> float:
    """nats, minus log probability of an event with a rate (1/s) in an interval."""
    return -math.log(-math.expm1(-rate * max(dt, SHORTEST_STEP)))


@machine_code(REAL(REAL, REAL, REAL, REAL))
def hit_price(rate: float, cost: float, short_gap: float, dt: float) -> float:
    """nats, of a hit in an interval of dt s; arguments as in `SegmentationSettings`."""
    return _rarity(rate, dt) + cost * math.exp(-dt / short_gap)


SERIES: Final = 32
"""Bits of the `serial` of an event that count those of one sample; the others are the sample's number."""
EXPLAINED: Final[Any] = types.Tuple((bank.BANK, bank.LOG))
"""Hypotheses, best first, and the events of all hypotheses."""


@machine_code(EXPLAINED(bank.BANK, bank.LOG, REAL, REAL, ONE, ONE, COUNT, bank.SCENE, bank.SURFACES))
def explain(
    held: bank.Records,
    log: bank.Records,
    before: float,
    time: float,
    position: Array,
    sigma: Array,
    index: int,
    scene: bank.Record,
    surfaces: bank.Records,
) -> Any:
    """The likely hypotheses after a sample, best first, and the log of their events, from those before it.

    Args:
        held: (h,) best first; none before the first sample.  log: of their events.
        before: s, stamp of the last sample.
        time, position, sigma, index: of this one, as in `Sample`, with its number.
    """
    h, dt, now, old = len(held), time - before, held.copy(), len(log)
    gap = h > 0 and (dt > scene.longest_gap or (dt > scene.longest_unseen and may_meet(now, dt, scene, surfaces)))
    steps = 1 if h == 0 or gap else max(1, math.ceil(dt / scene.longest_step))
    branched = max(h, int(scene.most)) * (1 + 2 * len(surfaces))
    room, fill = 2 * (branched + MOST_ADDED + len(surfaces)), np.zeros(2, np.int64)
    work = bank.Work(np.empty(room, bank.HYPOTHESIS), np.empty(old + steps * branched + 2 * room, bank.LOGGED), fill)
    work.log[:old] = log
    fill[bank.WRITTEN] = old
    sample = bank.Sample(position, sigma, index, time)
    if h == 0:
        start(work, bank.NO_EVENT, 0.0, sample, scene, surfaces)
    elif gap:
        bank.pass_through(now[0], work, RESTART, index - 1, -1, time)
        start(work, now[0].tip, now[0].score, sample, scene, surfaces)
    else:
        for row in range(h):
            bank.add(work, now, row)
        for k in range(steps):
            advance(work, Step(dt / steps, index - 1, before + k * dt / steps, steps > 1), scene, surfaces)
            _keep_best(work, int(scene.most))
        _weigh(work, now, dt, sample, scene, surfaces)
    for row in range(old, fill[bank.WRITTEN]):
        work.log[row].serial = (index << SERIES) + row
    return bank.prune(work.bank, fill[bank.USED], scene), work.log[: fill[bank.WRITTEN]]


FOLLOWED: Final[Any] = types.Tuple((bank.BANK, bank.LOG, bank.LOG))
"""Hypotheses, best first; their events that are open; the events that became final, oldest first."""


@machine_code(FOLLOWED(bank.BANK, bank.LOG, REAL, ONE, TWO, TWO, COUNT, bank.SCENE, bank.SURFACES))
def follow(
    held: bank.Records,
    log: bank.Records,
    before: float,
    times: Array,
    positions: Array,
    sigmas: Array,
    first: int,
    scene: bank.Record,
    surfaces: bank.Records,
) -> Any:
    """The likely hypotheses after samples, from those before them: those that deny a final event are dropped.

    Events `scene.lag` samples old are final.

    Args:
        held, log, before: as for `explain`; the log has open events only.
        times: (n,) s, positions, sigmas: (n, 3) m, of samples from number `first` on.
    """
    final, count = np.empty(8, bank.LOGGED), 0
    for k in range(len(times)):
        held, log = explain(held, log, before, times[k], positions[k], sigmas[k], first + k, scene, surfaces)
        before, row = times[k], held[0].tip
        while row >= 0 and log[row].index >= first + k + 1 - scene.lag:
            row = log[row].before
        if row >= 0:
            decided = chain(row, log)
            if count + len(decided) > len(final):
                longer = np.empty(2 * (count + len(decided)), bank.LOGGED)
                longer[:count] = final[:count]
                final = longer
            final[count : count + len(decided)] = decided
            count += len(decided)
            held = held[: decide(held, log, row)]
        log = log[: compact(held, log, len(log))].copy()
    return held, log, final[:count]


@machine_code(NOTHING(bank.WORK, COUNT))
def _keep_best(work: bank.Work, most: int) -> None:
    """Drops all hypotheses but the best."""
    n = work.fill[bank.USED]
    if n > most:
        rows, old = np.empty(n, np.int64), work.bank[:n].copy()
        bank.rank(old, 0, n, rows)
        work.fill[bank.USED] = 0
        for place in range(most):
            bank.add(work, old, rows[place])


@machine_code(NOTHING(bank.WORK, bank.BANK, REAL, bank.SAMPLE, bank.SCENE, bank.SURFACES))
def _weigh(
    work: bank.Work, now: bank.Records, dt: float, sample: bank.Sample, scene: bank.Record, surfaces: bank.Records
) -> None:
    """Takes the sample into all predictions, and into those events that only a surprise suggests."""
    predicted = work.bank[: work.fill[bank.USED]].copy()
    surprise = bank.update(work, 0, sample, scene)
    others = work.fill[bank.USED]
    leave(work, predicted, sample, dt, scene)
    if surprise > scene.surprise or now[0].surface != bank.FLYING:
        hit(work, now, sample, dt, scene, surfaces)
        if dt < scene.short_gap:
            shift(work, predicted, sample, dt, scene)
    bank.update(work, others, sample, scene)
