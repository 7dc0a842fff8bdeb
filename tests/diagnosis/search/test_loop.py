"""The search: the effect that is there, silence where nothing is, and what it says of each candidate."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ballfg.diagnosis.evidence.rows import NAMELESS
from ballfg.diagnosis.evidence.weighed import weighed
from ballfg.diagnosis.fit.effects import has_effect, without_effect
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.stamps import Stamps
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.hypotheses.varying import Grouping, Varying
from ballfg.diagnosis.result import Errors, Outcome
from ballfg.diagnosis.search.found import Found
from ballfg.diagnosis.search.loop import SearchLoop
from ballfg.diagnosis.search.models import with_strengths_of, without_at_shapes
from ballfg.diagnosis.search.refits import Attempt, refit
from ballfg.diagnosis.search.score import Scored
from ballfg.diagnosis.search.stamp_effects import first_fit
from ballfg.diagnosis.search.trial import try_hypotheses
from ballfg.dynamics import EFFECTS
from ballfg.estimation.settings import Settings

CATALOGUE = [EFFECTS[name] for name in ("gravity", "wind", "table_tilt", "spin_decay")]


def holdout(search, held_out):
    """The part of a holdout that the search asks for."""
    settings = Settings(spin_label_noise=4.0)
    return SimpleNamespace(search=search, held_out=held_out, settings=settings, stamps=Stamps(), tracks=())


def shots(make_ball, make_launches, make_shots, seed, **truth):
    return make_shots(make_ball(**truth), make_launches(10, seed), seed, duration=0.45, rate=50.0).stretches


def unwatched(line):
    """Nobody watches."""


def predicts_well(fitted):
    """A fit that predicts with its model: the search asks for no more."""
    return fitted.problem.model


def judges_alike(model):
    """Predictions of the judging half that are as good with every model."""
    return Errors(10.0, 10.0, 1.0, 0.0, np.array([10.0]))


@pytest.fixture(scope="module")
def leaning(make_ball, make_launches, make_shots):
    """A search on shots over a table that leans by 1.1 degrees."""
    truth = {"table_tilt": {"x": 0.02, "y": 0.0}}
    data = (shots(make_ball, make_launches, make_shots, seed, **truth) for seed in (71, 72))
    return SearchLoop(holdout(*data), CATALOGUE, predicts_well, judges_alike, unwatched)


@pytest.fixture(scope="module")
def tilted(leaning, make_ball):
    """What it finds: the first fit, the result, and what it says."""
    said = []
    search = replace(leaning, watch=said.append).run(make_ball())
    return search.first, search, said


def test_the_effect_that_is_there_comes_first(tilted):
    _, search, _ = tilted
    (finding,) = search.findings
    assert finding.name == "table_tilt"
    for axis, truth in (("x", 0.02), ("y", 0.0)):
        value = finding.parameters[axis]
        assert abs(value.value - truth) < 4 * value.sigma
        assert value.unit == "rad"
    assert finding.delta_bic < -20.0
    assert finding.p_value < 1e-3
    assert finding.held_out_gain > 0.0
    assert finding.held_out_p < 0.05
    assert finding.indistinguishable_from == ()


def test_the_model_holds_what_was_found(tilted):
    first, search, _ = tilted
    assert has_effect(search.fit.problem.model, "table_tilt")
    assert not has_effect(first.problem.model, "table_tilt")
    assert set(first.problem.free) == set(declared_free(first.problem.model))
    assert set(search.fit.problem.free) - set(first.problem.free) == {"bounce.table_tilt.x", "bounce.table_tilt.y"}
    assert float(np.prod(search.fit.noise.position)) < float(np.prod(first.noise.position))


def test_every_round_ranks_every_candidate(tilted):
    _, search, said = tilted
    assert len(search.rounds) == 2
    first, second = ({c.name: c for c in rows} for rows in search.rounds)
    assert set(first) == {"gravity", "wind", "table_tilt", "spin_decay"}
    assert first["table_tilt"].outcome is Outcome.ADDED
    assert Outcome.ADDED not in {c.outcome for c in second.values()}
    assert "table_tilt" not in second
    explained = [c.explained for c in search.rounds[0]]
    assert explained == sorted(explained, reverse=True)
    assert any(line.startswith("round 1: fitting with table_tilt") for line in said)


def test_nothing_is_added_where_nothing_is(make_ball, make_launches, make_shots):
    data = (shots(make_ball, make_launches, make_shots, seed) for seed in (73, 74))
    search = SearchLoop(holdout(*data), CATALOGUE, predicts_well, judges_alike, unwatched).run(make_ball())
    assert search.findings == ()
    assert search.fit is search.first
    assert len(search.rounds) == 1


def test_what_balls_usually_have_is_found_though_no_score_calls(make_ball, make_launches, make_shots):
    """Friction, left out: its score at absence says little, and its absence is a minimum of its own."""
    data = (shots(make_ball, make_launches, make_shots, seed) for seed in (75, 76))
    declared = without_effect(make_ball(), "friction")
    search = SearchLoop(holdout(*data), [EFFECTS["friction"]], predicts_well, judges_alike, unwatched).run(declared)
    (finding,) = search.findings
    assert finding.name == "friction"
    assert abs(finding.parameters["mu"].value - 0.25) < 4 * finding.parameters["mu"].sigma


def test_a_strength_beyond_the_usual_is_named_and_said(make_ball, make_launches, make_shots):
    """A table that leans by 3.4 degrees: nobody has one, but the tracks show it."""
    data = (shots(make_ball, make_launches, make_shots, seed, table_tilt={"x": 0.06, "y": 0.0}) for seed in (71, 72))
    loop = SearchLoop(holdout(*data), [EFFECTS["table_tilt"]], predicts_well, judges_alike, unwatched)
    (finding,) = loop.run(make_ball()).findings
    assert finding.name == "table_tilt"
    assert finding.probability > 0.99
    assert finding.usual.endswith(
        "rad: usually between -0.03 and 0.03 (a table that leans by more lets a ball roll off)"
    )


def test_predictions_do_not_decide(make_ball, make_launches, make_shots):
    """They are reported; a few balls that miss the table's end would decide a root mean square."""
    data = (shots(make_ball, make_launches, make_shots, seed, table_tilt={"x": 0.02, "y": 0.0}) for seed in (71, 72))

    def judge(model):
        rmse = 15.0 if has_effect(model, "table_tilt") else 10.0
        return Errors(rmse, rmse, 1.0, 0.0, np.array([rmse]))

    search = SearchLoop(holdout(*data), [EFFECTS["table_tilt"]], predicts_well, judge, unwatched).run(make_ball())
    assert [finding.name for finding in search.findings] == ["table_tilt"]


