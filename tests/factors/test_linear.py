"""The linear step and the covariances against dense numpy algebra on the very same linearised system."""

from __future__ import annotations

from itertools import pairwise

import gtsam
import numpy as np
import pytest

from ballfg.factors.batch import COEFFICIENTS, Rows, Values
from ballfg.factors.bridge import key_of, linear_graph
from ballfg.factors.dynamics import ContactFactors, FlightFactors
from ballfg.factors.graph import BallGraph, Convergence, LevenbergMarquardt, _Point, _tried
from ballfg.factors.linear.covariance import marginal_covariances
from ballfg.factors.linear.elimination import Root
from ballfg.factors.linear.step import Step, solve, weighted
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.factors.position import PositionFactors
from ballfg.factors.prior import coefficient_prior, spin_prior, state_prior

NOISE = ProcessNoise()
N = 7
BOUNCE = 3  # the interval with a contact


def track(
    model, coefficients: np.ndarray, *, loss: Loss | None = None, noise: ProcessNoise = NOISE, cut: int | None = None
):
    """A short bouncing track with every sort of factor, at a point away from the minimum."""
    rng = np.random.default_rng(5)
    times = 0.01 * np.arange(N) + 0.002 * rng.uniform(-1, 1, N)
    dt = np.diff(times)
    states = np.zeros((N, 9))
    fall = 0.016 + 2.0 * np.abs(times - 0.5 * (times[BOUNCE] + times[BOUNCE + 1]))
    states[:, :3] = np.stack((5.0 * times, 0.3 * times, fall), axis=1)
    states[:, 3:6] = (5.0, 0.3, -2.0)
    states[BOUNCE + 1 :, 5] = 1.8
    states[:, 6:] = (5.0, 60.0, -20.0)
    measured = states[:, :3] + 0.003 * rng.standard_normal((N, 3))
    measured[1] += 0.04
    states = states + np.repeat((1e-3, 5e-2, 5.0), 3) * rng.standard_normal((N, 9))
    states[BOUNCE, 5] = -2.0
    covariance = noise.flight(dt)
    covariance[BOUNCE] += noise.contact(dt[BOUNCE : BOUNCE + 1], dt[BOUNCE : BOUNCE + 1] / 2)[0]
    flights = np.array([i for i in range(N - 1) if i not in (BOUNCE, cut)])
    kinds = [
        PositionFactors(np.arange(N), measured, np.full((N, 3), 0.003), loss),
        FlightFactors(model, flights, dt[flights], covariance[flights]),
        ContactFactors(model, np.array([BOUNCE]), dt[[BOUNCE]], covariance[[BOUNCE]], np.zeros((1, 1))),
        state_prior(0, states[0] + 1.0, np.repeat((5.0, 20.0, 60.0), 3)),
        spin_prior(np.array([0]), np.array([[0.0, 50.0, 0.0]]), np.full((1, 3), 20.0), Loss("cauchy", 3.0)),
    ]
    if cut is not None:
        kinds.append(state_prior(cut + 1, states[cut + 1], np.repeat((5.0, 20.0, 60.0), 3)))
    if len(coefficients):
        kinds.append(coefficient_prior(coefficients + 0.01, np.array([0.035, 0.0008, 0.02, 0.05, 0.004])))
    return BallGraph(tuple(kinds)), Values(states, coefficients)


def dense(linearized, values: Values) -> tuple[np.ndarray, np.ndarray]:
    """Reweighted residual and Jacobian of the whole graph, columns: states in order, coefficients last."""
    size = values.states.size
    residuals, jacobians = [], []
    for rows in linearized:
        r, blocks = weighted(rows)
        for i, variables in enumerate(rows.variables.tolist()):
            row = np.zeros((r.shape[1], size + len(values.coefficients)))
            for block, v in zip(blocks, variables, strict=True):
                row[:, slice(size, None) if v == COEFFICIENTS else slice(9 * v, 9 * v + 9)] += block[i]
            residuals.append(r[i])
            jacobians.append(row)
    return np.concatenate(residuals), np.concatenate(jacobians)


def least_squares(r: np.ndarray, J: np.ndarray) -> np.ndarray:
    """Column-scaled QR: the columns' units differ by 1e6."""
    scale = np.linalg.norm(J, axis=0)
    return np.linalg.lstsq(J / scale, -r, rcond=None)[0] / scale


CASES = [
    (False, None, None),
    (True, None, None),
    (True, Loss("huber", 2.0), None),
    (True, Loss("cauchy", 2.0), 1),
    (False, None, 4),
]


@pytest.fixture(params=CASES, ids=["plain", "coefficients", "huber", "cauchy-cut", "cut"])
def problem(request, model, augmented, coefficients):
    with_coefficients, loss, cut = request.param
    used = (augmented, coefficients) if with_coefficients else (model, np.zeros(0))
    return track(*used, loss=loss, cut=cut)


