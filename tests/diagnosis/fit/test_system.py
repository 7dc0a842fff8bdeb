"""Elimination stretch by stretch against one dense least-squares problem with everything in it."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import lsq_linear

from ballfg.diagnosis.fit.system import System, by_track
from ballfg.diagnosis.hypotheses.signatures import Signatures

N, M, STATE, Q, P = 5, 40, 9, 3, 2
TRACK = np.array([0, 0, 1, 2, 2])
PRECISION = np.array([0.5, 3.0, 20.0])


@pytest.fixture(scope="module")
def system():
    rng = np.random.default_rng(0)
    return System(rng.normal(size=(N, M)), rng.normal(size=(N, M, STATE)), rng.normal(size=(N, M, Q + P)))


def stacked(system):
    """(N M, N STATE) of all first states, (N M, Q + P) of what is common, (N M,) residual."""
    states = np.zeros((N * M, N * STATE))
    for i in range(N):
        states[i * M : (i + 1) * M, i * STATE : (i + 1) * STATE] = system.by_start[i]
    return states, system.by_common.reshape(N * M, -1), system.residual.ravel()


def off(columns, nuisance):
    """What least squares with `nuisance` leaves of columns."""
    return columns - nuisance @ np.linalg.lstsq(nuisance, columns, rcond=None)[0]


def projected(system):
    """Columns and residual with the part that first states absorb taken away."""
    return system.columns - system.by_start @ system.eliminated().solved


def test_projected_columns_are_what_first_states_leave(system):
    states, common, residual = stacked(system)
    dense = off(np.column_stack((common, residual)), states)
    np.testing.assert_allclose(projected(system).reshape(N * M, -1), dense, atol=1e-12)
    gram = system.eliminated().gram
    np.testing.assert_allclose(gram.sum(0), dense.T @ dense, atol=1e-10)
    np.testing.assert_allclose(gram[2], dense[2 * M : 3 * M].T @ dense[2 * M : 3 * M], atol=1e-11)


def test_a_number_of_which_no_sample_tells_stays(system):
    """As of a stretch whose samples are all outliers: it takes no part, and the others are as without it."""
    by_start = system.by_start.copy()
    by_start[1, :, :6] = 0.0
    lost = System(system.residual, by_start, system.by_common)
    dense = off(lost.columns[1], by_start[1, :, 6:])
    np.testing.assert_allclose(projected(lost)[1], dense, atol=1e-12)
    np.testing.assert_array_equal(projected(lost)[2:], projected(system)[2:])
    assert (lost.eliminated().start_step(np.ones(Q + P))[1, :6] == 0.0).all()


def test_about_a_path_far_off_squares_overflow_without_a_warning(system):
    """A refit may try one: what its system gives is not finite, and it loses."""
    by_common = system.by_common.copy()
    by_common[1, :, 0] *= 1e200
    far = System(system.residual, system.by_start, by_common).eliminated()
    assert np.isinf(far.gram[1, 0, 0])
    np.testing.assert_array_equal(far.gram[[0, 2, 3, 4]], system.eliminated().gram[[0, 2, 3, 4]])


@pytest.mark.parametrize("damping", [0.0, 0.3])
def test_the_step_is_that_of_the_dense_normal_equations(system, damping):
    states, common, residual = stacked(system)
    precision, pull = np.append(PRECISION, [0.0, 0.0]), np.array([0.3, -1.0, 2.0, 0.0, 0.0])
    every = np.column_stack((common, states))
    hessian = every.T @ every
    right = every.T @ residual
    hessian[: Q + P, : Q + P] += np.diag(precision)
    right[: Q + P] += pull
    if damping == 0.0:
        step = np.linalg.solve(hessian, right)
    else:  # first states are damped on their own diagonal, what is common on that of its Schur complement
        own = hessian[Q + P :, Q + P :]
        own[np.diag_indices_from(own)] *= 1 + damping
        across = hessian[: Q + P, Q + P :]
        schur = hessian[: Q + P, : Q + P] - across @ np.linalg.solve(own, across.T)
        schur[np.diag_indices_from(schur)] *= 1 + damping
        shared = np.linalg.solve(schur, right[: Q + P] - across @ np.linalg.solve(own, right[Q + P :]))
        step = np.append(shared, np.linalg.solve(own, right[Q + P :] - across.T @ shared))
    eliminated = system.eliminated(damping)
    endless = np.full(Q + P, np.inf)
    shared = eliminated.common_step(precision, pull, -endless, endless, damping)
    np.testing.assert_allclose(shared, step[: Q + P], atol=1e-11)
    np.testing.assert_allclose(eliminated.start_step(shared).ravel(), step[Q + P :], atol=1e-11)


def test_a_limited_step_is_the_best_one_within_its_limits(system):
    """A bounded least squares over everything; where a limit is not met nothing changes."""
    states, common, residual = stacked(system)
    precision = np.append(PRECISION, [0.0, 0.0])
    eliminated, endless = system.eliminated(), np.full(Q + P, np.inf)
    pull = np.zeros(Q + P)
    unlimited = eliminated.common_step(precision, pull, -endless, endless)
    high = endless.copy()
    high[0] = unlimited[0] - 0.5 * abs(unlimited[0])
    priors = np.zeros((Q, Q + P + states.shape[1]))
    priors[:, :Q] = np.diag(np.sqrt(PRECISION))
    rows = np.concatenate((np.column_stack((common, states)), priors))
    bounds = np.full(rows.shape[1], np.inf)
    upper = bounds.copy()
    upper[0] = high[0]
    best = lsq_linear(rows, np.append(residual, np.zeros(Q)), (-bounds, upper), tol=1e-14).x
    limited = eliminated.common_step(precision, pull, -endless, high)
    np.testing.assert_allclose(limited, best[: Q + P], atol=1e-6)
    assert limited[0] == high[0]
    assert abs(limited[1:] - unlimited[1:]).max() > 1e-3


def test_sums_over_the_stretches_of_each_track(system):
    gram = system.eliminated().gram
    found = by_track(gram, TRACK + 7)  # any numbers
    for i in range(3):
        np.testing.assert_allclose(found[i], gram[i == TRACK].sum(0), atol=1e-13)


def test_efficient_scores_are_those_of_the_dense_projection(system):
    """Priors of what is common are rows of their own; each track's score is its part of the dense product."""
    states, common, residual = stacked(system)
    gram = by_track(system.eliminated().gram, TRACK)
    efficient = Signatures(gram, PRECISION, Q).efficient()
    rows = np.concatenate((off(common, states), np.column_stack((np.diag(np.sqrt(PRECISION)), np.zeros((Q, P))))))
    nuisance, wanted = rows[:, :Q], rows[:, Q:]
    left = off(wanted, nuisance)
    np.testing.assert_allclose(
        efficient.information.sum(0) + efficient.prior, left.T @ left, atol=1e-10, err_msg="information"
    )
    np.testing.assert_allclose(efficient.prior, left[-Q:].T @ left[-Q:], atol=1e-11)
    np.testing.assert_allclose(efficient.score.sum(0), left[:-Q].T @ off(residual, states), atol=1e-10)
    for i in range(3):
        own = np.repeat(i == TRACK, M)
        np.testing.assert_allclose(efficient.score[i], left[:-Q][own].T @ off(residual, states)[own], atol=1e-11)
        np.testing.assert_allclose(efficient.information[i], left[:-Q][own].T @ left[:-Q][own], atol=1e-10)
    np.testing.assert_allclose(efficient.raw, (off(common, states)[:, Q:] ** 2).sum(0), atol=1e-10)