def test_effects_are_named_from_a_probability_on(make_ball, make_launches, make_shots):
    """A tilt so small that the tracks leave it open; the probability is what it is, the name is a choice."""
    data = [shots(make_ball, make_launches, make_shots, seed, table_tilt={"x": 0.0025, "y": 0.0}) for seed in (71, 72)]
    loop = SearchLoop(holdout(*data), [EFFECTS["table_tilt"]], predicts_well, judges_alike, unwatched)
    strict, loose = (replace(loop, name_at=at).run(make_ball()) for at in (0.9999, 0.01))
    assert strict.odds.models == loose.odds.models
    assert 0.01 < loose.odds.of("table_tilt") < 0.9999
    assert strict.findings == ()
    assert [finding.name for finding in loose.findings] == ["table_tilt"]


def test_a_distortion_is_found_about_a_center_at_the_edge_of_the_data(make_ball, make_launches, make_shots):
    truth = {"k": 0.008, "x": 2.5, "y": 0.3, "z": 0.1}
    data = (shots(make_ball, make_launches, make_shots, seed, distortion=truth) for seed in (71, 72))
    catalogue = [EFFECTS[name] for name in ("distortion", "scale")]
    search = SearchLoop(holdout(*data), catalogue, predicts_well, judges_alike, unwatched).run(make_ball())
    (finding,) = search.findings
    assert finding.name == "distortion"
    for name, value in truth.items():
        assert abs(finding.parameters[name].value - value) < 4 * finding.parameters[name].sigma, name


