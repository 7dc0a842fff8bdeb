"""Arithmetic of the segmentation in machine code: all hypotheses fly, are weighed and sorted; quiet samples at once."""

import math
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, FOUR, NOTHING, ONE, REAL, THREE, TWO
from ballfg.estimation.segmentation.bank import FLYING

DRAG, GRAVITY, JITTER, WIDE_FACTOR, OUTLIER_SPREAD, OUTLIER_DOUBT, SURPRISE, WINDOW, MARGIN, MATURE, MOST = range(11)
"""Places in the `numbers` of a scene: 1/m, m/s^2, s, -, m, nats, -, s, nats, samples, hypotheses."""
STRONGEST_DRAG: Final = 0.5
"""Largest share of its velocity that a ball may lose to drag in one step: keeps absurd velocities, as two outliers
1 ms apart give them, from growing without bound."""
SLOWEST_CLOSING: Final = 0.2
"""m/s. Bounds the time margin of a slow contact."""
GOOD, WIDE, OUTLIER = range(3)
"""The components of the noise, as in `Scene.log_shares`."""
NOT_QUIET: Final = -1
"""Returned by `quiet_sample` where the sample asks for more than one flight without events."""


@machine_code(NOTHING(THREE, FOUR, ONE, ONE, THREE, THREE, FOUR))
def fly_all(mean: Array, cov: Array, dt: Array, numbers: Array, drift: Array, after: Array, after_cov: Array) -> None:
    """Free flight; negative steps go back, and add noise like positive ones.

    Drag is linearised at the present speed, the same on the three axes: v' = (1 - k |v| dt) v + (b - g) dt.

    Args:
        mean: (h, 3, 3) axis by (p m, v m/s, b m/s^2).  cov: (h, 3, 3, 3).  dt: (h,) s.
        numbers, drift: of the scene.  after, after_cov: written, in the units of mean and cov.
    """
    left = np.empty((3, 3))
    for row in range(len(dt)):
        t = dt[row]
        step, half = abs(t), 0.5 * t * t
        speed = math.sqrt(mean[row, 0, 1] ** 2 + mean[row, 1, 1] ** 2 + mean[row, 2, 1] ** 2)
        loss = min(max(numbers[DRAG] * speed * t, -STRONGEST_DRAG), STRONGEST_DRAG)
        a, b = t * (1.0 - 0.5 * loss), 1.0 - loss
        for axis in range(3):
            p, v, slack = mean[row, axis, 0], mean[row, axis, 1], mean[row, axis, 2]
            after[row, axis, 0] = p + a * v + half * slack
            after[row, axis, 1] = b * v + t * slack
            after[row, axis, 2] = slack
            for k in range(3):
                left[0, k] = cov[row, axis, 0, k] + a * cov[row, axis, 1, k] + half * cov[row, axis, 2, k]
                left[1, k] = b * cov[row, axis, 1, k] + t * cov[row, axis, 2, k]
                left[2, k] = cov[row, axis, 2, k]
            for i in range(3):
                after_cov[row, axis, i, 0] = left[i, 0] + a * left[i, 1] + half * left[i, 2]
                after_cov[row, axis, i, 1] = b * left[i, 1] + t * left[i, 2]
                after_cov[row, axis, i, 2] = left[i, 2]
                for k in range(3):
                    noise = step * (drift[0, i, k] + step * (drift[1, i, k] + step * drift[2, i, k]))
                    after_cov[row, axis, i, k] += noise
        after[row, 2, 0] -= numbers[GRAVITY] * half
        after[row, 2, 1] -= numbers[GRAVITY] * t


@machine_code(NOTHING(THREE, FOUR, ONE, ONE, ONE, ONE, TWO, THREE, TWO, ONE))
def weigh(
    mean: Array,
    cov: Array,
    position: Array,
    sigma: Array,
    numbers: Array,
    log_shares: Array,
    innovation: Array,
    variance: Array,
    evidence: Array,
    surprise: Array,
) -> None:
    """What a sample says about each hypothesis, as a good, a wide and an outlying one.

    Constants that all share (3/2 log 2 pi) are left out.

    Args:
        mean, cov: (h, ...) predicted, m and m^2 among them.  position, sigma: (3,) m.  numbers, log_shares: of the
            scene.
        innovation: (h, 3) m, variance: (3, h, 3) m^2, evidence: (3, h) nats, of each component, surprise: (h,) squared
            whitened innovation of a good one; written.
    """
    for row in range(len(mean)):
        evidence[GOOD, row], evidence[WIDE, row], evidence[OUTLIER, row] = log_shares[0], log_shares[1], log_shares[2]
        surprise[row] = 0.0
        for axis in range(3):
            off = position[axis] - mean[row, axis, 0]
            innovation[row, axis] = off
            known = cov[row, axis, 0, 0]
            noise = (numbers[JITTER] * mean[row, axis, 1]) ** 2 + sigma[axis] ** 2
            variance[GOOD, row, axis] = known + noise
            variance[WIDE, row, axis] = known + noise * numbers[WIDE_FACTOR] ** 2
            variance[OUTLIER, row, axis] = known + numbers[OUTLIER_SPREAD] ** 2
            for component in range(3):
                spread = variance[component, row, axis]
                evidence[component, row] -= 0.5 * (off * off / spread + math.log(spread))
            surprise[row] += off * off / variance[GOOD, row, axis]


