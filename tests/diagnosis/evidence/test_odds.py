"""Probabilities of effects: what the prior costs, what is invisible, and what the other half does not bear out."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from scipy.stats import norm

from ballfg.diagnosis.evidence.odds import odds_of, tempered
from ballfg.diagnosis.evidence.prior import THERE, WIDTHS, choice_odds, log_odds, scales, within
from ballfg.diagnosis.evidence.rows import NAMELESS, random_motion
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.weighed import Weight, weigh
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.signatures import columns_of
from ballfg.diagnosis.search.refits import refit
from ballfg.diagnosis.search.score import Scored
from ballfg.dynamics import EFFECTS

WIND = Hypothesis(EFFECTS["wind"], {}, ("x", "y", "z"))


@pytest.fixture(scope="module")
def calm(calm_fit):
    return weigh(calm_fit)


@pytest.fixture(scope="module")
def calm_with_wind(calm_fit):
    return weigh(refit(calm_fit, Scored(WIND, None, 0.0)).fit, [WIND])


@pytest.fixture(scope="module")
def windy_declared(windy_fit):
    return weigh(windy_fit)


@pytest.fixture(scope="module")
def refitted(windy_fit):
    """The windy shots with wind in the model."""
    return refit(windy_fit, Scored(WIND, None, 0.0)).fit


@pytest.fixture(scope="module")
def windy_with_wind(refitted):
    return weigh(refitted, [WIND])


def model(names, evidence, held_out=None, prior=0.0):
    named = [Hypothesis(EFFECTS[name], {}, ("x",)) for name in names]
    gains = np.full(10, evidence / 10.0) if held_out is None else np.asarray(held_out)
    weight = Weight(evidence, log_odds(named), gains, prior)
    return SimpleNamespace(names=frozenset(names), nested={}, neighbours={}, score=weight.score, **vars(weight))


def borne_out(effect, *smaller):
    """The tempered evidence of a model, beside smaller ones."""
    return tempered(effect.names, effect, {one.names: one for one in smaller})


def test_a_strength_of_five_times_the_usual_one_costs_two_nats():
    """The density of a strength that is known exactly, beside that of the best single width."""

    def density(strength):
        widths = np.array(WIDTHS)
        return np.mean(np.exp(-0.5 * (strength / widths) ** 2) / widths)

    best = np.exp(-0.5) / 5.0
    assert -2.5 < np.log(density(5.0) / best) < -1.0
    assert np.log(density(5.0) / density(1.0)) > -3.0


def test_a_slower_clock_is_as_probable_as_less_gravity(make_ball, make_launches, make_shots, make_fit):
    """Without spin labels no sample tells them apart: what differs is how far each is from what is usual."""
    shots = make_shots(make_ball(gravity={"g": 9.0}), make_launches(32, 4), 4, labelled=False)
    declared, found, usual = make_fit(make_ball(), shots.stretches), [], []
    for name, strength, unit in (("gravity", "g", 1.0), ("time_scale", "s", 2.0 * 9.81)):
        hypothesis = Hypothesis(EFFECTS[name], {}, (strength,))
        weighed = weigh(refit(declared, Scored(hypothesis, None, 0.0)).fit, [hypothesis])
        away = float(weighed.strengths[name].mean[0]) - (9.81 if name == "gravity" else 0.0)
        spreads = np.array(WIDTHS) * scales(hypothesis)
        found.append(weighed.evidence)
        usual.append(np.log(norm.pdf(away, scale=spreads).mean() / unit))
    assert found[1] - found[0] == pytest.approx(usual[1] - usual[0], abs=0.7)


def test_a_step_that_leads_nowhere_promises_no_evidence(make_ball, make_launches, make_shots, make_fit):
    """A model with both is no more probable than one of them, from whatever values it is weighed.

    From a clock that is off, all the way to gravity in its place is beyond the linear range.
    """
    shots = make_shots(make_ball(gravity={"g": 9.0}), make_launches(32, 4), 4, labelled=False)
    clock, gravity = (Hypothesis(EFFECTS[name], {}, (n,)) for name, n in (("time_scale", "s"), ("gravity", "g")))
    with_clock = refit(make_fit(make_ball(), shots.stretches), Scored(clock, None, 0.0)).fit
    problem, values = refit(with_clock, Scored(gravity, None, 0.0)).fit.problem, with_clock.unknowns.values
    both = {name: {**values, "flight.gravity.g": 9.81}[name] for name in problem.free}
    from_clock = Fit.at(problem, replace(with_clock.unknowns, values=both), with_clock.noise)
    assert weigh(from_clock, [clock, gravity]).evidence < weigh(with_clock, [clock]).evidence + 0.5


def test_an_effect_with_a_twin_has_the_prior_of_both():
    both, one = ([Hypothesis(EFFECTS[name], {}, (strength,))] for name, strength in (("gravity", "g"), ("scale", "x")))
    assert np.exp(log_odds(one)) == pytest.approx(THERE / (1.0 - THERE))
    assert np.exp(log_odds(both)) == pytest.approx(2.0 * THERE / (1.0 - 2.0 * THERE))


def test_probabilities_follow_evidence_and_prior():
    nothing, wind, tilt = model([], 0.0), model(["wind"], 6.0), model(["frame_tilt"], 4.0)
    odds = odds_of([nothing, wind, tilt])
    prior = THERE / (1.0 - THERE)
    weights = np.array([1.0, np.exp(6.0) * prior, np.exp(4.0) * prior])
    expected = weights / weights.sum()
    assert odds.nothing == pytest.approx(expected[0])
    assert odds.of("wind") == pytest.approx(expected[1])
    assert list(odds.effects()) == ["wind", "frame_tilt"]
    assert odds.of("scale") == 0.0


def test_what_the_other_half_does_not_bear_out_is_tempered():
    nothing = model([], 0.0)
    assert borne_out(model(["wind"], 20.0), nothing) == pytest.approx(20.0)
    little = np.tile([0.1, 0.3], 5)
    assert 2.0 < borne_out(model(["wind"], 20.0, little), nothing) < 3.0
    by_one = np.array([19.0, *np.full(9, -2.0)])  # that chance may have put there: the scatter says so
    assert borne_out(model(["wind"], 20.0, by_one), nothing) == pytest.approx(20.0)
    assert borne_out(model(["wind"], 20.0, np.full(10, -1.0)), nothing) == 0.0
    assert borne_out(model(["wind"], -3.0), nothing) == -3.0


def test_what_the_priors_say_needs_no_other_half():
    """A model without gravity's change that needs a table 27 mm too low, on one half as on the other."""
    improbable, held = model(["scale"], 1000.0, prior=-28.0), np.tile([100.2, 100.4], 5)
    both = model(["gravity", "scale"], 1026.0, held, prior=-3.0)
    assert borne_out(both, improbable) == pytest.approx(1026.0)
    assert borne_out(both, model(["scale"], 1000.0, prior=-3.0)) == pytest.approx(1003.0, abs=1.0)
    assert borne_out(model(["gravity", "scale"], 1026.0, held, prior=-50.0), improbable) < 1004.0