def test_of_two_that_cannot_be_told_apart_one_stands_in_the_model(make_ball, make_launches, make_shots):
    """A tilted frame beside a wind: with a slightly stronger wind a tilted table explains nearly as much."""
    truth = {"frame_tilt": {"x": 0.01, "y": 0.0}, "wind": {"x": 0.0, "y": 0.5, "z": 0.0}}
    data = [shots(make_ball, make_launches, make_shots, seed, **truth) for seed in (81, 82)]
    search = SearchLoop(
        holdout(*data),
        [EFFECTS[n] for n in ("table_tilt", "wind", "frame_tilt")],
        predicts_well,
        judges_alike,
        unwatched,
    ).run(make_ball())
    assert {finding.name for finding in search.findings} == {"frame_tilt", "wind"}
    tilt = next(finding for finding in search.findings if finding.name == "frame_tilt")
    assert tilt.indistinguishable_from == ("table_tilt",)
    assert tilt.probability < 0.9 < tilt.together
    assert search.odds.of("frame_tilt") + search.odds.of("table_tilt") < 1.1  # one of them, not both


def test_an_effect_goes_with_the_one_that_it_needs(make_ball, make_launches, make_shots):
    """Drag that grows with spin, where the declared model has no drag: both are found, and neither alone is a model."""
    data = [shots(make_ball, make_launches, make_shots, seed, drag_spin={"gain": 0.6}) for seed in (83, 84)]
    declared = without_effect(make_ball(), "drag")
    catalogue = [EFFECTS["drag"], EFFECTS["drag_spin"]]
    search = SearchLoop(holdout(*data), catalogue, predicts_well, judges_alike, unwatched).run(declared)
    assert [finding.name for finding in search.findings] == ["drag", "drag_spin"]
    assert frozenset(["drag_spin"]) not in search.odds.models


@pytest.fixture(scope="module")
def gusty(make_ball, make_launches, make_shots):
    """A search on shots in a frame that is turned by 1.1 degrees, through a gust in one part of the room."""
    truth = {"frame_tilt": {"x": 0.02, "y": 0.0}, "gust_region": {"x": 3.0, "y": 6.0, "z": 3.0}}
    data = (shots(make_ball, make_launches, make_shots, seed, **truth) for seed in (71, 72))
    catalogue = [EFFECTS[name] for name in ("frame_tilt", "wind", "gravity")]
    return SearchLoop(holdout(*data), catalogue, predicts_well, judges_alike, unwatched)


@pytest.fixture(scope="module")
def gusty_first(gusty, make_ball):
    """The fit that a search on them begins with."""
    return first_fit(make_ball(), gusty.holdout)


def test_what_is_named_beside_something_nameless_is_as_strong_in_the_model(gusty, make_ball):
    """Free, it would make up for the gust that the catalogue lacks."""
    search = gusty.run(make_ball())
    assert search.odds.nameless > 0.99
    tilt = next(finding for finding in search.findings if finding.name == "frame_tilt").parameters["x"]
    assert abs(tilt.value - 0.02) < 3 * tilt.sigma
    written = dict(search.fit.problem.model.named_parameters())
    assert float(written["measurement.frame_tilt.x"]) == pytest.approx(tilt.value)


def test_something_nameless_is_weighed_where_no_further_effect_is_left_to_try(gusty, make_ball):
    """A catalogue of one effect, which is named: its model has no neighbours, but may lack something nameless."""
    search = replace(gusty, catalogue=[EFFECTS["frame_tilt"]], of_some=[]).run(make_ball())
    assert search.odds.nameless > 0.99
    assert [finding.name for finding in search.findings] == ["frame_tilt"]
    (tilt,) = search.findings
    assert abs(tilt.parameters["x"].value - 0.02) < 3 * tilt.parameters["x"].sigma


