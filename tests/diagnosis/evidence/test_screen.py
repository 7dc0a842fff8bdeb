"""Sets of effects that one linearisation foretells, against refits of the same sets and all columns at once.

Beside patterns without a name they are held against every subset of a small catalogue.
"""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from ballfg.diagnosis.evidence.condensed import Condensed
from ballfg.diagnosis.evidence.likelihood import LOST, Reduced, held_out, posterior
from ballfg.diagnosis.evidence.odds import tempered
from ballfg.diagnosis.evidence.prior import WIDTHS, scales
from ballfg.diagnosis.evidence.rows import NAMELESS, Patterns, random_motion
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.sets import Sets
from ballfg.diagnosis.evidence.weighed import weigh
from ballfg.diagnosis.hypotheses.hypothesis import hypotheses, scene_of
from ballfg.diagnosis.hypotheses.signatures import columns_of
from ballfg.diagnosis.search.refits import refit, refit_set
from ballfg.diagnosis.search.score import Scored
from ballfg.diagnosis.search.trial import leading_sets, score_all, screened
from ballfg.dynamics import EFFECTS

CATALOGUE = [EFFECTS[name] for name in ("wind", "drag_speed", "restitution_speed", "frame_tilt")]


@pytest.fixture(scope="module")
def declared(make_ball, make_launches, make_shots, make_fit):
    """Shots through a wind onto a table whose restitution falls with the speed; the model has neither."""
    true = make_ball(wind={"x": 0.5, "y": -0.3}, restitution_speed={"slope": 0.03, "reference": 2.5})
    return weigh(make_fit(make_ball(), make_shots(true, make_launches(16, 6), 6, rate=40.0).stretches))


@pytest.fixture(scope="module")
def screen(declared):
    fit = declared.fit
    listed = [h for h in hypotheses(fit.problem.model, scene_of(fit), CATALOGUE) if h.strengths]
    listed = [h for h in listed if not set(h.columns) & set(fit.problem.free)]
    return screened(declared, listed, random_motion(fit))


def names(screen, chosen):
    return {screen.candidates[one].name for one in chosen}


def test_two_effects_are_found_in_one_round(screen):
    scored, found = screen
    sets = leading_sets(found, scored, 3)
    best = max(sets, key=lambda chosen: sets[chosen])
    assert names(found, best) >= {"wind", "restitution_speed"}
    assert found.odds(best) > max(found.odds((one,)) for one in best)


def test_a_set_is_refitted_to_what_was_foretold(screen, declared):
    scored, found = screen
    pair = next(
        c for c in found.sets(range(len(found.candidates)), 2) if names(found, c) == {"wind", "restitution_speed"}
    )
    tested = {id(s.hypothesis): s for s in scored}
    members = [tested[id(found.candidates[one])] for one in pair]
    made = refit_set(declared.fit, members, *found.step(pair))
    together = weigh(made.fit, made.added)
    assert together.score - declared.score > 0.8 * found.odds(pair)
    for hypothesis in made.added:
        strengths = together.strengths[hypothesis.name]
        true = {"wind": [0.5, -0.3, 0.0], "restitution_speed": [0.03]}[hypothesis.name]
        assert (np.abs(strengths.mean - true) < 4.0 * np.sqrt(np.diagonal(strengths.covariance))).all()


def test_one_candidate_is_foretold_as_its_score_test_says(screen):
    scored, found = screen
    by_test = {id(s.hypothesis): s.gain for s in scored}
    assert found.gains == [by_test[id(candidate)] for candidate in found.candidates]


def test_the_right_effect_in_place_of_a_wrong_one_is_foretold(make_ball, make_launches, make_shots, make_fit):
    """Wind seen by a model that has taken a tilted frame for it."""
    true = make_ball(wind={"x": 0.5, "y": -0.3})
    fit = make_fit(make_ball(), make_shots(true, make_launches(16, 7), 7, rate=40.0).stretches)
    wind, tilt = (
        next(h for h in hypotheses(fit.problem.model, scene_of(fit), [EFFECTS[n]])) for n in ("wind", "frame_tilt")
    )
    windy = weigh(refit(fit, Scored(wind, None, 0.0)).fit, [wind])
    wrong = weigh(refit(fit, Scored(tilt, None, 0.0)).fit, [tilt])
    found = Screen.of(wrong, random_motion(fit), [wind], columns_of(wrong.fit, [wind]))
    foretold = found.exchanges["frame_tilt", 0]
    assert wrong.score < foretold.score < windy.score + 1.0  # at the wrong model's noise, which is the larger
    assert found.neighbours[frozenset(["wind"])] == foretold


def test_no_set_without_anything_to_gain(make_ball, make_launches, make_shots, make_fit):
    fit = make_fit(make_ball(), make_shots(make_ball(), make_launches(16, 8), 8, rate=40.0).stretches)
    listed = [h for h in hypotheses(fit.problem.model, scene_of(fit), CATALOGUE) if h.strengths]
    scored, found = screened(weigh(fit), listed, random_motion(fit))
    assert leading_sets(found, scored, 4) == {}
    assert [s.hypothesis for s in scored] == [s.hypothesis for s in score_all(weigh(fit), listed)]


OWN, FURTHER = 4, 5
HALVES = np.array([True, False, False, True, True, False])


@pytest.fixture
def tracks():
    rng = np.random.default_rng(5)
    rows = rng.standard_normal((len(HALVES), 30, OWN + FURTHER + 1))
    return Reduced(rng.standard_normal(len(HALVES)), rows.swapaxes(1, 2) @ rows)


@pytest.fixture
def priors():
    rng = np.random.default_rng(6)
    return np.exp(rng.standard_normal(OWN)), rng.standard_normal(OWN)