def test_an_addition_is_believed_as_far_as_it_gains_over_the_smaller_model():
    """With a true effect beside it a wrong one still gains over nothing, but less than the true one alone."""
    nothing, true = model([], 0.0), model(["wind"], 20.0, np.tile([2.5, 3.5], 5))
    both = model(["wind", "scale"], 40.0, np.tile([2.0, 3.0], 5))
    assert borne_out(both, nothing) == pytest.approx(40.0, abs=15.0)
    assert borne_out(both, nothing, true) == pytest.approx(20.0)
    odds = odds_of([nothing, true, both])
    assert odds.of("wind") > 0.99
    assert odds.of("scale") < 0.1


def test_the_doubt_of_a_smaller_model_decides_between_none_that_look_alike():
    """A clock or a scale beside a wind: without the wind the clock gains nothing on the other half."""
    nothing, wind = model([], 0.0), model(["wind"], 100.0)
    clock, scale = model(["time_scale"], 30.0, np.full(10, -1.0)), model(["scale"], 30.0)
    alike = [model(["wind", name], 150.0) for name in ("time_scale", "scale")]
    odds = odds_of([nothing, wind, clock, scale, *alike])
    assert [odds.of(name) for name in ("time_scale", "scale")] == pytest.approx([0.5, 0.5], abs=1e-6)


def test_what_is_foretold_loses_what_its_origin_loses():
    """A smaller model that only the linearisation of a wrong one knows is no better than that one."""
    nothing, wrong = model([], 0.0), model(["gust_region", "scale"], 60.0, np.full(10, -5.0))
    wrong.nested = {frozenset(["scale"]): Weight(50.0, model(["scale"], 0.0).odds, np.full(10, 5.0), 0.0)}
    odds = odds_of([nothing, wrong])
    assert odds.of("scale") < 0.1