def test_beside_something_nameless_effects_are_found_about_the_path_of_a_model(gusty, gusty_first):
    """Its evidence, strengths, what is left without each, and a fit without patterns."""
    found = Found(gusty, gusty_first)
    nothing = found.best
    while found.round():
        pass
    found.compare()
    declared, sets = found.sets  # about the paths of the declared model and of the best one
    assert declared.screen.model.names == {NAMELESS}
    assert sets.screen.model.names >= {"frame_tilt", NAMELESS}
    best, weights = found.best, sets.weights
    assert {"frame_tilt", NAMELESS} <= best.names
    assert best.score > weights[frozenset([NAMELESS])].score + np.log(100.0)
    rest = found.rest(best.named, best)
    assert rest.names == {NAMELESS}
    assert best.score > rest.score + np.log(100.0)
    tilt = best.strengths["frame_tilt"]
    assert (np.abs(tilt.mean - [0.02, 0.0]) < 3 * np.sqrt(np.diagonal(tilt.covariance))).all()
    assert found.plain(best).score > nothing.score  # its fit without patterns holds the effect too


def test_beside_something_nameless_an_idle_effect_costs_no_more_than_its_prior(gusty, gusty_first):
    """Weighed about the same path as nothing beside it: about another one, dozens of nats may lie between the two."""
    catalogue = [EFFECTS[name] for name in ("frame_tilt", "restitution_speed")]
    found = Found(replace(gusty, catalogue=catalogue, of_some=[]), gusty_first)
    assert found.round()
    assert found.best.names == {"frame_tilt"}
    found.compare()
    scores = found.scores
    idle = scores[frozenset(["restitution_speed", NAMELESS])] - scores[frozenset([NAMELESS])]
    assert -np.log(1000.0) < idle < 0.0


def test_an_effect_keeps_the_form_about_which_its_strength_is_known(make_ball, make_launches, make_shots):
    """Fits without patterns, of all named effects and of one alone, neither move the gust nor change its size."""
    truth = {"frame_tilt": {"x": 0.03, "y": 0.0}, "gust_region": {"x": 2.0, "y": 4.0, "z": 2.0}}
    data = (shots(make_ball, make_launches, make_shots, seed, **truth) for seed in (71, 72))
    catalogue = [EFFECTS[name] for name in ("frame_tilt", "gust_region")]
    found = Found(
        loop := SearchLoop(holdout(*data), catalogue, predicts_well, judges_alike, unwatched),
        first := first_fit(make_ball(), loop.holdout),
    )
    while found.round():
        pass
    best = found.best
    gust, tilt = (next(h for h in best.named if h.name == name) for name in ("gust_region", "frame_tilt"))
    form = {name: best.fit.unknowns.values[name] for name in gust.free() if name not in gust.columns}
    assert len(form) == 4
    held = with_strengths_of(best, best.fit).problem
    written = {name: float(value) for name, value in held.model.named_parameters()}
    assert not held.free.keys() & (form.keys() | set(gust.columns))
    assert {name: written[name] for name in form} == form
    assert [written[name] for name in gust.columns] == best.strengths[gust.name].mean.tolist()
    alone = without_at_shapes(best, [tilt], first)
    assert {name: alone.unknowns.values[name] for name in form} == form
    assert alone.problem.free.keys() == best.fit.problem.free.keys() - set(tilt.columns)
    assert np.isfinite(alone.cost)


