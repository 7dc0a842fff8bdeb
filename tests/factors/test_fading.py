"""A chain whose first state waits among the coefficients, against the elimination that keeps it to the end."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.factors.linear.elimination import Root, eliminate, padded

N, W, OWN, HELD = 400, 2, 1, 2
ROWS = W + 1  # of a state: its motion, its measurement


def chain(noise: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    """Rows of a point that moves with a constant velocity but for noise, and is measured with an unknown offset.

    Args: noise: of the velocity, per step; infinite: nothing ties a state to the next one.
    Returns: the system, as `eliminate` takes it, and where the rows of each state begin.
    """
    rng, p = np.random.default_rng(seed), OWN + HELD
    start = np.cumsum([0, W + ROWS, *[ROWS] * (N - 1), p])
    system = np.zeros((start[-1], padded(2 * W + p + 1)))
    before = np.array([[1.0, 0.1], [0.0, 1.0]]) / [[0.01], [noise]]
    after = -np.diag(1.0 / np.array([0.01, noise]))
    for i in range(N):
        rows = system[start[i + 1] - ROWS : start[i + 1]]
        if i + 1 < N:
            rows[:W, :W], rows[:W, W : 2 * W] = before, after
        rows[W, [0, 2 * W]] = 1.0 / 0.05
        rows[:, -1] = rng.normal(size=ROWS)
    system[:W, 2 * W + OWN : 2 * W + p], system[:W, :W] = before, after  # the state that waits moves into the chain
    system[-p:, 2 * W : 2 * W + p] = np.eye(p)
    return system, start


def reduced(system: np.ndarray, start: np.ndarray, held: int) -> Root:
    root = Root.empty(N, W, OWN + HELD)
    eliminate(system.copy(), start, W, held, root)
    return root


def _signed(rows: np.ndarray, own: int) -> np.ndarray:
    """Rows of R with a positive diagonal, which begins at a column: their signs mean nothing."""
    diagonal = np.diagonal(rows[..., own:], axis1=-2, axis2=-1)
    return rows * np.sign(diagonal)[..., None]


@pytest.mark.parametrize(("noise", "fades"), [(1.0, True), (0.1, True), (1e-6, False)])
def test_what_fades_may_be_dropped(noise, fades) -> None:
    """With all but no noise of the velocity, the first state tells of all others to the end: nothing is dropped."""
    system, start = chain(noise)
    whole, parted = reduced(system, start, 0), reduced(system, start, HELD)
    for expected, found, own in zip(whole, parted, (0, 2 * W), strict=True):
        scale = np.abs(expected).max(axis=-1, keepdims=True)
        np.testing.assert_allclose(_signed(found, own) / scale, _signed(expected, own) / scale, rtol=0.0, atol=1e-12)
    waiting = parted[0][:-1, :, 2 * W + OWN : -1]
    assert (waiting[-1] == 0.0).all() == fades


def test_the_covariance_of_what_waits_is_kept() -> None:
    """R^T R of the coefficients and of the first state is that of the dense normal equations."""
    system, start = chain(0.1)
    last = reduced(system, start, HELD).coefficients[:, 2 * W :]
    p, size = OWN + HELD, N * W
    dense = np.zeros((len(system), size + p))
    for i in range(N):
        rows = slice(start[i], start[i + 1])
        dense[rows, i * W : min((i + 2) * W, size)] = system[rows, : 2 * W if i + 1 < N else W]
    dense[:, size:] = system[:, 2 * W : 2 * W + p]
    information = dense.T @ dense
    kept = information[size:, size:] - information[size:, :size] @ np.linalg.solve(
        information[:size, :size], information[:size, size:]
    )
    np.testing.assert_allclose(last[:, :p].T @ last[:, :p], kept, rtol=1e-8, atol=1e-8 * np.abs(kept).max())