@pytest.mark.parametrize("damping", [0.0, 1e-6, 1e-2, 10.0])
def test_step_is_the_dense_least_squares(problem, damping) -> None:
    """To 1e-7 of each unit's largest step: the condition number of the column-scaled system is near 1e5."""
    graph, values = problem
    linearized = graph.linearize(values)
    step = solve(linearized, values, damping)
    r, J = dense(linearized, values)
    root = np.sqrt(damping * (J**2).sum(axis=0))
    expected = least_squares(np.concatenate((r, np.zeros(len(root)))), np.concatenate((J, np.diag(root))))
    given = np.concatenate((step.states.ravel(), step.coefficients))
    scale = 1.0 / np.linalg.norm(J, axis=0)
    assert np.abs((given - expected) / scale).max() < 1e-7 * np.abs(expected / scale).max()
    promised = 0.5 * (r @ r) - 0.5 * np.square(r + J @ expected).sum()
    assert step.decrease == pytest.approx(promised, rel=1e-8)


def test_covariances_are_the_dense_inverse(problem) -> None:
    graph, values = problem
    linearized = graph.linearize(values)
    step = solve(linearized, values)
    n, p = len(values.states), len(values.coefficients)
    given = marginal_covariances(step.root)
    _, J = dense(linearized, values)
    scale = np.linalg.norm(J, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(J / scale, mode="r"))
    full = inverse @ inverse.T / np.outer(scale, scale)
    sigma = np.sqrt(np.diag(full))

    def close(block: np.ndarray, rows: slice, columns: slice) -> None:
        unit = np.outer(sigma[rows], sigma[columns])
        np.testing.assert_allclose(block / unit, full[rows, columns] / unit, atol=1e-7)

    tail = slice(9 * n, 9 * n + p)
    for i in range(n):
        close(given.states[i], slice(9 * i, 9 * i + 9), slice(9 * i, 9 * i + 9))
        close(given.cross[i], slice(9 * i, 9 * i + 9), tail)
    close(given.coefficients, tail, tail)


@pytest.mark.parametrize("spin_density", [1e-3, 1e-5])
def test_covariances_where_cholesky_fails(model, spin_density) -> None:
    """Spin prior over process sigma 1e6 and more: GTSAM's Cholesky gives up beyond 4096, QR does not.

    The dense reference takes the first state and the differences between neighbours as its unknowns: their columns are
    well conditioned where those of nearly equal spins are not.
    """
    graph, values = track(model, np.zeros(0), noise=ProcessNoise(spin=spin_density))
    linearized = graph.linearize(values)
    step = solve(linearized, values)
    given = marginal_covariances(step.root)
    r, J = dense(linearized, values)
    chain = np.kron(np.tril(np.ones((N, N))), np.eye(9))
    changed = J @ chain
    scale = np.linalg.norm(changed, axis=0)
    inverse = np.linalg.inv(np.linalg.qr(changed / scale, mode="r"))
    full = chain @ (inverse @ inverse.T / np.outer(scale, scale)) @ chain.T
    for i in range(N):
        block = full[9 * i : 9 * i + 9, 9 * i : 9 * i + 9]
        sigma = np.sqrt(np.diag(block))
        np.testing.assert_allclose(given.states[i] / np.outer(sigma, sigma), block / np.outer(sigma, sigma), atol=1e-5)
    expected = chain @ least_squares(r, changed)
    np.testing.assert_allclose(step.states.ravel(), expected, rtol=1e-5, atol=1e-6)
    assert np.isfinite(given.states).all()


def test_gtsam_s_cholesky_does_fail_there(model) -> None:
    """The reason for QR: should this pass one day, QR may go."""
    graph, values = track(model, np.zeros(0), noise=ProcessNoise(spin=1e-5))
    with pytest.raises(RuntimeError, match="Indetermin"):
        linear_graph(graph.linearize(values)).eliminateMultifrontal()  # prefers Cholesky


def test_the_elimination_is_gtsam_s(problem) -> None:
    """The same rows through GTSAM's QR: the same triangle but for the signs of its rows, and the same solution."""
    graph, values = problem
    linearized = graph.linearize(values)
    step = solve(linearized, values)
    n, p = len(values.states), len(values.coefficients)
    ordering = gtsam.Ordering()
    keys = [key_of(variable) for variable in (*range(n), COEFFICIENTS)[: n + (p > 0)]]
    for key in keys:
        ordering.push_back(key)
    net = linear_graph(linearized).eliminateSequential(ordering, gtsam.EliminateQR)
    solution = net.optimize()
    for i in range(n):
        np.testing.assert_allclose(step.states[i], solution.at(keys[i]), rtol=1e-6, atol=1e-9)
        theirs, own = net.at(i).R(), step.root.states[i]
        signs = np.sign(np.diag(theirs)) * np.sign(np.diag(own[:, :9]))
        parents = np.roll(net.at(i).S(), -p, axis=1)  # GTSAM has the coefficients first
        blocks = [theirs, *np.split(parents, [9] if i + 1 < n and parents.shape[1] > p else [0], axis=1)]
        if not blocks[1].shape[1]:
            blocks[1] = np.zeros((9, 9))
        given = np.concatenate((*blocks, net.at(i).d()[:, None]), axis=1)
        size = np.abs(given).max(axis=1, keepdims=True)
        np.testing.assert_allclose(signs[:, None] * own / size, given / size, atol=1e-8)
    if p:
        np.testing.assert_allclose(step.coefficients, solution.at(keys[n]), rtol=1e-6)


