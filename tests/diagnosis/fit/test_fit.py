"""The joint fit against scipy's least squares on one dense problem; noise, bounds and priors."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats
from scipy.optimize import least_squares

from ballfg.diagnosis.fit.fit import first_guess, fit_problem, noise_by_axis, reachable
from ballfg.diagnosis.fit.free import Unknowns, declared_free
from ballfg.diagnosis.fit.problem import LABEL_LOSS, Fit, Noise, Problem, launch_axes
from ballfg.dynamics.effect import Coefficient
from ballfg.dynamics.model import substitute
from ballfg.dynamics.motion.paths import paths

FREE = {
    "flight.drag.k": Coefficient("k", 0.12, 0.02, "1/m", 0.0, 2.0),
    "bounce.restitution.e": Coefficient("e", 0.93, 0.01, "1", 0.0, 1.0),
}
NOISE = Noise(np.array([1.0, 1.2, 0.9]), 5.0, np.array([40.0, 30.0, 50.0]))


def dense_residual(problem, noise, surfaces):
    """All residuals of three labelled stretches from `paths`, as a function of one vector; half its square is ours."""
    stretches, n = problem.stretches, len(problem.stretches)
    centre, sigma = problem.centres, problem.precisions**-0.5

    def residual(x):
        starts, values = torch.from_numpy(x[: 9 * n].reshape(n, 9)), x[9 * n :]
        columns = {name: torch.tensor(v, dtype=torch.float64) for name, v in zip(problem.free, values, strict=True)}
        with torch.no_grad():
            motion = paths(substitute(problem.model, columns), starts, stretches.times, surfaces)
        position = (stretches.positions - motion[..., :3]).numpy() / (stretches.sigmas.numpy() * noise.position)
        spin = (stretches.labels.numpy() - starts[:, 6:].numpy()) / noise.label
        square = np.maximum((spin**2).sum(-1, keepdims=True), 1e-12)
        spin = spin * np.sqrt(2.0 * LABEL_LOSS.value(np.sqrt(square)) / square)  # its square is the loss
        return np.concatenate((position.ravel(), spin.ravel(), (values - centre) / sigma))

    return residual


def test_the_minimum_is_that_of_a_dense_solver(make_ball, make_launches, make_shots, surfaces):
    """Residuals half as large as stated, so that Huber's loss is a square everywhere."""
    model = make_ball(drag={"k": 0.11})
    data = make_shots(model, make_launches(3, 11), 11, rate=40.0, duration=0.5, noise=0.0015).stretches
    problem = Problem(make_ball(), data, FREE)
    unknowns, _ = first_guess(problem, NOISE.label, 40.0)
    found = fit_problem(problem, unknowns, NOISE, settle_noise=False)
    assert bool((found.robust.samples == 1.0).all())
    residual = dense_residual(problem, NOISE, surfaces)
    start = np.concatenate((unknowns.starts.ravel(), list(unknowns.values.values())))
    dense = least_squares(residual, start, x_scale="jac", xtol=1e-12, ftol=1e-12, gtol=1e-12, max_nfev=12)
    assert found.cost == pytest.approx(dense.cost, rel=1e-6)
    starts, values = dense.x[:27].reshape(3, 9), dense.x[27:]
    spread = np.sqrt(np.diagonal(np.linalg.inv(dense.jac.T @ dense.jac)))
    off = np.append((found.unknowns.starts - starts).ravel(), list(found.unknowns.values.values()) - values)
    assert np.abs(off / spread).max() < 1e-2  # the search ends where the objective changes by 1e-5 of itself


@pytest.fixture(scope="module")
def unlabelled(make_ball, make_launches, make_shots):
    """Eight shots whose launcher gives them 150 rad/s of topspin; nothing but that is known of their spins."""
    starts = make_launches(8, 12, spin=20.0)
    across = torch.nn.functional.normalize(torch.stack((-starts[:, 4], starts[:, 3]), dim=-1), dim=-1)
    starts[:, 6:8] += 150.0 * across
    return make_shots(make_ball(), starts, 12, labelled=False)


@pytest.fixture(scope="module")
def unlabelled_fit(make_fit, make_ball, unlabelled):
    return make_fit(make_ball(), unlabelled.stretches)


