"""Explains the samples of a track by the modes of a ball, in machine code: the most likely chain of events."""

import math
from typing import Any, Final

import numpy as np
from numba import types

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FLAG, NOTHING, ONE, REAL, TWO
from ballfg.estimation.flights import modes
from ballfg.estimation.segmentation import bank
from ballfg.estimation.segmentation.log import chain, compact
from ballfg.estimation.segmentation.surface_contact import forget

RATE: Final = 1.0  # 1/s. Prior rate of every event
SHORTEST: Final = 1e-3  # s. Least interval for the price of an event
PRICES: Final = np.array([0.0, 1.0, 4.0, 3.0, 4.0])
"""nats in addition to the prior rate: none, of a bounce, a strike, a change of the mode, a shift."""
LETTING_GO: Final = 1.0  # nats, besides, of a hand that lets a ball fly or roll
BRIEF: Final = 8.0  # nats, the price of the end of a flight in a hand that has just begun
BRIEFLY: Final = 0.1  # s. Time constant with which that price fades
BRIEF_HOLD: Final = 20.0
"""nats, of a flight that begins just after a hold, roll or rest did: what a hand cannot hold as briefly is a strike."""
BRIEFLY_HELD: Final = 0.05  # s
BRANCHES: Final = 6 * 7 + 4  # Largest number of hypotheses that events add to a sample
SPARE: Final = 200_000  # Rows of the log from which it is compacted


@machine_code(NOTHING(bank.WORK, COUNT, COUNT, COUNT, REAL))
def _note(work: bank.Work, row: int, kind: int, index: int, dt: float) -> None:
    """Lets a hypothesis pass through an event of an interval, at its price; the new mode is written with it."""
    h = work.bank[row]
    h.score += math.log(-math.expm1(-RATE * max(dt, SHORTEST))) - PRICES[kind]
    bank.pass_through(h, work, kind, index, h.surface, 0.0)


@machine_code(REAL(bank.ONE_HYPOTHESIS, REAL))
def _brevity(h: bank.Record, dt: float) -> float:
    """nats, the price of the change from flight to a hand, or from anything else to flight: brief modes are rare."""
    if h.surface == bank.FLYING:
        return BRIEF * math.exp(-h.age * dt / BRIEFLY)
    return BRIEF_HOLD * math.exp(-h.age * dt / BRIEFLY_HELD)


@machine_code(NOTHING(bank.WORK, bank.BANK, COUNT, COUNT, REAL, FLAG, bank.SCENE))
def _branch(
    work: bank.Work, kept: bank.Records, place: int, index: int, dt: float, hands: bool, scene: bank.Record
) -> None:
    """Adds the changes and events that the best hypothesis of a mode may have in the interval before a sample."""
    mode = kept[place].surface
    brief = _brevity(kept[place], dt)
    for other in modes.MODES:
        if other == mode or (modes.HANDLED <= other <= modes.SWAYED and not hands):
            continue
        row = bank.add(work, kept, place)
        modes.enter(work.bank[row], other, scene)
        _note(work, row, modes.CHANGE, index, dt)
        if modes.HANDLED <= mode <= modes.SWAYED and modes.HANDLED <= other <= modes.SWAYED:
            work.bank[row].score += PRICES[modes.CHANGE]
        if modes.HANDLED <= mode <= modes.SWAYED and other in (modes.ROLLING, bank.FLYING):
            work.bank[row].score -= LETTING_GO
        if other <= modes.SWAYED and (mode == bank.FLYING or other == bank.FLYING):
            work.bank[row].score -= brief
    if mode == bank.FLYING:
        row = bank.add(work, kept, place)
        modes.strike(work.bank[row], dt, scene)
        _note(work, row, modes.STRIKE, index, dt)
        row = bank.add(work, kept, place)
        modes.shift(work.bank[row], scene)
        _note(work, row, modes.SHIFT, index, dt)
        if hands:
            row = bank.add(work, kept, place)
            modes.stop(work.bank[row], dt)
            modes.enter(work.bank[row], modes.HANDLED, scene)
            _note(work, row, modes.CHANGE, index, dt)
            work.bank[row].score -= brief
        row = bank.add(work, kept, place)
        if modes.bounce(work.bank[row], dt, scene):
            _note(work, row, modes.BOUNCE, index, dt)
        else:
            work.fill[bank.USED] -= 1


