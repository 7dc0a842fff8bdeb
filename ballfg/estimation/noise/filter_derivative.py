"""Differentiates a Kalman filter over linearised tracks backward in machine code, from last sample to first.

A gain K minimises the covariance: to first order, a change of K does not change it. So with A = 1 - K H, S = H P H' + R
and the innovation e = y - H m, an update moves

    the covariance by A dP A' + K dR K',    the mean by A dm + (A dP H' - K dR) S^-1 e,
    e' S^-1 e by -2 (S^-1 e)' H dm - (S^-1 e)' dS S^-1 e,    log det S by trace(S^-1 dS).
"""

import math

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FIVE, FLAG, FOUR, INDEX, NOTHING, ONE, REAL, THREE, TWO
from ballfg.estimation.noise.filter_code import NEXT_FROM, NEXT_TAIL, pull
from ballfg.factors.linear.four_at_once import padded
from ballfg.state import STATE_DIM


@machine_code(NOTHING(COUNT, REAL, ONE, ONE))
def _lift(d, scale, y, m):
    """Add scale H' y to m (w,): to the rows of positions and of biases."""
    for a in range(3):
        for i in range(a, len(m), d):
            m[i] += scale * y[a]


@machine_code(NOTHING(COUNT, TWO, TWO, TWO))
def _lift_both(d, rows, block, p):
    """Add H' X + X' H + H' Y H to p (w, w), of rows X (3, w) and a block Y (3, 3)."""
    w = len(p)
    for a in range(3):
        for i in range(a, w, d):
            for j in range(w):
                p[i, j] += rows[a, j]
                p[j, i] += rows[a, j]
            for b in range(3):
                for j in range(b, w, d):
                    p[i, j] += block[a, b]


@machine_code(NOTHING(COUNT, TWO, TWO, ONE, REAL, FLAG, REAL, ONE, TWO, TWO))
def _before_update(d, gain, root, weighted, square, updated, share, m, p, to_measured):
    """Derivatives m (w,), p (w, w) by mean and covariance before an update, from those after it, and (3, 3) by R.

    Args:
        gain, root, weighted, square, updated: of the update, as the filter wrote them.
        share: derivative by the negative logarithm of the sample's density.
    """
    w = len(m)
    slope = share * (0.5 if square < NEXT_TAIL * NEXT_TAIL else 0.5 * NEXT_TAIL / math.sqrt(square))  # by e' S^-1 e
    rows, along, half, block = np.zeros((3, w)), np.zeros(3), np.zeros(3), np.zeros((3, 3))
    if updated:
        half[:] = 0.5 * weighted
        for i in range(w):
            for a in range(3):
                along[a] += gain[i, a] * m[i]
                for j in range(w):
                    rows[a, i] -= p[i, j] * gain[j, a]
    for a in range(3):
        for b in range(3):
            for i in range(w):
                block[a, b] -= gain[i, a] * rows[b, i]
            for c in range(max(a, b), 3):
                block[a, b] += 0.5 * share * root[c, a] * root[c, b]
            block[a, b] -= slope * weighted[a] * weighted[b]
            to_measured[a, b] = block[a, b] - along[a] * half[b] - along[b] * half[a]
    _lift(d, -1.0, along, m)
    for a in range(3):
        rows[a] += half[a] * m
    _lift_both(d, rows, block, p)
    _lift(d, -2.0 * slope, weighted, m)


@machine_code(REAL(TWO, REAL, THREE, ONE, ONE, TWO, ONE, TWO, ONE, ONE, THREE))
def _before_prediction(transition, decay, kicks, memory, before, spread, m, p, to_process, to_memory, work):
    """Derivatives by mean and covariance before an interval, from those after it; adds those by its noise.

    Args: before (w,), spread (w, w): mean and covariance at its begin.  work (2, w, k) is written to.
    Returns: the derivative by the decay.
    """
    d, w, to_decay = len(transition), len(m), 0.0
    for q in range(len(to_process)):
        if np.trace(kicks[q]) != 0.0:
            for i in range(STATE_DIM):
                for j in range(STATE_DIM):
                    to_process[q] += kicks[q, i, j] * p[i, j]
    pull(transition, decay, p, work[0])
    work[1, :, :w] = work[0, :, :w].T
    for i in range(d, w):
        to_memory[i - d] += p[i, i] * (1.0 - decay * decay)
        to_decay += m[i] * before[i] - 2.0 * decay * memory[i - d] * p[i, i]
        for s in range(w):
            to_decay += 2.0 * work[1, i, s] * spread[s, i]
    pull(transition, decay, work[1], p)
    for i in range(w):  # rounding would make it asymmetric, more so from step to step
        for j in range(i):
            p[i, j] = p[j, i] = 0.5 * (p[i, j] + p[j, i])
    after = m.copy()
    for i in range(w):
        m[i] = 0.0 if i < STATE_DIM else after[i] if i < d else decay * after[i]
    for s in range(STATE_DIM):
        for i in range(d):
            m[i] += transition[s, i] * after[s]
    return to_decay


@machine_code(
    NOTHING(
        FOUR, FIVE, TWO, TWO, INDEX, THREE, FOUR, FOUR, FOUR, THREE, TWO,
        THREE, FOUR, ONE, TWO, TWO, TWO, TWO, FOUR,
    ),
    beside_others=True,
)  # fmt: skip
def pull_back(
    transitions, kicks, decays, memory, used, means, covariances, gains, roots, weighted, nis,
    by_mean, by_covariance, by_following, to_process, to_decays, to_memory, to_priors, to_measured,
):  # fmt: skip
    """The derivatives of a function of the results of `filter_tracks` by the noise.

    Args:
        transitions, kicks, decays, memory, used: arguments of the filter.
        means, covariances, gains, roots, weighted, nis: its results.
        by_mean (t, n, w), by_covariance (t, n, w, w), by_following (t,): derivatives of the function by these; the
            first two with n = 0 if it does not depend on them.
    Writes: to_process (t, 7), to_decays (t, n - 1), to_memory (t, 3), to_priors (t, w), to_measured (t, n, 3, 3).
    """
    count, samples, w = means.shape
    d = transitions.shape[2]
    m, p, work = np.empty(w), np.zeros((w, padded(w))), np.zeros((2, w, padded(w)))
    for t in range(count):
        m[:], p[:], to_process[t], to_memory[t] = 0.0, 0.0, 0.0, 0.0
        for k in range(samples - 1, -1, -1):
            if by_mean.shape[1]:
                for i in range(w):
                    m[i] += by_mean[t, k, i]
                    for j in range(w):
                        p[i, j] += 0.5 * (by_covariance[t, k, i, j] + by_covariance[t, k, j, i])
            seen, square = used[t, k] != 0, nis[t, k]
            share = by_following[t] if seen and k >= NEXT_FROM else 0.0
            _before_update(d, gains[t, k], roots[t, k], weighted[t, k], square, seen, share, m, p, to_measured[t, k])
            if k:
                to_decays[t, k - 1] = _before_prediction(
                    transitions[t, k - 1], decays[t, k - 1], kicks[t, k - 1], memory[t], means[t, k - 1],
                    covariances[t, k - 1], m, p, to_process[t], to_memory[t], work,
                )  # fmt: skip
        for i in range(w):
            to_priors[t, i] = p[i, i]
