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
from ballfg.diagnosis.fit.fit import fit_problem, followed, responded
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import hypotheses, scene_of
from ballfg.diagnosis.search.refits import refit
from ballfg.diagnosis.search.score import Scored
from ballfg.dynamics import EFFECTS


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
    after, (_, then, _) = question.moved(point, found, ahead, density)
    before = question._density(point.begun_at((found.start,)), found.widths)
    assert density == pytest.approx(before, abs=0.5)
    gained = question._density(after, found.widths) - before
    assert ahead.gain > 10.0
    assert then.damping == 0.0
    assert gained == pytest.approx(ahead.gain, rel=0.4)


def test_paths_that_stay_where_they_are_leave_the_density_as_it_was(make_ball, moved_shots, make_fit):
    """Where the model's own paths miss the samples, those that come closest anew may be elsewhere; these are not."""
    fit = make_fit(make_ball(), moved_shots)
    assert np.abs(responded(fit, fit.unknowns).predicted.positions - fit.predicted.positions).max() < 1e-12
    for change in (1e-4, 1e-3):
        still, stays = (way(fit, at_drag(fit, change)) for way in (at_old_starts, responded))
        moved = [np.abs(one.whitened - fit.whitened).mean() for one in (still, stays)]
        assert moved[1] < 0.2 * moved[0]


def at_old_starts(fit, unknowns):
    return Fit.at(fit.problem, replace(unknowns, starts=fit.unknowns.starts), fit.noise)


def test_a_mixture_of_two_points_is_what_is_computed_there_anew(make_ball, moved_shots, make_fit):
    """Derivatives of each stretch come from the path that was chosen for it, and are not computed again."""
    fit = make_fit(make_ball(), moved_shots)
    question = weighing._Question((), random_motion(fit), unlike_halves(fit), None)
    own = {"flight.drag.k": np.linspace(-0.02, 0.02, 14)}
    one, other = (question.point(followed(fit, replace(fit.unknowns, own=o)), (None,)) for o in ({}, own))
    chosen = np.arange(14) % 3 == 0
    mixed = one.mixed(other, chosen)
    anew = question.point(mixed.fit, (None,))
    assert mixed.fit.unknowns.own["flight.drag.k"] == pytest.approx(np.where(chosen, own["flight.drag.k"], 0.0))
    for cached, fresh in zip(mixed.rows, anew.rows, strict=True):
        for name in ("residual", "by_start", "by_common", "random"):
            found, expected = getattr(cached, name), getattr(fresh, name)
            assert np.abs(found - expected).max() < 1e-6 * max(np.abs(expected).max(), 1.0), name
    found, expected = mixed.fit.linearised, Fit.at(mixed.fit.problem, mixed.fit.unknowns, mixed.fit.noise).linearised
    assert np.abs(found.by_common - expected.by_common).max() < 1e-6 * np.abs(expected.by_common).max()


def test_a_further_effect_costs_no_more_than_its_price(make_ball, moved_shots, make_fit):
    """From wherever its refit ends: the model without it is one where it is absent."""
    fit = make_fit(make_ball(), moved_shots)
    plain = weighing.weigh(fit)
    (wind,) = hypotheses(fit.problem.model, scene_of(fit), [EFFECTS["wind"]])
    far = refit(fit, Scored(wind, None, 1.0)).fit
    off = replace(far.unknowns, values=far.unknowns.values | dict.fromkeys(wind.columns, 2.5))
    motion, halves = random_motion(fit), unlike_halves(fit)
    again = weighing.weighed(fit, (), motion, halves)
    lost = weighing.weighed(followed(far, off), (wind,), motion, halves, again)
    assert again.evidence == pytest.approx(plain.evidence, abs=0.5)
    assert lost.evidence > again.evidence - 15.0
    assert np.abs([lost.fit.unknowns.values[name] for name in wind.columns]).max() < 1.0


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