@machine_code(NOTHING(bank.WORK, bank.SAMPLE, FLAG, bank.SCENE))
def _begin(work: bank.Work, sample: bank.Sample, hands: bool, scene: bank.Record) -> None:
    """One hypothesis for each mode after a first sample."""
    for mode in modes.MODES:
        if modes.HANDLED <= mode <= modes.SWAYED and not hands:
            continue
        row = work.fill[bank.USED]
        work.fill[bank.USED] += 1
        h = work.bank[row]
        h.score, h.tip = 0.0, bank.NO_EVENT
        speed = scene.velocity_spread if mode == bank.FLYING else modes.HAND_SPEED if mode != modes.STILL else 0.0
        pull = scene.slack if mode == bank.FLYING else modes.PULLS[mode]
        forget(h, mode, sample.position, scene.outlier_spread**2, speed, pull)
        if mode == modes.ROLLING:
            h.cov[2, 1, 1], h.cov[2, 2, 2] = modes.SLOPE**2, 0.0
        bank.pass_through(h, work, modes.CHANGE, -1, mode, 0.0)
    bank.update(work, 0, sample, scene)


@machine_code(types.Tuple((bank.LOG, REAL))(ONE, TWO, TWO, FLAG, bank.SCENE))
def decode(times: Array, positions: Array, sigmas: Array, hands: bool, scene: bank.Record) -> Any:
    """The events of the most likely explanation, oldest first.

    Args:
        times: (n,) s.  positions, sigmas: (n, 3) m.  hands: False if no hand may touch the ball.  scene: of a `Scene`.
    Returns: the events, whose `surface` is the mode from there on; and the log evidence, nats.
    """
    n, most = len(times), int(scene.most)
    room = 2 * (most + BRANCHES)
    work = bank.Work(np.empty(room, bank.HYPOTHESIS), np.empty(SPARE + 4 * room, bank.LOGGED), np.zeros(2, np.int64))
    _begin(work, bank.Sample(positions[0], sigmas[0], 0, times[0]), hands, scene)
    kept = bank.prune(work.bank, work.fill[bank.USED], scene)
    for i in range(1, n):
        dt = times[i] - times[i - 1]
        work.fill[bank.USED] = 0
        if work.fill[bank.WRITTEN] > SPARE:
            work = _roomy(kept, work, 4 * room)
        for row in range(len(kept)):
            bank.add(work, kept, row)
        seen = np.zeros(8, np.int64)
        for row in range(len(kept)):
            mode = kept[row].surface
            if seen[mode + 1] == 0:
                seen[mode + 1] = 1
                _branch(work, kept, row, i - 1, dt, hands, scene)
        for row in range(work.fill[bank.USED]):
            modes.move(work.bank[row], dt, scene)
        bank.update(work, 0, bank.Sample(positions[i], sigmas[i], i, times[i]), scene)
        kept = bank.prune(work.bank, work.fill[bank.USED], scene)
    dt, best, last = (times[n - 1] - times[0]) / max(n - 1, 1), 0, -math.inf
    for row in range(len(kept)):
        if kept[row].score - _brevity(kept[row], dt) > last:
            best, last = row, kept[row].score - _brevity(kept[row], dt)
    return chain(kept[best].tip, work.log), last


@machine_code(bank.WORK(bank.BANK, bank.WORK, COUNT))
def _roomy(kept: bank.Records, work: bank.Work, spare: int) -> Any:
    """The same work with a compacted log, which is made longer where its events fill most of it."""
    count = compact(kept, work.log, work.fill[bank.WRITTEN])
    work.fill[bank.WRITTEN] = count
    if 2 * count < len(work.log):
        return work
    longer = np.empty(2 * len(work.log) + spare, bank.LOGGED)
    longer[:count] = work.log[:count]
    return bank.Work(work.bank, longer, work.fill)
