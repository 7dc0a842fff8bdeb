"""Which effects may be lacking, and models with and without them."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ballfg.diagnosis.fit.effects import has_effect, with_effects, without_effect
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.sensitivity import predict
from ballfg.diagnosis.hypotheses.hypothesis import LOOSE, Hypothesis, hypotheses, scene_of
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.effect import Scene
from ballfg.dynamics.effects.flight import DragSpeed, GustRegion, Wind

SCENE = Scene((-0.2, -0.8, 0.8), (3.0, 0.9, 1.5), (1.2, 0.1, 1.0), 4.5, 2.5, 20, 12)
WIND = Hypothesis(Wind, {}, ("x", "y", "z"))


def names(listed):
    return {h.name for h in listed}


@pytest.fixture(scope="module")
def stretches(make_ball, make_launches, make_shots):
    return make_shots(make_ball(), make_launches(3, 3), 3, rate=20.0, duration=0.5).stretches


@pytest.fixture(scope="module")
def every(make_ball):
    return hypotheses(make_ball(), SCENE, EFFECTS.values())


def test_an_absent_effect_changes_nothing(make_ball, stretches, every):
    plain = predict(make_ball(), stretches, stretches.starts.numpy(), {})
    seen = set()
    for hypothesis in every:
        if hypothesis.name in seen or has_effect(make_ball(), hypothesis.name):
            continue
        seen.add(hypothesis.name)
        model = hypothesis.added_to(make_ball())
        assert set(hypothesis.columns) <= set(dict(model.named_parameters()))
        found = predict(model, stretches, stretches.starts.numpy(), {})
        np.testing.assert_allclose(found.positions, plain.positions, rtol=0, atol=1e-9, err_msg=hypothesis.name)
        np.testing.assert_allclose(found.labels, plain.labels, rtol=1e-12, err_msg=hypothesis.name)
    assert len(seen) >= 18


def test_what_is_looked_for(every, make_ball):
    found = names(every)
    assert found >= {"wind", "wind_shear", "gust_region", "drag_speed", "table_tilt", "spin_label_frame", "time_scale"}
    assert "gravity" in found  # declared as exact
    assert not found & {"drag", "magnus", "restitution", "friction"}  # declared, and estimated anyway
    gusts = [h for h in every if h.name == "gust_region"]
    assert len(gusts) > 4
    assert all(h.strengths == ("x", "y", "z") for h in gusts)
    assert "drag_speed" not in names(hypotheses(without_effect(make_ball(), "drag"), SCENE, EFFECTS.values()))


def test_without_contacts_or_labels_their_effects_are_not_looked_for(make_ball):
    silent = Scene(SCENE.low, SCENE.high, SCENE.middle, SCENE.speed, float("nan"), 0, 0)
    found = hypotheses(make_ball(), silent, EFFECTS.values())
    assert not any(h.effect.kind == "bounce" or h.name.startswith("spin_label") for h in found)
    assert "wind" in names(found)


def test_what_a_refit_estimates():
    assert {n: c.sigma for n, c in WIND.free().items()} == {f"flight.wind.{a}": LOOSE * 0.3 for a in "xyz"}
    shaped = Hypothesis(DragSpeed, {"reference": 4.5}, ("slope",))
    # a reference is a convention: another one is another drag
    assert {n: c.sigma for n, c in shaped.free().items()} == {"flight.drag_speed.slope": LOOSE * 0.02}
    gust = Hypothesis(GustRegion, GustRegion.shapes(SCENE)[0], ("x", "y", "z"))
    assert len(gust.free()) == 7


def test_every_hypothesis_can_be_fitted(every):
    """Priors of what a refit estimates have a width."""
    for hypothesis in every:
        assert all(c.sigma > 0.0 for c in hypothesis.free().values()), hypothesis.name


def test_a_shape_stands_in_the_model(make_ball):
    model = Hypothesis(DragSpeed, {"reference": 4.5}, ("slope",)).added_to(make_ball())
    values = {n: float(p) for n, p in model.named_parameters()}
    assert values["flight.drag_speed.reference"] == 4.5
    assert values["flight.drag_speed.slope"] == 0.0


def test_models_are_copies(make_ball):
    model = make_ball()
    larger = with_effects(model, Wind())
    assert not has_effect(model, "wind")
    assert has_effect(larger, "wind")
    assert not {id(e) for e in model.effects} & {id(e) for e in larger.effects}
    assert not any(p.requires_grad for p in larger.parameters())
    assert WIND.added_to(larger) is larger


def test_what_needs_an_effect_goes_with_it(make_ball):
    model = make_ball(drag_spin={}, magnus_saturation={})
    assert {e.name for e in without_effect(model, "drag").effects} == {
        "gravity", "magnus", "restitution", "friction", "magnus_saturation",
    }  # fmt: skip


def test_declared_coefficients_that_are_estimated(make_ball):
    free = declared_free(make_ball(drag_speed={}))
    assert "flight.gravity.g" not in free  # exact
    assert "flight.drag_speed.reference" not in free  # a shape
    assert {"flight.drag.k", "flight.magnus.k", "bounce.restitution.e", "flight.drag_speed.slope"} <= set(free)


def test_usual_effects_are_those_with_a_nominal_strength():
    assert {n for n in ("drag", "magnus", "friction", "wind", "drag_spin", "time_offset") if usual(n)} == {
        "drag",
        "magnus",
        "friction",
    }


def usual(name):
    strengths = tuple(c.name for c in EFFECTS[name].coefficients if c.absent is not None)
    return Hypothesis(EFFECTS[name], {}, strengths).usual


@pytest.mark.parametrize("offset", [0.0, 0.04, -0.04])
def test_impact_speeds_are_found_with_heights_that_lag_behind_the_stamps(
    offset, make_ball, make_launches, make_shots, make_fit
):
    model = make_ball(time_offset={"x": 0.0, "y": 0.0, "z": offset})
    fit = make_fit(model, make_shots(model, make_launches(6, 5), 5, rate=100.0, duration=0.6).stretches)
    # from 0.3 m above the table, less the ball's radius; two balls bounce a second time
    assert 1.9 < scene_of(fit).impact_speed < 2.8
    assert scene_of(fit).contacts == 8


def test_a_contact_after_the_last_sample_has_the_speed_of_that_sample(windy_fit):
    """A refit may move a bounce out of its track."""
    positions, times = windy_fit.predicted.positions, windy_fit.problem.stretches.times.numpy()
    after = SimpleNamespace(positions=positions, contacts=times[:, -1:] + 0.2)
    scene = scene_of(SimpleNamespace(problem=windy_fit.problem, predicted=after, noise=windy_fit.noise))
    falls = -(np.diff(positions[:, -2:, 2], axis=1) / np.diff(times[:, -2:], axis=1))
    assert scene.contacts == (falls > 0.0).sum() > 0
    assert scene.impact_speed == pytest.approx(float(np.median(falls[falls > 0.0])))


def test_regions_of_a_gust_lie_evenly_over_the_data() -> None:
    """A quarter of the longest side across, four by two by two of them."""
    shapes = GustRegion.shapes(SCENE)
    assert {shape["size"] for shape in shapes} == {0.25 * 3.2}
    assert sorted({shape["center_x"] for shape in shapes}) == pytest.approx([0.2, 1.0, 1.8, 2.6])
    assert sorted({shape["center_z"] for shape in shapes}) == pytest.approx([0.8 + 0.175, 0.8 + 0.525])
    assert len(shapes) == 16