def test_a_refit_counts_as_it_was_weighed():
    """Whatever another model's linearisation says of it."""
    nothing, both, wind = model([], 0.0), model(["wind", "scale"], 60.0), model(["wind"], 20.0)
    both.nested = {one.names: one for one in (model(["scale"], 8.0), model(["wind"], 61.0), model([], 3.0))}
    assert odds_of([nothing, both, wind]).of("scale") > 0.99
    odds = odds_of([nothing, both])
    assert odds.of("scale") < 0.1
    assert odds.of("wind") > 0.99


def test_neighbours_that_no_refit_weighed_count_as_foretold():
    nothing, wind, tilt = model([], 0.0), model(["wind"], 20.0), model(["frame_tilt"], 5.0)
    alone = odds_of([nothing, wind, tilt])
    wind.neighbours = {one.names: one for one in (model(["frame_tilt"], 40.0), model(["drag_spin"], 20.0))}
    odds = odds_of([nothing, wind, tilt])
    assert alone.of("wind") > 0.99
    assert odds.of("wind") == pytest.approx(0.5, abs=0.01)
    assert odds.of("drag_spin") == pytest.approx(0.5, abs=0.01)
    assert odds.of("frame_tilt") < 0.01


@pytest.mark.parametrize(("foretold", "refitted", "there"), [(19.9, -80.0, True), (-40.0, -80.0, False)])
def test_in_the_place_of_an_effect_far_beyond_the_linear_range_nothing_is_as_good(foretold, refitted, there):
    """About a gust the linearisation foretells that nothing needs it, and any effect does as well, or that they do."""
    nothing, gust = model([], refitted), model(["gust_region"], 20.0)
    gust.nested = {frozenset(): Weight(foretold, 0.0, np.full(10, foretold / 10.0), 0.0)}
    others = [model(["wind"], 20.0), model(["frame_tilt"], foretold)]
    gust.neighbours = {one.names: one for one in others}
    odds = odds_of([nothing, gust])
    assert (odds.of("gust_region") > 0.99) is there
    assert odds.of("wind") == pytest.approx(0.0 if there else 0.5, abs=0.01)
    assert odds.of("frame_tilt") < 0.01


REFITS = [(38.0, 30.0, True), (-20.0, 30.0, False), (-20.0, -30.0, True)]


@pytest.mark.parametrize(("refitted", "absent", "there"), REFITS)
def test_a_further_effect_that_refits_beside_fewer_denied_is_not_believed(refitted, absent, there):
    """Nor does what stands beside it gain: unless the absence of that was foretold just as wrongly."""
    tilt, wind, lens = "frame_tilt", "wind", "distortion"
    both, alone, other = model([tilt, wind], 34.0), model([tilt], absent), model([tilt, lens], refitted)
    both.nested = {alone.names: model([tilt], 30.0)}
    both.neighbours = {one.names: one for one in (model([tilt, wind, lens], 50.0), model([tilt, lens], 40.0))}
    assert (odds_of([model([], 0.0), both, alone, other]).of(lens) > 0.9) is there


def test_which_sets_were_weighed_without_patterns_too_does_not_decide_beside_them():
    """The wind was, and its gain beside patterns is not borne out over that; nobody knows of the scale's."""
    nothing, wind = model([], 0.0), model(["wind"], 10.0, np.full(10, 6.9))
    patterns, *sets = (model(names, evidence) for names, evidence in (([], 50.0), (["wind"], 70.0), (["scale"], 70.0)))
    for one in (patterns, *sets):
        one.names |= {NAMELESS}
    patterns.neighbours = {one.names: one for one in (patterns, *sets)}
    odds = odds_of([nothing, wind, patterns])
    assert [odds.of(name) for name in ("wind", "scale")] == pytest.approx([0.5, 0.5], abs=1e-6)


def test_effects_that_cannot_be_told_apart_are_there_together():
    """Of two that explain the same neither is sure, one of them is."""
    nothing = model([], 0.0)
    group = [model([name, "wind"], 60.0 + more) for name, more in (("time_scale", 0.0), ("scale", 0.2))]
    odds, best = odds_of([nothing, *group]), group[1].names
    assert 0.5 < odds.of("scale") < 0.6
    assert odds.alike("scale", best) == ["time_scale"]
    more = odds_of([nothing, *group, model(["drag_spin", "wind"], 59.0)])
    assert more.alike("scale", best) == ["time_scale", "drag_spin"]
    assert odds.together("scale", best) > 0.99
    assert odds.alike("wind", best) == []
    assert odds.together("wind", best) == pytest.approx(odds.of("wind"))


def test_the_evidence_without_an_effect_is_that_of_its_columns_left_out(calm, calm_with_wind, windy_with_wind):
    """On a calm day that of the declared model; in wind far below that of the model with wind."""
    assert calm_with_wind.nested[frozenset()].score == pytest.approx(calm.score, abs=1.0)
    assert windy_with_wind.nested[frozenset()].score < windy_with_wind.score - 20.0