def test_a_launcher_is_learned_in_the_axes_of_the_launch(unlabelled_fit):
    """Mean of eight spins that scatter by 20 rad/s, along forward, across and up."""
    np.testing.assert_allclose(unlabelled_fit.unknowns.launcher, [[0.0, 150.0, 0.0]], atol=4 * 20 / np.sqrt(8) + 5)
    assert (unlabelled_fit.noise.spin > 10.0).all()
    assert (unlabelled_fit.noise.spin < 40.0).all()


def test_spins_scatter_unequally_along_the_axes_of_the_launch(make_ball, make_launches, make_shots, make_fit):
    """By 60 rad/s about across, by 5 about the others, in shots of all directions; twelve tell a scatter to 20 %."""
    starts = make_launches(12, 14, spin=0.0)
    local = np.random.default_rng(14).standard_normal((12, 3)) * (5.0, 60.0, 5.0)
    starts[:, 6:] = torch.from_numpy((launch_axes(starts.numpy()) @ local[..., None])[..., 0])
    found = make_fit(make_ball(), make_shots(make_ball(), starts, 14, labelled=False, noise=0.001).stretches)
    forward, across, up = found.noise.spin
    assert across == pytest.approx(np.sqrt((local[:, 1] ** 2).mean()), rel=0.25)
    assert max(forward, up) < 0.5 * across


def test_spins_of_balls_that_are_dropped_are_limited_along_all_axes(make_ball, make_launches, make_shots, make_fit):
    starts = make_launches(3, 15, spin=0.0)
    starts[:, 3:5] = 0.0
    found = make_fit(make_ball(), make_shots(make_ball(), starts, 15, labelled=False).stretches, settle_noise=False)
    by_spin = found.linearised.by_start[:, -3:, 6:]
    information = np.trace(by_spin.swapaxes(-1, -2) @ by_spin, axis1=1, axis2=2)
    np.testing.assert_allclose(information, (found.noise.spin**-2).sum(), rtol=1e-9)


def test_spins_that_nobody_labelled_come_out(unlabelled_fit, unlabelled):
    system = unlabelled_fit.linearised
    covariance = np.linalg.inv(system.by_start.swapaxes(-1, -2) @ system.by_start)[:, 6:, 6:]
    off = unlabelled_fit.unknowns.starts[:, 6:] - unlabelled.states[:, 6:].numpy()
    square = (off * np.linalg.solve(covariance, off[..., None])[..., 0]).sum()
    assert 6.0 < square < 60.0  # chi-square of 24 degrees and what eight shots leave open of everything common


def test_at_the_minimum_the_gradient_is_zero(unlabelled_fit):
    """Of the objective itself, launch directions included, along each common unknown: by central differences."""
    found = unlabelled_fit
    system = found.linearised
    information = system.eliminated().gram.sum(0)[:-1, :-1] + np.diag(found.problem.common_precision)
    q = len(found.problem.free)
    for i in range(q + 3):
        size = 1e-2 / np.sqrt(information[i, i])
        rise = [cost_beside(found, i, sign * size) - found.cost for sign in (1, -1)]
        assert abs(rise[0] - rise[1]) / 2 < 2e-3 * np.sqrt(2 * found.cost)  # a step of 0.01 sigma


def cost_beside(found, index, step):
    """The objective with one common unknown moved."""
    values, launcher = dict(found.unknowns.values), found.unknowns.launcher.copy()
    names = list(values)
    if index < len(names):
        values[names[index]] += step
    else:
        launcher.ravel()[index - len(names)] += step
    moved = Unknowns(found.unknowns.starts, values, launcher)
    return Fit.at(found.problem, moved, found.noise).cost


def test_noise_of_each_axis_is_told_and_its_scale_estimated(make_ball, make_launches, make_shots, make_fit):
    data = make_shots(make_ball(), make_launches(8, 13), 13, noise=0.0).stretches
    noise = 0.003 * np.array([0.5, 1.0, 2.0]) * np.random.default_rng(0).standard_normal(data.positions.shape)
    found = make_fit(make_ball(), replace(data, positions=data.positions + torch.from_numpy(noise)))
    # 336 residuals an axis: the median absolute deviation is known to 6 %
    np.testing.assert_allclose(noise_by_axis(found), 0.003 * np.array([0.5, 1.0, 2.0]), rtol=0.2)
    middle = float(np.median(np.abs(noise))) / stats.norm.ppf(0.75) / 0.003
    np.testing.assert_allclose(found.noise.position, np.full(3, middle), rtol=0.1)