@machine_code(COUNT(ONE, COUNTS, COUNTS, ONE, COUNTS))
def kept_rows(score: Array, surface: Index, age: Index, numbers: Array, rows: Index) -> int:
    """The hypotheses worth keeping, best first.

    Hypotheses whose last event is old predict the same from now on if they are in the same mode, so the best of them
    stands for all (the Viterbi step).

    Args: score: (h,) nats.  surface, age: (h,).  numbers: of the scene.  rows: (h,) written.
    Returns: how many of the rows are kept.
    """
    h = len(score)
    for row in range(h):  # sorted as they come: few hypotheses, most of them in order
        place = row
        while place > 0 and score[rows[place - 1]] < score[row]:
            rows[place] = rows[place - 1]
            place -= 1
        rows[place] = row
    least, kept = score[rows[0]] - numbers[MARGIN], 0
    for place in range(h):
        row = rows[place]
        if not score[row] >= least or kept >= numbers[MOST]:
            break
        twin = False
        if age[row] >= numbers[MATURE]:
            for earlier in range(kept):
                other = rows[earlier]
                twin = twin or (age[other] >= numbers[MATURE] and surface[other] == surface[row])
        if not twin:
            rows[kept] = row
            kept += 1
    return kept


@machine_code(
    COUNT(
        *(THREE, FOUR, COUNTS, ONE, COUNTS, TWO),
        *(REAL, ONE, ONE, ONE, ONE, ONE, THREE),
        *(THREE, FOUR, ONE, COUNTS, TWO, COUNTS),
    )
)
def quiet_sample(
    mean: Array,
    cov: Array,
    surface: Index,
    score: Array,
    age: Index,
    shift: Array,
    dt: float,
    position: Array,
    sigma: Array,
    numbers: Array,
    log_shares: Array,
    centres: Array,
    drift: Array,
    new_mean: Array,
    new_cov: Array,
    new_score: Array,
    new_age: Index,
    new_shift: Array,
    rows: Index,
) -> int:
    """The next sample where nothing happens: all fly, none is near a surface, and the sample is a good one for all.

    Args:
        mean, cov, surface, score, age, shift: of a `Bank`.  dt: s, one step.  position, sigma: (3,) m.
        numbers, log_shares, centres, drift: of the scene.
        new_mean, new_cov, new_score, new_age, new_shift: written, those of the hypotheses that are kept, best first.
        rows: (h,) written, which these are.
    Returns: how many are kept; `NOT_QUIET` where something may happen, and nothing that was written counts.
    """
    h = len(score)
    for row in range(h):
        if surface[row] != FLYING:
            return NOT_QUIET
    after, after_cov = np.empty_like(mean), np.empty_like(cov)
    fly_all(mean, cov, np.full(h, dt), numbers, drift, after, after_cov)
    top = centres.max()
    for row in range(h):
        low = after[row, 2, 0] - shift[row, 2] + numbers[WINDOW] * min(after[row, 2, 1], -SLOWEST_CLOSING)
        if not low >= top:
            return NOT_QUIET
    innovation, variance = np.empty((h, 3)), np.empty((3, h, 3))
    evidence, surprise, weighed = np.empty((3, h)), np.empty(h), np.empty(h)
    weigh(after, after_cov, position, sigma, numbers, log_shares, innovation, variance, evidence, surprise)
    for row in range(h):
        good = evidence[GOOD, row]
        if not (good >= evidence[WIDE, row] and good - evidence[OUTLIER, row] >= numbers[OUTLIER_DOUBT]):
            return NOT_QUIET
        weighed[row] = score[row] + good
    if not surprise[weighed.argmax()] <= numbers[SURPRISE]:
        return NOT_QUIET
    kept = kept_rows(weighed, surface, age + 1, numbers, rows)
    for place in range(kept):
        row = rows[place]
        for axis in range(3):
            for i in range(3):
                gain = after_cov[row, axis, i, 0] / variance[GOOD, row, axis]
                new_mean[place, axis, i] = after[row, axis, i] + gain * innovation[row, axis]
                for k in range(3):
                    new_cov[place, axis, i, k] = after_cov[row, axis, i, k] - gain * after_cov[row, axis, 0, k]
            new_shift[place, axis] = 0.0 if age[row] + 1 >= numbers[MATURE] else shift[row, axis]
        new_score[place], new_age[place] = weighed[row], age[row] + 1
    return kept