def test_where_something_nameless_remains_the_search_begins_again(make_ball, make_launches, make_shots):
    """By single effects, from the declared model; what the first search missed is found, and the better one counts."""
    truth = {"frame_tilt": {"x": 0.03, "y": 0.0}, "gust_region": {"x": 2.0, "y": 4.0, "z": 2.0}}
    data = (shots(make_ball, make_launches, make_shots, seed, **truth) for seed in (71, 72))
    known, told = [EFFECTS["frame_tilt"]], list[str]()
    loop = SearchLoop(holdout(*data), known, predicts_well, judges_alike, told.append, of_some=[])
    found = Found(loop, first_fit(make_ball(), loop.holdout))
    found.search()
    astray = found.best
    assert astray.nameless
    found.loop = replace(loop, catalogue=[EFFECTS["restitution_speed"]])
    found.search_again()  # which knows nothing of what the first one found
    assert found.best.names == astray.names == {"frame_tilt", NAMELESS}
    assert found.rest(found.best.named, found.best).names == {NAMELESS}
    assert any("searching again" in line for line in told)
    found.loop = replace(loop, catalogue=[*known, EFFECTS["gust_region"]])
    begun = len(found.rounds)
    found.search_again()
    assert found.best.names == {"frame_tilt", "gust_region"}
    assert found.scores[found.best.names] > found.scores[astray.names] + np.log(100.0)
    assert all(len(one.added) <= 1 for one in found.rounds[begun:])


@pytest.mark.parametrize("offered", [["distortion"], ["distortion", "drag_spin"]])
def test_a_wrong_effect_alone_gets_no_name(make_ball, make_launches, make_shots, offered):
    """Drag that grows with the spin, and a lens that distorts shots with and without spin alike."""
    parts = []
    for seed in (9, 10):
        launches = make_launches(24, seed, spread=0.1, spin=10.0)
        launches[::4, 7] += 150.0
        launches[1::4, 7] += 150.0
        parts.append(make_shots(make_ball(drag_spin={"gain": 1.5}), launches, seed, rate=60.0).stretches)
    catalogue = [EFFECTS[name] for name in offered]
    search = SearchLoop(holdout(*parts), catalogue, predicts_well, judges_alike, unwatched, of_some=[]).run(make_ball())
    assert [finding.name for finding in search.findings] == [name for name in offered if name == "drag_spin"]
    assert search.odds.of("distortion") < 0.05
    assert (search.odds.nameless > 0.99) is ("drag_spin" not in offered)


def test_a_model_that_the_last_round_made_shares_its_probability_with_its_neighbours(gusty, gusty_first):
    """A search that ends with as many effects as may be has not looked beyond them."""
    found = Found(gusty, gusty_first)
    found.together = 1
    assert found.round()
    last = found.best
    assert last.names == {"frame_tilt"}
    assert not last.neighbours
    found.compare()
    neighbours = {frozenset(["wind"]), frozenset(["frame_tilt", "wind"])}
    assert neighbours <= set(found.models[last.names].neighbours)
    assert neighbours <= set(found.odds.models)


def test_the_best_minimum_of_the_same_effects_counts(gusty, gusty_first):
    """A set that was refitted, and the same set that is left of a larger one."""
    found = Found(gusty, gusty_first)
    (better,) = found.models.values()
    poorer = replace(better, evidence=better.evidence - 100.0)
    for models in ([poorer, better], [better, poorer]):
        assert found.known(models) == [better]
    assert found.models == {frozenset(): better}


def test_a_poorer_minimum_of_a_smaller_model_is_left_once_from_a_larger_one(leaning, make_ball):
    """A refit from there starts where the larger one's linearisation leads, and counts from then on."""
    found = Found(leaning, first_fit(make_ball(), leaning.holdout))
    nothing, found.together = found.best, 1
    assert found.round()
    larger = found.best
    found.tried.clear()  # the round may have asked already
    less = 1e4 / len(nothing.held_out)  # nor does the other half bear it out
    poorer = replace(nothing, evidence=nothing.evidence - 1e4, held_out=nothing.held_out - less)
    found.models[frozenset()] = poorer
    assert found._smaller(larger)[frozenset()] > found.scores[frozenset()]
    again = found.without(larger.named)
    assert again.names == frozenset()
    assert again.score > nothing.score - 1.0  # the same minimum from another side, or a better one
    assert found._smaller(larger)[frozenset()] == found.scores[frozenset()]


