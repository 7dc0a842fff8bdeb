"""Filters linearised tracks by a Kalman filter in machine code.

Of w numbers the first nine are the state; the next, up to d, are coefficients, which stay; the last three, if d < w,
are biases, which decay. So a transition is nine rows of numbers, then ones, then decays on the diagonal.

Rows of a covariance end with zeros, so that their k columns are a multiple of what one instruction adds at once: with w
columns, loops take a third longer.
"""

import math

import numpy as np

from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, FIVE, FLAG, FOUR, INDEX, NOTHING, ONE, REAL, THREE, TWO
from ballfg.factors.linear.four_at_once import padded
from ballfg.state import STATE_DIM

NEXT_FROM = 3
"""Number of samples that determine a state; the marginal likelihood counts the later ones."""
NEXT_TAIL = 4.0
"""Standard deviations, of the norm of three coordinates, beyond which the score of a next sample grows linearly; a
missed hit must not dominate the noise."""


@machine_code(NOTHING(COUNT, REAL, TWO, TWO))
def _keep(d, decay, x, result):
    """Writes the rows of x (w, k) that only ones and decays act on; zero for those of the state."""
    for i in range(len(x)):
        own = 0.0 if i < STATE_DIM else 1.0 if i < d else decay
        for j in range(x.shape[1]):
            result[i, j] = own * x[i, j]


@machine_code(NOTHING(TWO, REAL, TWO, TWO))
def move(transition, decay, x, result):
    """The product F x of a transition and x (w, k).

    Args: transition (d, d): of state and coefficients.  decay: of biases.
    """
    d, columns = len(transition), x.shape[1]
    _keep(d, decay, x, result)
    for i in range(STATE_DIM):
        for s in range(d):
            factor = transition[i, s]
            if factor != 0.0:
                for j in range(columns):
                    result[i, j] += factor * x[s, j]


@machine_code(NOTHING(TWO, REAL, TWO, TWO))
def pull(transition, decay, x, result):
    """The product F' x of a transition, as `move` takes it, and x (w, k)."""
    d, columns = len(transition), x.shape[1]
    _keep(d, decay, x, result)
    for s in range(STATE_DIM):
        for i in range(d):
            factor = transition[s, i]
            if factor != 0.0:
                for j in range(columns):
                    result[i, j] += factor * x[s, j]


@machine_code(NOTHING(TWO, TWO, TWO))
def multiply(x, y, result):
    """The product x y of two matrices (w, w)."""
    for i in range(len(x)):
        for j in range(len(x)):
            result[i, j] = 0.0
        for s in range(len(x)):
            for j in range(len(x)):
                result[i, j] += x[i, s] * y[s, j]


