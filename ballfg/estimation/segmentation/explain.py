"""Explains one sample in machine code: every hypothesis branches, is weighed, and the unlikely are dropped."""

import math
from typing import Any, Final

import numpy as np
from numba import types

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, NOTHING, ONE, REAL
from ballfg.estimation.segmentation.bank import (
    BANK,
    FLYING,
    HYPOTHESIS,
    LOG,
    LOGGED,
    NO_EVENT,
    SURFACES,
    USED,
    WRITTEN,
    Record,
    Records,
    add,
    pass_through,
)
from ballfg.estimation.segmentation.branches import MOST_ADDED, hit, leave, shift, start
from ballfg.estimation.segmentation.events import RESTART
from ballfg.estimation.segmentation.evidence import prune, rank, update
from ballfg.estimation.segmentation.scene import SCENE
from ballfg.estimation.segmentation.surface_contact import step

EXPLAINED: Final[Any] = types.Tuple((BANK, LOG))
"""Hypotheses, best first, and the events of all hypotheses during a sample."""


@machine_code(EXPLAINED(BANK, REAL, REAL, ONE, ONE, COUNT, SCENE, SURFACES))
def explain(
    bank: Records,
    before: float,
    time: float,
    position: Array,
    sigma: Array,
    sample: int,
    scene: Record,
    surfaces: Records,
) -> Any:
    """The hypotheses after a sample, from those before it.

    Args:
        bank: (h,) best first; none before the first sample.
        before: s, stamp of the last sample.
        time: s, of this one.
        position: (3,) m.
        sigma: (3,) m.
        sample: its index.
        scene, surfaces: of a `Scene`.
    Returns: the likely hypotheses, best first, and the log for their `tip`.
    """
    h, dt, now = len(bank), time - before, bank.copy()
    for row in range(h):
        now[row].tip = -1 - row
    gap = h > 0 and dt > scene.longest_gap
    steps = 1 if h == 0 or gap else max(1, math.ceil(dt / scene.longest_step))
    branched = max(h, int(scene.most)) * (1 + 2 * len(surfaces))
    work = np.empty(2 * (branched + MOST_ADDED + len(surfaces)), HYPOTHESIS)
    log = np.empty(steps * branched + 2 * len(work), LOGGED)
    fill = np.zeros(2, np.int64)
    if h == 0:
        start(work, fill, log, NO_EVENT, 0.0, position, sigma, sample, time, scene, surfaces)
    elif gap:
        pass_through(now[0], log, fill, RESTART, sample - 1, -1, time)
        start(work, fill, log, now[0].tip, now[0].score, position, sigma, sample, time, scene, surfaces)
    else:
        for row in range(h):
            add(work, fill, now, row)
        _predict(work, fill, log, before, dt, steps, sample - 1, scene, surfaces)
        _weigh(work, fill, log, now, dt, position, sigma, sample, time, scene, surfaces)
    return prune(work, fill[USED], scene), log[: fill[WRITTEN]].copy()


@machine_code(NOTHING(BANK, COUNTS, LOG, REAL, REAL, COUNT, COUNT, SCENE, SURFACES))
def _predict(
    work: Records,
    fill: Index,
    log: Records,
    before: float,
    dt: float,
    steps: int,
    interval: int,
    scene: Record,
    surfaces: Records,
) -> None:
    """All hypotheses at the next stamp, through the possible contacts on the way."""
    most = int(scene.most)
    for k in range(steps):
        step(work, fill, log, dt / steps, interval, before + k * dt / steps, steps > 1, scene, surfaces)
        if fill[USED] > most:
            rows = np.empty(fill[USED], np.int64)
            rank(work, 0, fill[USED], rows)
            old = work[: fill[USED]].copy()
            fill[USED] = 0
            for place in range(most):
                add(work, fill, old, rows[place])


@machine_code(NOTHING(BANK, COUNTS, LOG, BANK, REAL, ONE, ONE, COUNT, REAL, SCENE, SURFACES))
def _weigh(
    work: Records,
    fill: Index,
    log: Records,
    now: Records,
    dt: float,
    position: Array,
    sigma: Array,
    sample: int,
    time: float,
    scene: Record,
    surfaces: Records,
) -> None:
    """Updates all predictions by the sample, and adds those events that only a surprise suggests."""
    predicted, interval = work[: fill[USED]].copy(), sample - 1
    surprise = update(work, fill, log, 0, position, sigma, sample, time, scene)
    others = fill[USED]
    leave(work, fill, log, predicted, dt, interval, time, scene)
    if surprise > scene.surprise or now[0].surface != FLYING:
        hit(work, fill, log, now, position, dt, interval, time, scene, surfaces)
        if dt < scene.short_gap:
            shift(work, fill, log, predicted, position, sigma, dt, interval, time, scene)
    update(work, fill, log, others, position, sigma, sample, time, scene)
