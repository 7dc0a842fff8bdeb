"""Coefficients and winds that differ from track to track: they come back, and take the place of false names."""

from __future__ import annotations

import re
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

from ballfg.diagnosis.diagnosis import differing
from ballfg.diagnosis.evidence.rows import COEFFICIENTS, random_motion
from ballfg.diagnosis.evidence.sizes import LEAST
from ballfg.diagnosis.evidence.weighed import weigh
from ballfg.diagnosis.fit.fit import alike, followed
from ballfg.diagnosis.fit.free import OWN_AIR
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.scatter import by_own
from ballfg.diagnosis.fit.stretches import joined
from ballfg.diagnosis.hypotheses.hypothesis import hypotheses, scene_of
from ballfg.diagnosis.search.refits import refit
from ballfg.diagnosis.search.score import Scored
from ballfg.diagnosis.search.trial import screened
from ballfg.dynamics import EFFECTS

DRAG, RESTITUTION = "flight.drag.k", "bounce.restitution.e"
COUNT = 30
FLOWN = {"rate": 80.0, "duration": 0.9, "noise": 0.0006}


def shots_of(balls, launches, make_shots):
    """One shot of each ball."""
    parts = []
    for k, ball in enumerate(balls):
        one = make_shots(ball, launches[k : k + 1], k, **FLOWN).stretches
        parts.append(replace(one, names=(f"{k:03d}",), track=np.array([k])))
    return joined(parts)


@pytest.fixture(scope="module")
def own():
    """What the drag (1/m), the restitution and the wind along x and y (m/s) of each track differ by."""
    scatter = np.random.default_rng(3).standard_normal((COUNT, 4))
    return (scatter - scatter.mean(axis=0)) * [0.012, 0.03, 0.3, 0.3]


@pytest.fixture(scope="module")
def scattered(make_ball, make_launches, make_shots, make_fit, own):
    """A fit of one ball to tracks each of which has its own drag, restitution and wind."""
    balls = [
        make_ball(drag={"k": 0.12 + drag}, restitution={"e": 0.87 + restitution}, wind={"x": x, "y": y})
        for drag, restitution, x, y in own.tolist()
    ]
    return make_fit(make_ball(), shots_of(balls, make_launches(COUNT, 5), make_shots))


@pytest.fixture(scope="module")
def weighed_scattered(scattered):
    return weigh(scattered)


def test_sizes_of_the_scatter_come_back(scattered, weighed_scattered, own):
    motion, sizes = random_motion(scattered), np.exp(weighed_scattered.noise.random)
    found = dict(zip(motion.spread, sizes[motion.own_kinds] * motion.units, strict=True))
    assert found[DRAG] == pytest.approx(own[:, 0].std(), rel=0.35)
    assert found[RESTITUTION] == pytest.approx(own[:, 1].std(), rel=0.35)
    assert found[OWN_AIR[0]] == pytest.approx(0.3 * np.sqrt(2.0 / 3.0), rel=0.35)  # one size for all three axes
    assert found["bounce.friction.mu"] < 0.02
    assert (np.log(sizes[:COEFFICIENTS]) < -2.0).all()  # no accelerations and kicks in place of them


def test_each_track_has_what_it_was_given(weighed_scattered, own):
    found = weighed_scattered.fit.unknowns.own
    for place, name in enumerate((DRAG, RESTITUTION, *OWN_AIR[:2])):
        assert np.corrcoef(found[name], own[:, place])[0, 1] > 0.9, name


def test_paths_with_own_coefficients_leave_the_noise_alone(scattered, weighed_scattered):
    """About them every stretch is linear; one ball for all tracks misses by much more."""
    left = [
        np.abs(fit.whitened[fit.problem.stretches.used.numpy()]).mean() for fit in (scattered, weighed_scattered.fit)
    ]
    assert left[1] < 0.5 * left[0]
    again = alike(weighed_scattered.fit)
    assert not again.unknowns.own
    assert again.cost == pytest.approx(followed(scattered, again.unknowns).cost, rel=0.02)