@pytest.mark.parametrize("columns", [[], [2], [4, 0, 1]])
def test_it_is_the_evidence_of_all_columns_at_once(tracks, priors, columns):
    precision, away = priors
    columns = np.array(columns, dtype=np.intp)
    own = np.linspace(0.5, 2.0, len(columns))
    listed = np.array([*range(OWN), *(OWN + columns), OWN + FURTHER])
    part = Reduced(tracks.constant, tracks.gram[:, listed[:, None], listed])
    whole, far = np.append(precision, own), np.append(away, np.zeros(len(columns)))
    expected = posterior(part.of(np.full(len(HALVES), True)), whole, far)
    found = Condensed.of(tracks, precision, away, HALVES)
    one = found.whole(columns, own)
    assert one.evidence == pytest.approx(expected.evidence, rel=1e-12)
    assert one.mean == pytest.approx(expected.mean[OWN:], rel=1e-9)
    assert one.covariance == pytest.approx(expected.covariance[OWN:, OWN:], rel=1e-9)
    assert found.held_out(columns, own) == pytest.approx(held_out(part, whole, far, HALVES), rel=1e-9)


def test_rounding_that_leaves_nothing_has_no_evidence(tracks, priors):
    gram = tracks.gram.copy()
    gram[:, OWN, OWN] = -1e6
    found = Condensed.of(Reduced(tracks.constant, gram), *priors, HALVES)
    assert found.whole(np.array([0]), np.ones(1)).evidence == -np.inf
    assert (found.held_out(np.array([0]), np.ones(1)) == LOST).all()
    assert np.isfinite(found.whole(np.array([1]), np.ones(1)).evidence)


@pytest.fixture(scope="module")
def sets(make_ball, make_launches, make_shots, make_fit):
    """Shots in a tilted frame through a wind, seen by a model that has the wind and not the tilt."""
    true = make_ball(wind={"x": 0.5, "y": -0.3, "z": 0.0}, frame_tilt={"x": 0.02, "y": 0.0})
    fit = make_fit(make_ball(), make_shots(true, make_launches(14, 8), 8, rate=40.0).stretches)
    scene = scene_of(fit)
    (wind,) = hypotheses(fit.problem.model, scene, [EFFECTS["wind"]])
    windy = refit(fit, Scored(wind, None, 0.0)).fit
    model = weigh(windy, [wind], nameless=True)
    listed = hypotheses(windy.problem.model, scene, [EFFECTS[n] for n in ("frame_tilt", "gravity", "drag_speed")])
    listed = [h for h in listed if h.strengths and not set(h.columns) & set(windy.problem.free)]
    screen = Screen.of(model, random_motion(windy), listed, columns_of(windy, listed), Patterns.of(windy))
    return Sets.near(screen, 3)


def weight_of(sets, names):
    """The weight of a subset, its candidates added in the order of the catalogue to what is left of the model."""
    screen = sets.screen
    gone = tuple(place for place, h in enumerate(screen.effects) if h.name not in names)
    rest = screen.model.names & names
    weight = screen.model if rest == screen.model.names else screen.model.nested[rest]
    beside = ()
    for one, candidate in enumerate(screen.candidates):
        if candidate.name in names:
            weight, beside = screen.with_one(one, weight, beside, gone)
    return weight


def test_the_most_probable_of_all_subsets_is_found(sets):
    names = ["wind", *(h.name for h in sets.screen.candidates)]
    every = [frozenset([*chosen, NAMELESS]) for count in range(4) for chosen in combinations(names, count)]
    weights = {chosen: weight_of(sets, chosen) for chosen in every}
    best = max(sets.members, key=sets.score)
    assert "frame_tilt" in best
    assert sets.score(best) > max(tempered(n, w, weights) + w.odds for n, w in weights.items()) - 0.5
    for known, member in sets.members.items():
        assert member.weight.score == pytest.approx(weights[known].score, abs=1.0)  # widths were chosen in turn


def test_an_exchange_weighs_what_the_whole_linear_system_says(sets):
    """The tilt in place of the wind, by the inner products of all columns, the wind held where it is absent."""
    screen, names = sets.screen, frozenset(["frame_tilt", NAMELESS])
    assert sets.without(sets.without(frozenset([*names, "wind"]), ["wind"]), []) == names
    member, model = sets.members[names], screen.model
    ((one, width),) = member.beside
    assert member.gone == (0,)
    size, first = len(screen.candidates[one].strengths), len(screen.priors.base)
    tracks = screen.tracks[screen._noise(member.beside, member.gone)[0]]
    end = first + sum(len(h.strengths) for h in screen.candidates[:one])
    listed = np.array([*range(first), *range(end, end + size), tracks.gram.shape[-1] - 1])
    part = Reduced(tracks.constant, tracks.gram[:, listed[:, None], listed])
    sizes = WIDTHS[width] * scales(screen.candidates[one])
    precision = np.append(screen.priors.held([0], model.widths), sizes**-2)
    away = np.append(screen.priors.away, np.zeros(size))
    assert member.weight.held_out == pytest.approx(held_out(part, precision, away, model.halves), abs=1e-3)
    found = posterior(part.of(np.full(len(model.halves), True)), precision, away)
    strengths = screen.strengths(member.beside, member.gone)
    assert set(strengths) == {"frame_tilt"}
    assert strengths["frame_tilt"].mean == pytest.approx(found.mean[-size:], rel=1e-4)


def test_the_tilt_is_as_strong_as_it_was(sets):
    member = sets.members[max(sets.members, key=sets.score)]
    tilt = sets.screen.strengths(member.beside, member.gone)["frame_tilt"]
    assert (np.abs(tilt.mean - [0.02, 0.0]) < 4.0 * np.sqrt(np.diagonal(tilt.covariance))).all()
