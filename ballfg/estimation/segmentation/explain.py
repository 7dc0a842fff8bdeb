"""Explains one sample in machine code: every hypothesis branches, is weighed, and the unlikely are dropped."""

import math
from typing import Any, Final

import numpy as np
from numba import types

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, NOTHING, ONE, REAL
from ballfg.estimation.segmentation.bank import (
    BANK,
    FLYING,
    HYPOTHESIS,
    LOG,
    LOGGED,
    NO_EVENT,
    SAMPLE,
    SURFACES,
    USED,
    WORK,
    WRITTEN,
    Record,
    Records,
    Sample,
    Work,
    add,
    pass_through,
)  # fmt: skip
from ballfg.estimation.segmentation.branches import MOST_ADDED, hit, leave, shift, start
from ballfg.estimation.segmentation.events import RESTART
from ballfg.estimation.segmentation.evidence import prune, rank, update
from ballfg.estimation.segmentation.scene import SCENE
from ballfg.estimation.segmentation.surface_contact import Step, advance

EXPLAINED: Final[Any] = types.Tuple((BANK, LOG))
"""Hypotheses, best first, and the events of all hypotheses during a sample."""


@machine_code(EXPLAINED(BANK, REAL, REAL, ONE, ONE, COUNT, SCENE, SURFACES))
def explain(
    bank: Records,
    before: float,
    time: float,
    position: Array,
    sigma: Array,
    index: int,
    scene: Record,
    surfaces: Records,
) -> Any:
    """The hypotheses after a sample, from those before it.

    Args:
        bank: (h,) best first; none before the first sample.
        before: s, stamp of the last sample.
        time, position, sigma, index: of this one, as in `Sample`, with its number.
        scene, surfaces: of a `Scene`.
    Returns: the likely hypotheses, best first, and the log for their `tip`.
    """
    h, dt, now = len(bank), time - before, bank.copy()
    for row in range(h):
        now[row].tip = -1 - row
    gap = h > 0 and dt > scene.longest_gap
    steps = 1 if h == 0 or gap else max(1, math.ceil(dt / scene.longest_step))
    branched = max(h, int(scene.most)) * (1 + 2 * len(surfaces))
    room, fill = 2 * (branched + MOST_ADDED + len(surfaces)), np.zeros(2, np.int64)
    work = Work(np.empty(room, HYPOTHESIS), np.empty(steps * branched + 2 * room, LOGGED), fill)
    sample = Sample(position, sigma, index, time)
    if h == 0:
        start(work, NO_EVENT, 0.0, sample, scene, surfaces)
    elif gap:
        pass_through(now[0], work, RESTART, index - 1, -1, time)
        start(work, now[0].tip, now[0].score, sample, scene, surfaces)
    else:
        for row in range(h):
            add(work, now, row)
        for k in range(steps):
            advance(work, Step(dt / steps, index - 1, before + k * dt / steps, steps > 1), scene, surfaces)
            _keep_best(work, int(scene.most))
        _weigh(work, now, dt, sample, scene, surfaces)
    return prune(work.bank, fill[USED], scene), work.log[: fill[WRITTEN]].copy()


@machine_code(NOTHING(WORK, COUNT))
def _keep_best(work: Work, most: int) -> None:
    """Drops all hypotheses but the best."""
    n = work.fill[USED]
    if n > most:
        rows, old = np.empty(n, np.int64), work.bank[:n].copy()
        rank(old, 0, n, rows)
        work.fill[USED] = 0
        for place in range(most):
            add(work, old, rows[place])


@machine_code(NOTHING(WORK, BANK, REAL, SAMPLE, SCENE, SURFACES))
def _weigh(work: Work, now: Records, dt: float, sample: Sample, scene: Record, surfaces: Records) -> None:
    """Takes the sample into all predictions, and into those events that only a surprise suggests."""
    predicted = work.bank[: work.fill[USED]].copy()
    surprise = update(work, 0, sample, scene)
    others = work.fill[USED]
    leave(work, predicted, sample, dt, scene)
    if surprise > scene.surprise or now[0].surface != FLYING:
        hit(work, now, sample, dt, scene, surfaces)
        if dt < scene.short_gap:
            shift(work, predicted, sample, dt, scene)
    update(work, others, sample, scene)