def test_scatter_gives_no_effect_a_gain(scattered, weighed_scattered):
    names = ("wind", "wind_shear", "spin_decay", "drag_speed", "restitution_speed", "frame_tilt", "gravity")
    listed = hypotheses(scattered.problem.model, scene_of(scattered), [EFFECTS[name] for name in names])
    scored, _ = screened(weighed_scattered, [h for h in listed if h.strengths], random_motion(scattered))
    assert {s.hypothesis.name for s in scored if s.odds > 0.0} == set()


def test_nothing_scatters_where_tracks_are_alike(make_ball, make_launches, make_shots, make_fit):
    fit = make_fit(make_ball(), make_shots(make_ball(), make_launches(20, 6), 6, **FLOWN).stretches)
    model = weigh(fit)
    sizes = np.exp(model.noise.random)[random_motion(fit).own_kinds] * random_motion(fit).units
    found = dict(zip(random_motion(fit).spread, sizes, strict=True))
    assert min(model.noise.random[COEFFICIENTS:]) == pytest.approx(LEAST, abs=1.0)
    assert found[DRAG] < 0.004
    assert found[OWN_AIR[0]] < 0.06


def test_a_wind_of_all_beside_the_winds_of_tracks_is_known_as_well_as_these_allow(
    make_ball, make_launches, make_shots, make_fit
):
    """Its error is the scatter over the root of the number of tracks, far more than the noise of samples."""
    winds = 0.4 + 0.3 * np.random.default_rng(8).standard_normal(COUNT)
    balls = [make_ball(wind={"x": x}) for x in winds.tolist()]
    fit = make_fit(make_ball(), shots_of(balls, make_launches(COUNT, 9), make_shots))
    (wind,) = hypotheses(fit.problem.model, scene_of(fit), [EFFECTS["wind"]])
    model = weigh(refit(fit, Scored(wind, None, 0.0)).fit, [wind])
    found = model.strengths["wind"]
    sigmas = np.sqrt(np.diagonal(found.covariance))
    assert model.score > weigh(fit).score + 2.0
    assert abs(found.mean[0] - winds.mean()) < 3.0 * sigmas[0]
    assert sigmas[0] == pytest.approx(0.3 * np.sqrt(2.0 / 3.0) / np.sqrt(COUNT), rel=0.5)


@pytest.mark.parametrize("name", [DRAG, RESTITUTION, OWN_AIR[1]])
def test_columns_of_own_coefficients_are_those_of_differences(scattered, name):
    step = 1e-5
    columns = by_own(scattered, [name])[..., 0]
    ends = []
    for sign in (1.0, -1.0):
        unknowns = replace(scattered.unknowns, own={name: np.full(COUNT, sign * step)})
        moved = Fit.at(scattered.problem, unknowns, scattered.noise)
        ends.append(moved.weighted_residual(scattered.robust))
    differences = (ends[1] - ends[0]) / (2.0 * step)
    assert np.abs(columns - differences).max() < 1e-4 * np.abs(differences).max()


def test_a_search_tells_what_differs_and_how_well_the_mean_is_known(scattered, weighed_scattered, own):
    """The error of a coefficient of all tracks is at least its scatter over the root of their number."""
    search = SimpleNamespace(whole=scattered, scatter=weighed_scattered.scatter)
    (sentence,) = differing(search)
    found = re.findall(r"(drag\.k|restitution\.e|the wind) by ([\d.]+)", sentence)
    assert [name for name, _ in found] == ["drag.k", "restitution.e", "the wind"]
    expected = (own[:, 0].std(), own[:, 1].std(), 0.3 * np.sqrt(2.0 / 3.0))
    assert [float(size) for _, size in found] == pytest.approx(expected, rel=0.35)
    for place, name in enumerate((DRAG, RESTITUTION)):
        assert weighed_scattered.sigmas[name] > 0.7 * own[:, place].std() / np.sqrt(COUNT)
    assert differing(SimpleNamespace(whole=scattered, scatter=dict.fromkeys(weighed_scattered.scatter, 1e-6))) == []