@machine_code(FLAG(TWO, TWO))
def invert_root(x, inverse):
    """Writes the inverse (3, 3) of the Cholesky root of x (3, 3); False if x is not positive definite."""
    root = np.zeros((3, 3))
    inverse[:] = 0.0
    for i in range(3):
        for j in range(i + 1):
            rest = x[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if i != j:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = math.sqrt(rest)
            else:
                return False
    for i in range(3):
        inverse[i, i] = 1.0 / root[i, i]
        for j in range(i):
            total = 0.0
            for k in range(j, i):
                total -= root[i, k] * inverse[k, j]
            inverse[i, j] = total / root[i, i]
    return True


@machine_code(NOTHING(TWO, ONE, REAL, THREE, ONE, ONE, ONE, TWO, THREE))
def _predict(transition, offset, decay, kicks, process, memory, m, p, work):
    """Moves mean m (w,) and covariance p (w, k) on by one interval; overwrites work (2, w, k)."""
    d, w = len(transition), len(m)
    before = m.copy()
    for i in range(STATE_DIM):
        m[i] = offset[i]
        for j in range(d):
            m[i] += transition[i, j] * before[j]
    for i in range(STATE_DIM, d):
        m[i] += offset[i]
    move(transition, decay, p, work[0])
    work[1, :, :w] = work[0, :, :w].T
    move(transition, decay, work[1], p)
    for q in range(len(process)):
        if np.trace(kicks[q]) != 0.0:  # few intervals have a contact
            for i in range(STATE_DIM):
                for j in range(STATE_DIM):
                    p[i, j] += process[q] * kicks[q, i, j]
    for i in range(d, w):
        m[i] *= decay
        p[i, i] += memory[i - d] * (1.0 - decay * decay)


@machine_code(REAL(COUNT, ONE, TWO, ONE, TWO, TWO, TWO, ONE, ONE))
def innovate(d, m, p, error, measured, seen, root, new, weighted):
    """Squared whitened innovation of a sample; NaN if the innovation's covariance S is not positive definite.

    Args:
        d: place of the bias in the mean m (w,), which is measured with the position; w if there is none.
        p: (w, w).  error: (3,) m, the sample, about the same origin as the mean.  measured: (3, 3), of its white error.

    Writes: seen (w, 3) = P H', root (3, 3), the inverse of that of S, new (3,), the whitened innovation, and
    weighted (3,), the innovation over S.
    """
    w, s = len(m), np.empty((3, 3))
    for i in range(w):
        for a in range(3):
            seen[i, a] = p[i, a] + (p[i, d + a] if d < w else 0.0)
    for a in range(3):
        for b in range(3):
            s[a, b] = seen[a, b] + (seen[d + a, b] if d < w else 0.0) + measured[a, b]
    if not invert_root(s, root):
        return np.nan
    square = 0.0
    for a in range(3):
        new[a] = 0.0
        for b in range(a + 1):
            new[a] += root[a, b] * (error[b] - m[b] - (m[d + b] if d < w else 0.0))
        square += new[a] * new[a]
    for a in range(3):
        weighted[a] = 0.0
        for c in range(a, 3):
            weighted[a] += root[c, a] * new[c]
    return square


@machine_code(NOTHING(TWO, TWO, ONE, ONE, TWO, TWO))
def update(seen, root, new, m, p, gain):
    """Updates mean m (w,) and covariance p (w, k) with a sample whose whitened innovation is `new`; writes its gain."""
    w, columns = p.shape
    whitened = np.zeros((3, columns))
    for i in range(w):
        for a in range(3):
            for b in range(a + 1):
                whitened[a, i] += root[a, b] * seen[i, b]
        for a in range(3):
            gain[i, a] = 0.0
            for b in range(a, 3):
                gain[i, a] += root[b, a] * whitened[b, i]
            m[i] += whitened[a, i] * new[a]
    for i in range(w):
        for a in range(3):
            for j in range(columns):
                p[i, j] -= whitened[a, i] * whitened[a, j]


@machine_code(NOTHING(COUNT, TWO, TWO, TWO, TWO, THREE))
def _join(d, gain, prior, measured, p, work):
    """The covariance after the first sample, A P A' + K R K' with A = 1 - K H.

    A difference would lose ten digits: the prior of the position is that much wider than the posterior. Overwrites
    `prior` (w, w) and `work` (2, w, k); p is (w, k).
    """
    w = len(p)
    kept, half = work[0], work[1]
    for i in range(w):
        for j in range(w):
            kept[i, j] = 1.0 if i == j else 0.0
        for a in range(3):
            kept[i, a] -= gain[i, a]
            if d < w:
                kept[i, d + a] -= gain[i, a]
    multiply(kept, prior, half)
    prior[:] = kept[:, :w].T
    multiply(half, prior, p)
    for a in range(3):
        for b in range(3):
            for i in range(w):
                for j in range(w):
                    p[i, j] += gain[i, a] * measured[a, b] * gain[j, b]


@machine_code(
    FLAG(FOUR, THREE, FIVE, TWO, TWO, TWO, FOUR, THREE, INDEX, TWO, TWO, THREE, FOUR, FOUR, FOUR, THREE, TWO, ONE),
    beside_others=True,
)
def filter_tracks(
    transitions, offsets, kicks, process, decays, memory, measured, errors, used, starts, priors,
    means, covariances, gains, roots, weighted, nis, nll,
):  # fmt: skip
    """Filters t tracks of n samples; False if a covariance is not positive definite.

    Args:
        transitions (t, n - 1, d, d), offsets (t, n - 1, d), kicks (t, n - 1, 7, 9, 9): the linearised motion.
        process (t, 7): multiples of the kicks.  decays (t, n - 1), memory (t, 3): of the biases.
        measured (t, n, 3, 3): covariance of a sample's white error.  errors (t, n, 3), used (t, n): the samples.
        starts (t, w), priors (t, w): mean and variances before the first sample.
    Writes: means (t, n, w), covariances (t, n, w, w), gains (t, n, w, 3), zero where a sample does not update,
        roots (t, n, 3, 3), inverse of the Cholesky root of the innovation's covariance S, weighted (t, n, 3), S^-1 e,
        nis (t, n), e' S^-1 e, and nll (t,), negative logarithm of the densities of next samples.
    """
    count, samples, w = means.shape
    d = transitions.shape[2]
    seen, new, m = np.empty((w, 3)), np.empty(3), np.empty(w)
    p, work = np.zeros((w, padded(w))), np.zeros((2, w, padded(w)))
    for t in range(count):
        nll[t] = 0.0
        m[:], p[:] = starts[t], 0.0
        for i in range(w):
            p[i, i] = priors[t, i]
        for k in range(samples):
            if k:
                offset, kick = offsets[t, k - 1], kicks[t, k - 1]
                _predict(transitions[t, k - 1], offset, decays[t, k - 1], kick, process[t], memory[t], m, p, work)
            root, gain = roots[t, k], gains[t, k]
            square = innovate(d, m, p, errors[t, k], measured[t, k], seen, root, new, weighted[t, k])
            if math.isnan(square):
                return False
            nis[t, k], gain[:] = square, 0.0
            if k >= NEXT_FROM and used[t, k]:
                tail = NEXT_TAIL * math.sqrt(square) - 0.5 * NEXT_TAIL * NEXT_TAIL
                nll[t] += 0.5 * square if square < NEXT_TAIL * NEXT_TAIL else tail
                nll[t] -= math.log(root[0, 0] * root[1, 1] * root[2, 2])
            if used[t, k]:
                if k == 0:
                    prior = p[:, :w].copy()
                update(seen, root, new, m, p, gain)
                if k == 0:
                    _join(d, gain, prior, measured[t, k], p, work)
            means[t, k], covariances[t, k] = m, p[:, :w]
    return True