def test_without_priors_the_score_is_of_the_whole_least_squares_problem(system):
    """One step of the candidates is what they would be in the joint fit."""
    states, common, residual = stacked(system)
    efficient = Signatures(by_track(system.eliminated().gram, TRACK), np.zeros(Q), Q).efficient()
    estimate = np.linalg.solve(efficient.information.sum(0), efficient.score.sum(0))
    joint = np.linalg.lstsq(np.column_stack((common, states)), residual, rcond=None)[0]
    np.testing.assert_allclose(estimate, joint[Q : Q + P], atol=1e-11)


def test_what_first_states_all_but_absorb_keeps_its_digits():
    """A column of which they leave 1e-15: normal equations would have it wrong by half."""
    rng = np.random.default_rng(3)
    by_start, other = rng.normal(size=(N, M, STATE)), rng.normal(size=(N, M))
    by_start[..., 8] = by_start[..., 7] + 0.01 * by_start[..., 8]
    absorbed = (by_start @ rng.normal(size=(STATE, 1)))[..., 0]
    left = np.stack([off(rows[:, None], states)[:, 0] for rows, states in zip(other, by_start, strict=True)])
    column = absorbed + 3e-8 * left
    gram = System(other, by_start, column[..., None]).eliminated().gram
    np.testing.assert_allclose(gram[:, 0, 0], 9e-16 * (left**2).sum(axis=1), rtol=1e-6)


def test_first_states_that_follow_a_common_step_are_those_of_least_squares(system):
    step = np.arange(1.0, Q + P + 1.0)
    left = system.residual - system.by_common @ step
    dense = [np.linalg.lstsq(b, r, rcond=None)[0] for b, r in zip(system.by_start, left, strict=True)]
    np.testing.assert_allclose(system.start_correction(left), dense, atol=1e-12)
    np.testing.assert_allclose(system.eliminated().start_step(step), dense, atol=1e-12)
