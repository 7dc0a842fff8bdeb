"""Steps of the common unknowns gain what the linear model promises, also where balls leave the paths of their model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

import ballfg.diagnosis.evidence.weighed as weighing
from ballfg.diagnosis.evidence.halves import unlike_halves
from ballfg.diagnosis.evidence.rows import random_motion
from ballfg.diagnosis.evidence.sizes import Ahead
from ballfg.diagnosis.fit.fit import fit_problem, followed
from ballfg.diagnosis.fit.problem import Fit


@pytest.fixture(scope="module")
def moved_shots(make_ball, make_launches, make_shots):
    """Fourteen bouncing shots that a slow gust moves by millimetres off every path that the model has."""
    shots = make_shots(make_ball(), make_launches(14, 33), 33, rate=50.0, duration=0.9).stretches
    rng, phase = np.random.default_rng(33), np.linspace(0.0, 1.0, shots.positions.shape[1])[:, None]
    bend = 0.005 * rng.standard_normal((14, 1, 3)) * np.sin(2.0 * np.pi * (phase + rng.uniform(size=(14, 1, 1))))
    return replace(shots, positions=shots.positions + torch.from_numpy(bend))


def at_drag(fit, change):
    """The fit's unknowns with another drag."""
    values = fit.unknowns.values | {"flight.drag.k": fit.unknowns.values["flight.drag.k"] + change}
    return replace(fit.unknowns, values=values)


def test_first_states_that_follow_are_those_of_a_fit_of_them_alone(make_ball, moved_shots, make_fit):
    fit = make_fit(make_ball(), moved_shots)
    unknowns = at_drag(fit, 0.005)
    found, still = followed(fit, unknowns), Fit.at(fit.problem, unknowns, fit.noise)
    held = replace(fit.problem, shared=False)
    alone = fit_problem(held, found.unknowns, fit.noise, settle_noise=False, steps=30)
    assert found.unknowns.values == unknowns.values
    assert found.problem.shared
    assert found.cost - alone.cost < 0.15 * (alone.cost - fit.cost)
    assert still.cost - alone.cost > 100.0


def test_a_step_gains_what_it_promises(make_ball, moved_shots, make_fit):
    """From a drag that is far off: what the linear model foretells of the density of all tracks comes true."""
    fit = make_fit(make_ball(), moved_shots)
    question = weighing._Question((), random_motion(fit, ()), unlike_halves(fit), None)
    point = question.point(followed(fit, at_drag(fit, 0.02)), (None,))
    found, ahead, density = question.at(point)
    after, damping = question.moved(point, found, ahead, density)
    before = question._density(point.begun_at((found.start,)), found.widths)
    assert density == pytest.approx(before, abs=0.5)
    gained = question._density(after, found.widths) - before
    assert ahead.gain > 10.0
    assert damping == 0.0
    assert gained == pytest.approx(ahead.gain, rel=0.4)


def test_damped_steps_stay_within_limits_and_promise_less():
    """Of a quadratic density, against its values on a fine grid within the limits."""
    information, slope = np.array([[4.0, 1.5], [1.5, 1.0]]), np.array([2.0, 3.0])
    ahead = Ahead(information, slope, (np.array([-1.0, -1.0]), np.array([1.0, 2.0])))
    grid = np.stack(np.meshgrid(np.linspace(-1.0, 1.0, 401), np.linspace(-1.0, 2.0, 601)), axis=-1).reshape(-1, 2)
    gains = grid @ slope - 0.5 * np.einsum("ni,ij,nj->n", grid, information, grid)
    step, gain = ahead.step(0.0)
    assert step == pytest.approx(grid[gains.argmax()], abs=0.01)
    assert gain == pytest.approx(gains.max(), abs=1e-3)
    promised = [ahead.step(damping)[1] for damping in (0.0, 0.1, 1.0, 10.0)]
    assert promised == sorted(promised, reverse=True)
