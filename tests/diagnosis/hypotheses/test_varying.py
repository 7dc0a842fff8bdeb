"""Effects that differ between tracks: by group, from one track on, steadily; and those that do not."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ballfg.diagnosis.evidence.rows import random_motion
from ballfg.diagnosis.evidence.weighed import weigh
from ballfg.diagnosis.fit.fit import covariance_of, fit_model, fit_problem
from ballfg.diagnosis.fit.free import Unknowns
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.sensitivity import predict
from ballfg.diagnosis.fit.stretches import joined
from ballfg.diagnosis.hypotheses.signatures import hypothesis_columns
from ballfg.diagnosis.hypotheses.varying import Varying, groupings, near, varying_hypotheses
from ballfg.diagnosis.search.models import without_named
from ballfg.diagnosis.search.ranking import fitted_values
from ballfg.diagnosis.search.refits import refit
from ballfg.diagnosis.search.score import Scored
from ballfg.diagnosis.search.trial import try_varying
from ballfg.dynamics import EFFECTS, Scene
from ballfg.dynamics.variation import Variation
from ballfg.estimation import Settings
from ballfg.tracks import Track

COUNT, CHANGE = 24, 10
OLD, NEW = 0.93, 0.88
SCENE = Scene((-1.0, -1.0, 0.0), (1.0, 1.0, 1.0), (0.0, 0.0, 0.5), 4.0, 2.0, COUNT, COUNT)


def tracks(names, labels=None):
    plain = [{}] * len(names) if labels is None else labels
    return [
        Track(np.array([0.0, 0.1]), np.zeros((2, 3)), labels=own, name=name)
        for name, own in zip(names, plain, strict=True)
    ]


@pytest.fixture(scope="module")
def two_balls(make_ball, make_launches, make_shots):
    """Shots 000, 002, ...: the first of one ball, those from `CHANGE` on of another; the others 001, 003, ..."""
    halves = []
    for half in range(2):
        parts = [
            make_shots(make_ball(restitution={"e": e}), make_launches(count, 70 + 10 * half + k), 70 + half).stretches
            for k, (e, count) in enumerate(((OLD, CHANGE), (NEW, COUNT - CHANGE)))
        ]
        whole = joined(parts)
        names = tuple(f"{2 * i + half:03d}" for i in range(COUNT))
        halves.append(replace(whole, names=names, track=np.arange(COUNT)))
    return halves


@pytest.fixture(scope="module")
def holdout(two_balls):
    return SimpleNamespace(
        search=two_balls[0], held_out=two_balls[1], tracks=tracks([f"{i:03d}" for i in range(2 * COUNT)])
    )


@pytest.fixture(scope="module")
def before(two_balls, make_ball, make_fit) -> Fit:
    return make_fit(make_ball(), two_balls[0])


@pytest.fixture(scope="module")
def found(before, holdout):
    catalogue = [EFFECTS[name] for name in ("drag", "restitution", "wind", "table_tilt")]
    ways = groupings(holdout.tracks, before.problem.stretches.names)
    scored, attempts = try_varying(weigh(before), random_motion(before), catalogue, ways, lambda line: None)
    return scored, sorted((task() for attempt in attempts for task in attempt.refits), key=lambda r: r.delta_bic)


def test_another_ball_is_found_with_both_values_and_the_track_from_which_on_it_flew(found):
    _, refits = found
    best = refits[0]
    assert best.name == "restitution_drift"
    (variation,) = best.fit.variations().values()
    assert list(variation.values) == ["000", f"{2 * CHANGE:03d}"]
    sigma = np.sqrt(covariance_of(best.fit, best.scored.hypothesis.columns)[0, 0])
    values = list(variation.values.values())
    assert values[0] == pytest.approx(OLD, abs=4 * sigma)
    assert values[1] == pytest.approx(NEW, abs=4 * sigma)
    assert best.scored.p_value < 1e-6


def test_nothing_differs_where_one_ball_flew_all_the_time(make_ball, make_launches, make_shots, make_fit, holdout):
    stretches = make_shots(make_ball(), make_launches(COUNT, 90), 90).stretches
    names = tuple(f"{2 * i:03d}" for i in range(COUNT))
    alike = replace(stretches, names=names)
    fit, ways = make_fit(make_ball(), alike), groupings(holdout.tracks, names)
    scored, attempts = try_varying(weigh(fit), random_motion(fit), list(EFFECTS.values()), ways, lambda line: None)
    assert len(scored) > 20
    assert attempts == []


def test_values_that_a_model_declares_are_fitted(found, two_balls, holdout, make_ball):
    """From poor ones to those that the search found, whose fit has the same minimum."""
    model = make_ball()
    model.variations = {"bounce.restitution.e": Variation("track", {"000": 0.9, f"{2 * CHANGE:03d}": 0.91})}
    fitted = fit_model(model, two_balls[0], Settings(spin_label_noise=4.0), tracks=holdout.tracks)
    (declared,), (searched,) = fitted.variations().values(), found[1][0].fit.variations().values()
    np.testing.assert_allclose(list(declared.values.values()), list(searched.values.values()), atol=2e-4)


def test_without_it_the_fit_is_the_one_before(found, before):
    best = found[1][0]
    alone = without_named(best.fit, [best.scored.hypothesis], before)
    assert alone.problem.deviations == {}
    assert set(alone.problem.free) == set(before.problem.free)
    found_again = fit_problem(alone.problem, alone.unknowns, alone.noise, settle_noise=False)
    assert found_again.cost == pytest.approx(before.cost, rel=1e-4)


def test_an_absent_effect_that_differs_leaves_the_model_with_its_deviations(before, holdout):
    ways = groupings(holdout.tracks, before.problem.stretches.names)
    hypothesis = Varying.of(EFFECTS["wind"], ("x", "y"), ways[0])
    fitted = refit(before, Scored(hypothesis, None, 1.0)).fit
    assert "wind" in fitted.problem.model.flight
    assert "wind" not in without_named(fitted, [hypothesis], before).problem.model.flight


def test_columns_are_the_differences_of_predictions(before, holdout):
    """Central differences of the samples by a deviation, of an effect in the model and of an absent one."""
    ways = groupings(holdout.tracks, before.problem.stretches.names)
    for hypothesis in (
        Varying.of(EFFECTS["restitution"], ("e",), ways[2]),
        Varying.of(EFFECTS["wind"], ("x",), ways[-1]),
    ):
        columns = hypothesis_columns(before, [hypothesis])[..., 0]
        model = hypothesis.added_to(before.problem.model)
        (deviation,) = hypothesis.deviations().values()
        weights, step = deviation.along(before.problem.stretches), 1e-5
        base = before.unknowns.values.get(deviation.coefficient, 0.0)
        moved = [
            predict(
                model,
                before.problem.stretches,
                before.unknowns.starts,
                {**before.values, deviation.coefficient: base + sign * step * weights},
            ).positions
            for sign in (1, -1)
        ]
        difference = before.position_rows(((moved[0] - moved[1]) / (2 * step))[..., None])[..., 0]
        np.testing.assert_allclose(columns[:, : difference.shape[1]], difference, rtol=1e-4, atol=1e-3)


def test_a_fit_with_deviations_linearises_itself_rightly(found):
    """Central differences of the cost by every common unknown are its gradient: zero at the minimum."""
    fitted = found[1][0].fit
    gradient = fitted.gram.sum(axis=0)[:-1, -1]
    for place, name in enumerate(fitted.problem.free):
        sigma = float(np.sqrt(covariance_of(fitted, [name])[0, 0]))
        costs = []
        for sign in (1, -1):
            values = {**fitted.unknowns.values, name: fitted.unknowns.values[name] + sign * 0.01 * sigma}
            moved = Unknowns(fitted.unknowns.starts, values, fitted.unknowns.launcher)
            costs.append(Fit.at(fitted.problem, moved, fitted.noise).cost)
        assert abs(costs[0] - costs[1]) < 0.05 * max(1.0, abs(gradient[place]) * sigma)


def test_groups_steps_and_lines():
    names = [f"{i:02d}" for i in range(32)]
    labels = [{"group": "ab"[i % 4 // 2], "player": f"p{i}", "speed": 3.0} for i in range(32)]
    found = groupings(tracks(names, labels), names[::2])
    assert [way.by for way in found].count("group") == 1
    assert all(way.by != "player" for way in found)  # as many players as tracks
    group = found[0]
    assert set(group.weights) == {"a", "b"}
    assert {n for n, w in group.weights["a"].items() if w} == {n for i, n in enumerate(names) if i % 4 < 2}
    steps = [next(iter(way.weights)) for way in found if way.by == "track" and not way.line]
    assert steps == ["08", "12", "16", "20", "24"]  # three tracks of the half that is searched on either side
    (line,) = [way for way in found if way.line]
    assert line.weights["31"]["00"] == 0.0
    assert line.weights["31"]["31"] == 1.0


def test_what_differs_is_said_of_groups_and_of_the_recording():
    names = [f"{i:02d}" for i in range(32)]
    ways = groupings(tracks(names, [{"group": "ab"[i % 4 // 2]} for i in range(32)]), names[::2])
    group, drift = (
        Varying.of(EFFECTS["restitution"], ("e",), next(w for w in ways if (w.by == "group") is own))
        for own in (True, False)
    )
    assert (group.name, drift.name) == ("restitution_by_group", "restitution_drift")
    assert group.sentence == "The coefficients of restitution differ between the tracks' values of 'group'."
    assert drift.sentence.startswith("The coefficients of restitution change along the recording")
    assert group.decide.startswith("Shoot the groups in turns")
    assert drift.decide.startswith("Repeat shots of the first part")
    assert (group.strengths, drift.strengths[0][:7]) == (("e[a]", "e[b]"), "e[from ")


def test_the_place_of_a_step_is_looked_for_between_its_neighbours():
    names = [f"{i:02d}" for i in range(32)]
    way = next(w for w in groupings(tracks(names), names[::2]) if "16" in w.weights)
    step = Varying.of(EFFECTS["restitution"], ("e",), way)
    assert [next(iter(h.grouping.weights)) for h in near(step, names[::2], names)] == ["12", "14", "16", "18", "20"]


def test_names_out_of_order_tell_no_place():
    names = ["b", "a", *(f"{i}" for i in range(20))]
    assert groupings(tracks(names), names[::2]) == []


def test_what_may_differ(make_ball):
    """Coefficients that are fitted, absent effects of one shape; nothing that differs already."""
    names = [f"{i:02d}" for i in range(32)]
    ways = groupings(tracks(names), names[::2])[:1]
    model, catalogue = make_ball(), list(EFFECTS.values())
    free = {"flight.drag.k", "bounce.restitution.e", "bounce.restitution.e[from 08]"}
    listed = {h.name for h in varying_hypotheses(model, SCENE, catalogue, free, ways)}
    assert {"drag_drift", "wind_drift", "table_tilt_drift", "time_scale_drift"} <= listed
    assert not {"restitution_drift", "gust_region_drift", "spin_decay_drift", "magnus_drift", "gravity_drift"} & listed


def test_a_report_tells_the_value_at_each_level(found):
    best = found[1][0]
    told = fitted_values(best.fit, best.scored.hypothesis)
    assert list(told) == ["e[from 000]", f"e[from {2 * CHANGE:03d}]"]
    assert [v.value for v in told.values()] == pytest.approx([OLD, NEW], abs=0.01)
    assert all(0.0 < v.sigma < 0.01 for v in told.values())