def test_a_factor_between_states_apart_is_refused(model) -> None:
    graph, values = track(model, np.zeros(0))
    far = graph.linearize(values)
    variables = far[1].variables.copy()
    variables[1, 1] += 1
    with pytest.raises(ValueError, match=r"one looks at the states \[1, 3\]\. Give it"):
        solve([far[0], Rows(variables, far[1].residual, far[1].jacobians, far[1].loss)], values)


def test_a_state_that_nothing_ties_down_is_a_status(model) -> None:
    """Positions alone leave velocities free: there is no linear solution, and the minimisation says so."""
    values = Values(np.zeros((2, 9)), np.zeros(0))
    graph = BallGraph((PositionFactors(np.arange(2), np.ones((2, 3)), np.full((2, 3), 0.01)),))
    assert solve(graph.linearize(values), values) is None
    minimum = LevenbergMarquardt().minimize(graph, values)
    assert minimum.convergence is not Convergence.CONVERGED
    assert minimum.step is None


def test_an_objective_that_is_not_finite_is_a_status(model) -> None:
    """The ball flies up from below the surface: its contact never comes."""
    graph, values = track(model, np.zeros(0))
    states = values.states.copy()
    states[BOUNCE, [2, 5]] = (-1.0, 0.5)
    minimum = LevenbergMarquardt().minimize(graph, Values(states, values.coefficients))
    assert minimum.convergence is Convergence.NOT_FINITE
    assert minimum.error == np.inf


def test_too_few_iterations_are_a_status(problem) -> None:
    graph, values = problem
    minimum = LevenbergMarquardt(max_iterations=1).minimize(graph, values)
    assert minimum.convergence is Convergence.TOO_MANY_ITERATIONS
    assert minimum.error <= graph.error(values)


@pytest.mark.parametrize("tolerance", [1e-5, 1e-6])
def test_minimum_has_no_gradient_left(problem, tolerance) -> None:
    """The step that is left, in posterior standard deviations, is what `tolerance` bounds."""
    graph, values = problem
    minimum = LevenbergMarquardt(tolerance).minimize(graph, values)
    assert minimum.convergence is Convergence.CONVERGED
    r, J = dense(graph.linearize(minimum.values), minimum.values)
    left = least_squares(r, J)
    assert np.linalg.norm(J @ left) < tolerance + 1e-9  # rounding of a system of condition 1e5
    assert minimum.error == pytest.approx(graph.error(minimum.values), rel=1e-9)
    assert minimum.error < graph.error(values)
    # the gradient of the true objective, by differences along random directions
    rng = np.random.default_rng(0)
    scale = 1.0 / np.linalg.norm(J, axis=0)
    size = values.states.size
    for _ in range(5):
        d = 1e-3 * scale * rng.standard_normal(len(scale))
        ahead = graph.error(minimum.values.retract(d[:size].reshape(-1, 9), d[size:]))
        behind = graph.error(minimum.values.retract(-d[:size].reshape(-1, 9), -d[size:]))
        curvature = ahead + behind - 2 * minimum.error
        assert curvature > 0
        assert abs(ahead - behind) < 1e-2 * curvature


def at_error(error: float) -> list[Rows]:
    """A position whose objective is `error`, linearised."""
    states = np.zeros((1, 9))
    states[0, 0] = np.sqrt(2.0 * error)
    return BallGraph((PositionFactors(np.zeros(1, int), np.zeros((1, 3)), np.ones((1, 3))),)).linearize(
        Values(states, np.zeros(0))
    )


@pytest.mark.parametrize(
    ("errors", "taken"),
    [
        ([1.2, 0.7], 0.7),  # a share of the step is better than both ends
        ([1.2, 1.1, 0.9], 0.9),  # it is worse than where the step began, a smaller one is not
        ([0.9, 0.95, 0.96, 0.97], 0.9),  # until it is enough for a share as small
        ([0.7], 0.7),  # more than half of the promise: the whole step, at once
    ],
)
def test_a_step_that_breaks_its_promise_is_tried_in_part(errors: list[float], taken: float) -> None:
    point = _Point(Values(np.zeros((1, 9)), np.zeros(0)), at_error(1.0))
    step = Step(np.eye(1, 9), np.zeros(0), Root(np.empty((1, 9, 19)), np.empty((0, 19))), decrease=0.4)
    asked, answers = list[Values](), iter([at_error(e) for e in errors])

    class Told(BallGraph):
        def linearize(self, values: Values) -> list[Rows]:
            asked.append(values)
            return next(answers)

    assert _tried(Told(()), point, step, 0.0).error == pytest.approx(taken)
    assert next(answers, None) is None
    gain = (1.0 - errors[0]) / 0.4  # of the promise
    moves = [float(values.states[0, 0]) for values in asked]
    assert moves[:2] == pytest.approx([1.0, min(1.0 / (2.0 - gain), 0.6)][: len(moves)])
    assert all(0.1 <= later / move <= 0.6 for move, later in pairwise(moves))
