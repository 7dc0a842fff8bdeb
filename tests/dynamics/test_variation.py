"""Coefficients that differ between tracks: which value a track has, and what model files say of it."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from ballfg.dynamics import load_model, nominal_model, save_model
from ballfg.dynamics.model_file import model_from_dict
from ballfg.dynamics.variation import Variation, place_of
from ballfg.tracks import Track


def track(name="000", **labels):
    return Track(np.array([0.0, 0.1]), np.zeros((2, 3)), labels=labels, name=name)


def test_a_label_tells_the_value():
    variation = Variation("group", {"topspin": 0.93, "2": 0.88})
    assert variation.value(track(group="topspin")) == 0.93
    assert variation.value(track(group="2")) == 0.88
    assert variation.value(track(group="other")) is None
    assert variation.value(track()) is None
    assert variation.value(track(group=2.0)) == variation.value(track(group="2.0")) == 0.88


def test_a_value_holds_from_one_track_to_the_next_one_named():
    variation = Variation("track", {"a2": 0.93, "a10": 0.88})
    found = [variation.value(track(name)) for name in ("a1", "a2", "a9", "a10", "a200", "b1")]
    assert found == [None, 0.93, 0.93, 0.88, 0.88, 0.88]


def test_a_line_runs_over_the_numbers_of_the_tracks():
    variation = Variation("track", {"s-100": 1.0, "s-000": 2.0}, line=True)
    found = [variation.value(track(name)) for name in ("s-000", "s-025", "s-100", "s-250")]
    assert found == [2.0, 1.75, 1.0, 1.0]
    assert variation.value(track("shot")) is None


def test_places_are_in_the_order_in_which_people_count():
    names = ["1", "02", "9", "10", "a", "a2", "a10", "b1"]
    assert sorted(reversed(names), key=place_of) == names


def test_the_model_of_a_track_flies_and_bounces_with_its_own_coefficients():
    model = nominal_model()
    model.variations = {"bounce.restitution.e": Variation("group", {"old": 0.8})}
    state = torch.tensor([0.0, 0.0, 0.02, 1.0, 0.0, -2.0, 0.0, 0.0, 0.0], dtype=torch.float64)
    usual, old = (model.for_track(track(group=group)).after_bounce(state)[5].detach() for group in ("new", "old"))
    assert model.for_track(track(group="new")) is model
    assert float(old) == pytest.approx(1.6)
    assert float(usual) == pytest.approx(2.0 * float(model.bounce["restitution"].e.detach()))


def test_a_model_file_holds_them(tmp_path):
    model = nominal_model()
    model.variations = {
        "bounce.restitution.e": Variation("track", {"000": 0.93, "024": 0.88}),
        "flight.drag.k": Variation("track", {"000": 0.12, "099": 0.1}, line=True),
        "bounce.friction.mu": Variation("group", {"a": 0.2, "b": 0.3}),
    }
    save_model(model, tmp_path / "model.yaml")
    assert load_model(tmp_path / "model.yaml").variations == model.variations


@pytest.mark.parametrize(
    ("variations", "message"),
    [
        ([], r"section 'variations' must map coefficients to their values; got \[\]"),
        ({"flight.drag.kk": {}}, "variations: unknown coefficient 'flight.drag.kk'; did you mean 'flight.drag.k'"),
        ({"flight.drag.k": {"by": "group"}}, r"variations.flight.drag.k: must be a mapping with 'by'"),
        ({"flight.drag.k": {"by": "group", "values": {}}}, "values must hold at least one number"),
        ({"flight.drag.k": {"by": "group", "values": {"a": "much"}}}, r"values\['a'\] must be a number; got 'much'"),
        ({"flight.drag.k": {"by": "group", "values": {"a": float("nan")}}}, r"values\['a'\] must be finite"),
        ({"flight.drag.k": {"by": "group", "values": {"a": -1.0}}}, "each value must be at least 0, at most 2; got -1"),
        ({"flight.drag.k": {"by": "group", "values": {"a": 0.1}, "line": True}}, "line must be false unless by is"),
        ({"flight.drag.k": {"by": 3, "values": {"a": 0.1}}}, "'by' must be text"),
    ],
)
def test_what_is_wrong_is_said(variations, message):
    content = {"flight": {"drag": {}}, "bounce": {}, "variations": variations}
    with pytest.raises(ValueError, match=message):
        model_from_dict(content)