def test_noise_stays_where_asked(calm_fit):
    again = fit_problem(calm_fit.problem, calm_fit.unknowns, calm_fit.noise, settle_noise=False)
    assert again.noise is calm_fit.noise
    assert again.cost <= calm_fit.cost
    assert again.cost == pytest.approx(calm_fit.cost, rel=1e-4)


def test_declared_coefficients_are_found(calm_fit, make_ball):
    """Within four standard deviations; the fit knows friction hardly beyond its prior."""
    total = calm_fit.linearised.eliminated().gram.sum(0)
    q = len(calm_fit.problem.free)
    sigma = np.sqrt(np.diagonal(np.linalg.inv(total[:q, :q] + np.diag(calm_fit.problem.precisions))))
    truth = dict(make_ball().named_parameters())
    for (name, value), s in zip(calm_fit.unknowns.values.items(), sigma, strict=True):
        assert abs(value - float(truth[name])) < 4 * s, name
    assert float(calm_fit.noise.position.mean()) == pytest.approx(1.0, abs=0.1)


def test_coefficients_stay_within_their_bounds(make_ball, make_launches, make_shots):
    data = make_shots(make_ball(drag={"k": 0.2}), make_launches(3, 14), 14, duration=0.4).stretches
    free = {"flight.drag.k": replace(FREE["flight.drag.k"], sigma=1.0, high=0.15)}
    problem = Problem(make_ball(), data, free)
    assert (
        fit_problem(problem, *first_guess(problem, 4.0, 60.0), settle_noise=False).unknowns.values["flight.drag.k"]
        == 0.15
    )


def test_what_is_shared_stays_where_only_first_states_are_asked_for(calm_fit):
    values = {name: 1.02 * value for name, value in calm_fit.unknowns.values.items()}
    problem = replace(calm_fit.problem, shared=False)
    found = fit_problem(problem, replace(calm_fit.unknowns, values=values), calm_fit.noise, settle_noise=False)
    assert found.unknowns.values == pytest.approx(values, rel=1e-15)
    assert found.cost > calm_fit.cost


def test_launch_axes_are_right_handed():
    starts = np.zeros((2, 9))
    starts[:, 3:6] = ((0.0, 5.0, 1.0), (-3.0, 0.0, 2.0))
    axes = launch_axes(starts)
    np.testing.assert_allclose(axes[0], np.array([[0, -1, 0], [1, 0, 0], [0, 0, 1]]), atol=1e-3)
    np.testing.assert_allclose(np.linalg.det(axes), 1.0, atol=1e-3)


@pytest.fixture
def one_lost(make_ball, make_launches, make_shots):
    """Three stretches, the second of which is taken to start under the table."""
    data = make_shots(make_ball(), make_launches(3, 15), 15, duration=0.4, rate=40.0).stretches
    starts = data.starts.clone()
    starts[1, 2], starts[1, 5] = 0.4, 0.3
    return replace(data, starts=starts)


def test_stretches_that_miss_a_contact_are_not_reachable(make_ball, one_lost):
    assert reachable(make_ball(), one_lost).names == ("000", "002")


def test_an_objective_with_a_missed_contact_is_infinite(make_ball, one_lost):
    problem = Problem(make_ball(), one_lost, declared_free(make_ball()))
    unknowns, noise = first_guess(problem, 4.0, 60.0)
    assert Fit.at(problem, unknowns, noise).cost == np.inf


def test_a_fit_that_starts_with_a_missed_contact_stays_there(make_ball, one_lost):
    problem = Problem(make_ball(), one_lost, declared_free(make_ball()))
    unknowns, noise = first_guess(problem, 4.0, 60.0)
    found = fit_problem(problem, unknowns, noise, settle_noise=False)
    assert found.cost == np.inf
    assert found.unknowns is unknowns
