"""Weighs hypotheses by the evidence of a sample, and keeps the likely ones."""

import math
from typing import Any, Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, NOTHING, ONE, REAL
from ballfg.estimation.segmentation.bank import (
    BANK,
    ONE_HYPOTHESIS,
    SAMPLE,
    SCENE,
    USED,
    WORK,
    Record,
    Records,
    Sample,
    Work,
    add,
    pass_through,
)  # fmt: skip
from ballfg.estimation.segmentation.events import OUTLIER, WIDE

AS_GOOD, AS_WIDE, AS_OUTLIER = range(3)
"""The components of the noise, as in a scene's `log_shares`."""
SURPRISE: Final = 3
"""Index after the evidences of the components: squared whitened innovation of a good sample."""


@machine_code(REAL(WORK, COUNT, SAMPLE, SCENE))
def update(work: Work, first: int, sample: Sample, scene: Record) -> float:
    """Takes a sample into every hypothesis from row `first` on: its noise component, the Kalman update, the evidence.

    If the prediction is too uncertain to decide, the sample is also tried as an outlier: those hypotheses come last.
    This happens where the ball's place is hardly known: at its second sample, and at the first ones after a hit or a
    gap. Explanations that are far behind already are not multiplied.

    Returns: squared whitened innovation, as of a good sample, of the hypothesis that is the best afterwards.
    """
    bank, n, best, surprise = work.bank, work.fill[USED], -math.inf, 0.0
    evidence = np.empty((n - first, 4))
    for row in range(first, n):
        said = evidence[row - first]
        weigh(bank[row], sample.position, sample.sigma, scene, said)
        for component in range(3):
            if bank[row].score + said[component] > best:
                best, surprise = bank[row].score + said[component], said[SURPRISE]
    for row in range(first, n):
        said = evidence[row - first]
        component = AS_GOOD
        for other in (AS_WIDE, AS_OUTLIER):
            component = other if said[other] > said[component] else component
        margin = said[component] - said[AS_OUTLIER]
        apart = 0.0 < margin < scene.outlier_doubt
        if apart and bank[row].score + said[AS_OUTLIER] > best - scene.doubt_margin:
            lost = bank[add(work, bank, row)]
            lost.score += said[AS_OUTLIER]
            pass_through(lost, work, OUTLIER, sample.number, -1, sample.time)
        _take_in(bank[row], sample.position, sample.sigma, component, scene)
        bank[row].score += said[component]
        if component != AS_GOOD:
            kind = WIDE if component == AS_WIDE else OUTLIER
            pass_through(bank[row], work, kind, sample.number, -1, sample.time)
    return surprise


@machine_code(REAL(ONE_HYPOTHESIS, COUNT, REAL, COUNT, SCENE))
def _variance(h: Record, axis: int, sigma: float, component: int, scene: Record) -> float:
    """m^2, of the innovation of one coordinate, for a sample of a component."""
    if component == AS_OUTLIER:
        return h.cov[axis, 0, 0] + scene.outlier_spread**2
    noise = (scene.stamp_jitter * h.mean[axis, 1]) ** 2 + sigma**2
    return h.cov[axis, 0, 0] + (noise * scene.wide_factor**2 if component == AS_WIDE else noise)


@machine_code(NOTHING(ONE_HYPOTHESIS, ONE, ONE, SCENE, ONE))
def weigh(h: Record, position: Array, sigma: Array, scene: Record, said: Array) -> None:
    """Writes the evidence of a sample for a predicted hypothesis, without the common constant (3/2 log 2 pi).

    Args: said: (4,) nats, of a good sample, a wide one and an outlier; and the squared innovation.
    """
    said[SURPRISE] = 0.0
    for component in range(3):
        said[component] = scene.log_shares[component]
        for axis in range(3):
            off = position[axis] - h.mean[axis, 0]
            spread = _variance(h, axis, sigma[axis], component, scene)
            said[component] -= 0.5 * (off * off / spread + math.log(spread))
            if component == AS_GOOD:
                said[SURPRISE] += off * off / spread


@machine_code(NOTHING(ONE_HYPOTHESIS, ONE, ONE, COUNT, SCENE))
def _take_in(h: Record, position: Array, sigma: Array, component: int, scene: Record) -> None:
    """The Kalman update with a sample of a component; an outlier changes nothing."""
    if component == AS_OUTLIER:
        return
    h.age += 1
    gain, first = np.empty(3), np.empty(3)
    for axis in range(3):
        spread = _variance(h, axis, sigma[axis], component, scene)
        off = position[axis] - h.mean[axis, 0]
        for i in range(3):
            gain[i], first[i] = h.cov[axis, i, 0] / spread, h.cov[axis, 0, i]
        for i in range(3):
            h.mean[axis, i] += gain[i] * off
            for k in range(3):
                h.cov[axis, i, k] -= gain[i] * first[k]


@machine_code(NOTHING(BANK, COUNT, COUNT, COUNTS))
def rank(bank: Records, first: int, stop: int, rows: Index) -> None:
    """Writes the rows first..stop - 1 of a bank, best first; equal ones in their order."""
    for row in range(first, stop):  # sorted as they come: few hypotheses, most of them in order
        place = row - first
        while place > 0 and bank[rows[place - 1]].score < bank[row].score:
            rows[place] = rows[place - 1]
            place -= 1
        rows[place] = row


@machine_code(BANK(BANK, COUNT, SCENE))
def prune(bank: Records, n: int, scene: Record) -> Any:
    """Selects the likely ones of the first n hypotheses, best first, and accepts a tracker shift that has lasted long.

    Hypotheses in the same mode whose last event is old have the same predictions, so the best of them represents all
    (the Viterbi step).
    """
    rows = np.empty(n, np.int64)
    rank(bank, 0, n, rows)
    most, count = int(scene.most), 0
    kept = np.empty(min(n, most), bank.dtype)
    least = bank[rows[0]].score - scene.margin
    for place in range(n):
        h = bank[rows[place]]
        if not h.score >= least or count >= most:
            break
        old, twin = h.age >= scene.mature, False
        if old:
            for earlier in range(count):
                other = kept[earlier]
                twin = twin or (other.age >= scene.mature and other.surface == h.surface)
        if twin:
            continue
        kept[count] = h
        if old:
            for axis in range(3):
                kept[count].shift[axis] = 0.0
        count += 1
    return kept[:count]
