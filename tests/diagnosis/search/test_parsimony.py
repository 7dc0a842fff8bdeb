"""Names that are earned: coefficients that differ from zero, halves that agree, values that a room can have."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.diagnosis.fit.fit import covariance_of, fit_problem, values_of
from ballfg.diagnosis.result import Value
from ballfg.diagnosis.search import parsimony
from ballfg.diagnosis.search.candidates import with_hypothesis
from ballfg.diagnosis.search.hypothesis import Hypothesis, hypotheses, scene_of
from ballfg.diagnosis.search.parsimony import halves_differ, insignificant, own_scores, significance
from ballfg.diagnosis.search.plausible import implausible, range_of
from ballfg.dynamics import EFFECTS

WIND = Hypothesis(EFFECTS["wind"], {}, ("x", "y", "z"))
TRUTH = (0.5, -0.3, 0.0)


def fit_with(before, hypothesis):
    problem = with_hypothesis(before.problem, hypothesis)
    values = dict(problem.model.named_parameters())
    free = {name: float(values[name]) for name in problem.free}
    unknowns = type(before.unknowns)(before.unknowns.starts, free | before.unknowns.values, before.unknowns.launcher)
    return fit_problem(problem, unknowns, before.noise, settle_noise=False)


@pytest.fixture(scope="module")
def with_wind(windy_fit):
    return fit_with(windy_fit, WIND)


def test_an_effect_that_is_there_differs_from_zero(with_wind, windy_fit):
    (score,) = own_scores(with_wind, [WIND])
    assert score.p_value < 1e-6
    for estimate, sigma, truth, fitted in zip(
        score.estimate, score.sigma, TRUTH, values_of(with_wind, WIND.columns, {}).values(), strict=True
    ):
        assert abs(estimate - truth) < 4 * sigma
        assert abs(estimate - fitted.value) < sigma
        assert 0.4 < sigma / fitted.sigma < 2.5
    assert insignificant(with_wind, [WIND], windy_fit) == []


def test_an_effect_that_is_not_there_does_not(calm_fit):
    assert insignificant(fit_with(calm_fit, WIND), [WIND], calm_fit) == [WIND]


def test_the_likelihood_alone_may_tell_of_a_single_strength(
    calm_fit, make_ball, make_launches, make_shots, make_fit, monkeypatch
):
    """Where scores say nothing: without an effect that is there the fit is worse by far, without another it is not."""
    effect = Hypothesis(EFFECTS["drag_spin"], {}, ("gain",))
    shots = make_shots(make_ball(drag_spin={"gain": 0.4}), make_launches(16, 9), 9).stretches
    before = make_fit(make_ball(), shots, settle_noise=False)
    fit = fit_with(before, effect)
    monkeypatch.setattr(parsimony, "CHANCE", -1.0)
    found = significance(fit, effect, before)
    assert found.differs
    assert found.sigmas == pytest.approx(np.sqrt(np.diag(covariance_of(fit, effect.columns))))  # no less than the noise
    assert not significance(fit_with(calm_fit, effect), effect, calm_fit).differs


def test_an_effect_without_strengths_has_none_that_halves_could_differ_in(
    with_wind, make_launches, make_ball, make_shots
):
    held = Hypothesis(EFFECTS["wind"], dict(zip("xyz", TRUTH, strict=True)), ())
    assert not halves_differ(with_wind, held, make_shots(make_ball(), make_launches(4, 5), 5).stretches)


def test_two_names_for_one_pattern_are_idle_beside_each_other(with_wind, windy_fit):
    """A wind and a shear about a far reference move the same air: neither is needed beside the other."""
    shear = Hypothesis(EFFECTS["wind_shear"], {"reference": -30.0}, ("x", "y"))
    both = fit_with(with_wind, shear)
    assert shear in insignificant(both, [WIND, shear], windy_fit)


def test_halves_that_want_the_same_agree(with_wind, make_ball, make_launches, make_shots):
    wind = dict(zip("xyz", TRUTH, strict=True))
    other = make_shots(make_ball(wind=wind), make_launches(16, 5), 5).stretches
    assert not halves_differ(with_wind, WIND, other)


def test_halves_that_contradict_each_other_differ(with_wind, make_ball, make_launches, make_shots):
    other = make_shots(make_ball(wind={"x": -0.5, "y": 0.0, "z": 0.0}), make_launches(16, 6), 6).stretches
    assert halves_differ(with_wind, WIND, other)


@pytest.mark.parametrize(
    ("name", "value", "sigma", "plausible"),
    [
        ("wind.x", 0.4, 0.01, True),
        ("wind.x", 0.52, 0.01, True),
        ("wind.x", 0.9, 0.3, False),
        ("wind_shear.x", -2.3, 0.06, False),
        ("tangential_restitution.e_t", -0.3, 0.01, False),
        ("magnus.k", 0.0116, 0.0001, False),
        ("gravity.g", 10.3, 0.01, False),
        ("gravity.g", 8.8, 0.01, False),
        ("drag.k", 0.4, 0.01, False),
        ("drag.k", 0.12, 0.01, True),
        ("restitution.e", 1.15, 0.01, False),
        ("friction.mu", 1.5, 0.01, False),
        ("spin_decay.rate", 4.0, 0.01, False),
        ("frame_tilt.y", 0.2, 0.01, False),
        ("table_tilt.x", 0.06, 0.001, False),
        ("scale.z", -0.2, 0.01, False),
        ("time_offset.x", 0.06, 0.001, False),
        ("gust_region.z", 4.0, 0.01, False),
        ("drag_speed.slope", 0.2, 0.01, False),
        ("drag_spin.gain", 6.0, 0.01, False),
        ("magnus_saturation.strength", 6.0, 0.01, False),
        ("buoyancy.a", 0.6, 0.01, False),
        ("restitution_speed.slope", 0.12, 0.001, False),
        ("static_charge.strength", 1e9, 1.0, True),
    ],
)
def test_values_out_of_their_range_are_named_with_its_source(name, value, sigma, plausible):
    text = implausible(name, Value(value, sigma, "1"), 0.02)
    assert (text == "") is plausible
    if text:
        assert name in text
        assert range_of(name, 0.02).source in text
    assert implausible(name, Value(value, sigma, "1"), 0.0335) == ""


def test_gravity_and_buoyancy_are_one_entry(calm_fit, make_ball):
    catalogue = [EFFECTS["gravity"], EFFECTS["buoyancy"]]
    listed = hypotheses(make_ball(), scene_of(calm_fit), catalogue)
    assert [h.name for h in listed] == ["gravity"]
    alone = hypotheses(make_ball(), scene_of(calm_fit), catalogue[1:])
    assert [h.name for h in alone] == ["buoyancy"]


def test_directions_that_change_nothing_do_not_count(make_ball, make_launches, make_shots, make_fit):
    """The same time offset on all axes is a shift of the clock: no track shows it, the others differ from zero."""
    offset = Hypothesis(EFFECTS["time_offset"], {}, ("x", "y", "z"))
    data = make_shots(make_ball(time_offset={"x": 0.003}), make_launches(16, 7), 7).stretches
    before = make_fit(make_ball(), data)
    assert insignificant(fit_with(before, offset), [offset], before) == []
