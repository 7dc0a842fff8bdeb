"""Models whose coefficients differ between tracks: every estimator and prediction uses the track's own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.dynamics.population import SpinGroup, SpinPopulation
from ballfg.dynamics.variation import Variation
from ballfg.estimation import Online, Settings, predict_tracks
from ballfg.estimation.batch import estimate_tracks
from ballfg.estimation.noise.linear_tracks import linearise
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.simulation import SimulationConfig, parse_effects, simulate

SETTINGS = Settings(position_noise=(0.002, 0.002, 0.002))
UNSURE = replace(SETTINGS, coefficients={"bounce.restitution.e": 0.01, "flight.drag.k": 0.01})
TABLE = Surfaces.table_tennis(0.76)  # that of the simulation
METHODS = ("smoother", "online", "ekf", "sliding-window")


def varied(**values):
    model = nominal_model()
    model.variations = {"bounce.restitution.e": Variation("group", values)}
    return model


def with_restitution(e):
    model = nominal_model()
    model.bounce["restitution"].e.data.fill_(e)
    return model


@pytest.fixture(scope="module")
def tracks():
    """Two of an old table, two of a new one, two of none that the model knows."""
    found = []
    for group, e in (("old", 0.8), ("new", 0.95), ("other", 0.93)):
        made = simulate(SimulationConfig(tracks=2, seed=3, undeclared=parse_effects((f"restitution.e={e}",))))
        found += [replace(m.track, labels={"group": group}, name=f"{group}-{i}") for i, m in enumerate(made)]
    return found[::2] + found[1::2]


@pytest.mark.parametrize(
    ("method", "settings"),
    [
        *(pytest.param(method, SETTINGS, id=f"{method}-known") for method in METHODS),
        pytest.param("smoother", UNSURE, id="smoother-unsure"),
        *(pytest.param(m, UNSURE, marks=pytest.mark.thorough, id=f"{m}-unsure") for m in METHODS[1:]),
    ],
)
def test_every_track_is_estimated_with_its_own_values(tracks, method, settings):
    """The same numbers as from a model that has those values for all tracks; they may be the mean of a prior."""
    estimator = make_estimator(method, varied(old=0.8, new=0.95), TABLE, settings)
    for track, estimate in zip(tracks, estimate_tracks(estimator, tracks, len(tracks), 1), strict=True):
        e = {"old": 0.8, "new": 0.95}.get(track.labels["group"])
        model = nominal_model() if e is None else with_restitution(e)
        alone = make_estimator(method, model, TABLE, settings).estimate(track)
        np.testing.assert_array_equal(estimate.states, alone.states)
        predicted, expected = estimate.predict(0.3), alone.predict(0.3)
        np.testing.assert_array_equal(predicted.states, expected.states)


def test_predictions_come_in_the_order_of_the_tracks_with_their_own_values(tracks):
    observe = 0.25
    estimator = make_estimator("smoother", varied(old=0.8, new=0.95), TABLE, SETTINGS)
    found = list(predict_tracks(estimator, tracks, len(tracks), observe))
    assert [p.name for p in found] == [t.name for t in tracks]
    for track, prediction in zip(tracks, found, strict=True):
        e = {"old": 0.8, "new": 0.95}.get(track.labels["group"])
        model = nominal_model() if e is None else with_restitution(e)
        (alone,) = predict_tracks(make_estimator("smoother", model, TABLE, SETTINGS), [track], 1, observe)
        np.testing.assert_allclose(prediction.positions, alone.positions, atol=1e-9)
        np.testing.assert_allclose(prediction.sigmas, alone.sigmas, rtol=1e-6)


def test_noise_is_looked_for_about_each_tracks_own_motion(tracks):
    smoother = Smoother(varied(old=0.8, new=0.95), TABLE, SETTINGS)
    together = linearise(smoother, tracks[:2])
    for row, e in enumerate((0.8, 0.95)):
        alone = linearise(Smoother(with_restitution(e), TABLE, SETTINGS), tracks[row : row + 1])
        count = alone.errors.shape[1]
        np.testing.assert_allclose(together.errors[row, :count], alone.errors[0], atol=1e-12)


def test_a_stream_of_a_group_has_the_coefficients_of_the_group(tracks):
    """A stream has no labels: its settings name the group, whose coefficients count beside its spins."""
    groups = SpinPopulation("group", {name: SpinGroup((0.0,) * 3, (60.0,) * 3, 10) for name in ("old", "new")})
    track = tracks[0]
    for group, e in (("old", 0.8), ("new", 0.95)):
        settings = replace(SETTINGS, spins=groups, group=group)
        streams = [Online(model, TABLE, settings) for model in (varied(old=0.8, new=0.95), with_restitution(e))]
        for time, position in zip(track.times, track.positions, strict=True):
            found, expected = (stream.push(time, position) for stream in streams)
        assert found is not None
        np.testing.assert_array_equal(found.mean, expected.mean)


@pytest.mark.parametrize("label", ["old", "other", None])
def test_the_group_of_the_settings_is_that_of_tracks_without_a_label(tracks, label):
    """A label that the model does not know is none of its groups: the model's own value holds."""
    groups = SpinPopulation("group", {name: SpinGroup((0.0,) * 3, (60.0,) * 3, 10) for name in ("old", "new")})
    settings = replace(SETTINGS, spins=groups, group="new")
    track = replace(tracks[0], labels={} if label is None else {"group": label})
    found = make_estimator("smoother", varied(old=0.8, new=0.95), TABLE, settings).estimate(track)
    model = {"old": with_restitution(0.8), "other": nominal_model(), None: with_restitution(0.95)}[label]
    alone = make_estimator("smoother", model, TABLE, settings).estimate(track)
    np.testing.assert_array_equal(found.states, alone.states)
