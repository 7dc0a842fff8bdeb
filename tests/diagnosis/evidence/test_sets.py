"""Sets of effects beside patterns without a name, against every subset of a small catalogue."""

from __future__ import annotations

from itertools import combinations

import numpy as np
import pytest

from ballfg.diagnosis.evidence.likelihood import Reduced, held_out, posterior
from ballfg.diagnosis.evidence.odds import tempered
from ballfg.diagnosis.evidence.prior import WIDTHS, scales
from ballfg.diagnosis.evidence.rows import NAMELESS, Patterns, random_motion
from ballfg.diagnosis.evidence.screen import Screen
from ballfg.diagnosis.evidence.sets import Sets
from ballfg.diagnosis.evidence.weighed import weigh
from ballfg.diagnosis.hypotheses.hypothesis import hypotheses, scene_of
from ballfg.diagnosis.hypotheses.signatures import columns_of
from ballfg.diagnosis.search.candidates import Scored
from ballfg.diagnosis.search.refits import refit
from ballfg.dynamics import EFFECTS


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
    end = first + sum(len(h.strengths) for h in screen.candidates[:one])
    listed = np.array([*range(first), *range(end, end + size), screen.tracks.gram.shape[-1] - 1])
    part = Reduced(screen.tracks.constant, screen.tracks.gram[:, listed[:, None], listed])
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
