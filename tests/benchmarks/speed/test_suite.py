"""A quick run: times are never tested. The banded control ends at the minimum of what it says it minimises."""

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy.optimize import least_squares

from ballfg.benchmarks.results import Results
from ballfg.benchmarks.speed import robot, suite
from ballfg.benchmarks.speed.network import GRAVITY, fitted_network, parameter_count
from ballfg.benchmarks.speed.stopwatch import Stopwatch
from ballfg.benchmarks.speed.suite import QUICK, banded_problem, problem_model, problem_track, run_speed
from ballfg.dynamics import nominal_model

EXPECTED = {
    "matrix_product_time",
    "banded_time",
    "lm_time",
    "lm_time_gtsam",
    "covariances_time",
    "estimate_time",
    "jacobians_time_79",
    "jacobian_time_1",
    "online_update_median",
    "online_update_p99",
    "online_chain_update_median",
    "online_chain_update_p99",
    "prediction_time",
    "estimate_time_two_bounces",
}
EVENTS = {"next_bounce_time", "plane_crossing_time"}
GROWTH = {f"estimate_us_per_observation_{count}" for count in robot.LONG}


def test_network_is_the_same_each_time_and_close_to_the_model() -> None:
    model = problem_model()
    short, again = fitted_network(model, iterations=10), fitted_network(model, iterations=10)
    assert all(torch.equal(a, b) for a, b in zip(short.parameters(), again.parameters(), strict=True))
    one = fitted_network(model)
    assert parameter_count(one) == 7523
    rng = torch.Generator().manual_seed(9)
    scale = torch.tensor([1.0] * 3 + [4.0] * 3 + [60.0] * 3, dtype=torch.float64)
    state = scale * torch.randn((500, 9), generator=rng, dtype=torch.float64)
    with torch.no_grad():
        force = model.rates(state)[0] - GRAVITY
        error = one.rates(state)[0] - model.rates(state)[0]
    assert error.square().mean().sqrt() < 0.1 * force.square().mean().sqrt()


def test_the_problem_is_eighty_samples_at_a_hundred_hertz() -> None:
    """In free flight from 5.4 m/s on: its times are compared with those of other libraries."""
    track = problem_track(problem_model())
    assert len(track) == 80
    assert track.times == pytest.approx(np.arange(80) / 100.0)
    speeds = np.linalg.norm(np.diff(track.positions[::10], axis=0), axis=1) / 0.1
    assert 4.0 < speeds.min() < speeds.max() < 7.0


def test_an_analytic_model_has_its_times() -> None:
    results, model = Results("test", 0), problem_model()
    track = problem_track(model)
    watch = Stopwatch(results, suite.CASE, 2, 1, banded_problem(track))
    suite._time_model(watch, "analytic", model, track)
    suite._time_coefficients(watch, model, track)
    robot.time_bounces(watch, "analytic", nominal_model(model.radius), suite.NOISE, suite.LABEL_NOISE)
    robot.time_growth(watch, "analytic", model, suite.START, suite.NOISE)
    robot.time_events(watch)
    assert {row.metric for row in results.rows if row.method == "analytic" and row.unit == "ms"} == EXPECTED
    assert {row.metric for row in results.rows} >= EVENTS | GROWTH
    assert all(row.value is not None and row.value > 0 for row in results.rows)


@pytest.mark.thorough
@pytest.mark.filterwarnings("ignore:budget_ms is:UserWarning")  # a busy machine may be too slow for the budget
def test_speed_run_has_every_time() -> None:
    results = Results("test", 0)
    run_speed(results, None, replace(QUICK, runs=2, warm_up=1, fit_iterations=100, pretrain_iterations=10, flights=1))
    for method in ("analytic", "network"):
        found = {row.metric for row in results.rows if row.method == method and row.unit == "ms"}
        assert found == EXPECTED
    assert {row.metric for row in results.rows if row.method == "control"} == {"matrix_product_time", "banded_time"}
    assert all(row.value is not None and row.value > 0 for row in results.rows)
    found = {row.metric for row in results.rows}
    assert {"stream_push_p999"} | EVENTS | GROWTH <= found
    assert {"rollout_time", "rollout_time_torch"} <= found


def test_it_is_the_minimum_that_a_general_solver_finds() -> None:
    """scipy's least squares with differences for derivatives, started where the control ends and a little off."""
    problem = banded_problem(problem_track(problem_model()))
    states, spin, count = problem.solve()
    assert 2 <= count <= 8

    def residuals(x: np.ndarray) -> np.ndarray:
        return np.concatenate([r.ravel() for r in problem.residuals(x[:-3].reshape(-1, 6), x[-3:])])

    end = np.concatenate((states.ravel(), spin))
    scale = np.concatenate((np.tile((1e-3,) * 3 + (1e-2,) * 3, len(states)), np.ones(3)))
    away = end + scale * np.random.default_rng(0).standard_normal(len(end))
    found = least_squares(residuals, away, x_scale=scale, xtol=1e-13, ftol=1e-14, gtol=1e-12)
    np.testing.assert_allclose((found.x - end) / scale, 0.0, atol=1e-3)
    assert (residuals(end) ** 2).sum() < 1.0001 * 2.0 * found.cost