def test_a_coefficient_that_models_state_as_exact_is_about_the_stated_value(calm, calm_fit):
    """Gravity is absent where g is 9.81 m/s2, not where a ball has no weight."""
    gravity = Hypothesis(EFFECTS["gravity"], {}, ("g",))
    weighed = weigh(refit(calm_fit, Scored(gravity, None, 0.0)).fit, [gravity])
    assert weighed.nested[frozenset()].score == pytest.approx(calm.score, abs=1.0)
    assert weighed.evidence > calm.evidence - 5.0


def test_a_choice_among_shapes_is_paid_for():
    assert choice_odds([Hypothesis(EFFECTS["gust_region"], {}, ("x",), 18)]) == pytest.approx(-np.log(18.0))
    assert choice_odds([WIND]) == 0.0
    np.testing.assert_array_equal(scales(WIND), 0.2)


def test_a_strength_beyond_a_bound_of_physics_explains_less():
    """Spin that grows: a decay's rate is not negative, so that only the tail of its posterior counts."""
    decay = Hypothesis(EFFECTS["spin_decay"], {}, ("rate",))
    inside, at_zero, beyond = (
        within(decay, np.zeros(1), np.array([sigmas * 0.05]), np.array([0.05]), 1.0) for sigmas in (8.0, 0.0, -5.0)
    )
    assert inside == pytest.approx(np.log(2.0), abs=0.01)  # half of the prior lies beyond the bound
    assert at_zero == pytest.approx(0.0, abs=0.01)
    assert beyond == pytest.approx(norm.logsf(5.0) + np.log(2.0), abs=0.01)
    far = within(decay, np.zeros(1), np.array([-40.0]), np.array([0.05]), 1.0)
    assert far == pytest.approx(norm.logsf(800.0) + np.log(2.0), rel=1e-6)


def test_what_is_foretold_is_what_a_refit_gains(windy_fit, windy_declared, windy_with_wind):
    before, after = windy_declared, windy_with_wind
    (gain,) = Screen.of(before, random_motion(windy_fit), [WIND], columns_of(windy_fit, [WIND])).gains
    assert gain > 20.0
    assert after.evidence - before.evidence > 0.8 * gain  # with noise of its own it gains more
    strengths = after.strengths["wind"]
    sigmas = np.sqrt(np.diagonal(strengths.covariance))
    assert (np.abs(strengths.mean - [0.5, -0.3, 0.0]) < 4.0 * sigmas).all()
    assert (after.held_out - before.held_out).sum() > 0.5 * (after.evidence - before.evidence)


def test_patterns_lose_against_an_effect_that_is_there(
    windy_fit, calm_fit, calm, windy_declared, refitted, windy_with_wind
):
    declared, named = windy_declared, windy_with_wind
    patterns, both = weigh(windy_fit, nameless=True), weigh(refitted, [WIND], nameless=True)
    assert named.score > max(patterns.score, both.score) + 2.0
    assert weigh(calm_fit, nameless=True).score < calm.score
    assert patterns.names == {NAMELESS}
    assert both.names == {"wind", NAMELESS}
    odds = odds_of([declared, named, patterns, both])
    assert odds.effects() == {"wind": odds.of("wind")}
    assert odds.of("wind") > 0.9
    assert odds.nameless < 0.2


def test_a_name_that_explains_a_part_is_not_believed_beside_patterns(make_ball, make_launches, make_shots, make_fit):
    """Wind that grows with the height: an even wind explains most of it, on both halves."""
    sheared = make_ball(wind_shear={"x": 8.0, "y": -5.0})
    declared = make_fit(make_ball(), make_shots(sheared, make_launches(16, 5), 5, rate=40.0).stretches)
    windy = refit(declared, Scored(WIND, None, 0.0)).fit
    without = [weigh(declared), weigh(windy, [WIND])]
    assert odds_of(without).of("wind") > 0.95
    beside = [weigh(declared, nameless=True), weigh(windy, [WIND], nameless=True)]
    odds = odds_of([*without, *beside])
    assert odds.of("wind") < 0.5
    assert odds.nameless > 0.95


def test_an_effect_that_is_not_there_costs_its_prior(calm_fit, calm, calm_with_wind):
    (gain,) = Screen.of(calm, random_motion(calm_fit), [WIND], columns_of(calm_fit, [WIND])).gains
    assert gain < 1.0
    assert calm_with_wind.evidence - calm.evidence == pytest.approx(gain, abs=1.0)