def test_a_better_minimum_of_the_best_model_takes_its_place(leaning, make_ball):
    """Refits with a further effect may lead out of a poor minimum, and be no better than the model without it there."""
    found = Found(leaning, first_fit(make_ball(), leaning.holdout))
    assert found.round()
    right = found.best
    found.best = found.models[right.names] = replace(right, evidence=right.evidence - 100.0)
    while found.step():
        pass
    assert found.best.names == right.names
    assert found.best.score == pytest.approx(right.score, abs=1.0)


def test_what_promises_less_than_was_gained_waits(gusty, gusty_first):
    """Whatever cannot be foretold comes first, and the order of the rest is that of their promises."""
    found = Found(gusty, gusty_first)
    best, told = found.best, []
    _, attempts, _ = try_hypotheses(best, found.motion, gusty.catalogue, unwatched, 3)
    refits = max(attempts, key=lambda attempt: attempt.gain).refits
    gains = (np.inf, 1e6, 0.5, -1.0)
    made, winner = found._attempted([Attempt(str(gain), gain, refits) for gain in gains[::-1]], told.append)
    assert told == ["fitting with inf", "fitting with 1000000.0"]
    assert len(made) == 2 * len(refits)
    assert found.is_better(winner, best)


def test_no_effect_stays_without_which_a_refit_is_better(leaning, make_ball):
    """The linearisation about two strong effects may foretell far too little of the model without one of them."""
    found = Found(leaning, first_fit(make_ball(), leaning.holdout))
    assert found.round()
    right = found.models.pop(found.best.names)
    scored, _, _ = try_hypotheses(right, found.motion, [EFFECTS["wind"]], unwatched)
    with_wind = refit(right.fit, scored[0]).fit
    both = weighed(with_wind, (*right.named, scored[0].hypothesis), found.motion, found.halves, right)
    poor = {names: replace(weight, evidence=weight.evidence - 100.0) for names, weight in both.nested.items()}
    found.best = found.models[both.names] = replace(both, nested=poor)
    assert not found._pruned()
    assert found.best.names == {"table_tilt", "wind"}
    while found.step():
        pass
    assert found.best.names == right.names == {"table_tilt"}
    assert found.best.score > both.score
    assert found.best.score == pytest.approx(right.score, abs=1.0)


@pytest.mark.parametrize("from_linearisation", [True, False])
def test_an_effect_that_differs_between_tracks_stays_without_its_value_for_all(
    make_ball, make_launches, make_shots, from_linearisation
):
    """Wind for all tracks and its change along the recording are two names: either may go without the other."""
    data = (shots(make_ball, make_launches, make_shots, seed, wind={"x": 0.3}) for seed in (71, 72))
    loop = SearchLoop(holdout(*data), CATALOGUE, predicts_well, judges_alike, unwatched)
    found = Found(loop, first_fit(make_ball(), loop.holdout))
    late = {f"{i:03d}": 1.0 for i in range(5, 10)}
    drift = Varying.of(EFFECTS["wind"], ("x",), Grouping("track", {"005": late}, "000"))
    wind = Hypothesis(EFFECTS["wind"], {}, ("x",))

    def added(fit, hypothesis, *before):
        return weighed(
            refit(fit, Scored(hypothesis, None, 1.0)).fit, (*before, hypothesis), found.motion, found.halves, found.best
        )

    alone = added(found.first, drift)
    both = added(added(found.first, wind).fit, drift, wind)
    if not from_linearisation:
        both = replace(both, nested={})
    rest = found.without([wind], both)
    assert rest.names == {"wind_drift"}
    assert has_effect(rest.fit.problem.model, "wind")
    assert set(rest.fit.problem.deviations) == {"flight.wind.x[from 005]"}
    assert "flight.wind.x" not in rest.fit.problem.free
    assert rest.score == pytest.approx(alone.score, abs=2.0)  # the last steps are not worth making
    nothing = found.without([wind, drift], both)
    assert nothing.names == frozenset()
    assert not has_effect(without_at_shapes(both, [wind, drift], found.first).problem.model, "wind")
