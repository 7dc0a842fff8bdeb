"""Scoring and refitting hypotheses on simulated shots: a wind that is there, and nothing where nothing is.

Spin labels in another frame are found from the flights.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from ballfg.diagnosis.evidence.rows import random_motion
from ballfg.diagnosis.evidence.weighed import weigh
from ballfg.diagnosis.fit.effects import without_effect
from ballfg.diagnosis.fit.fit import values_of
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.search.refits import FRAMES_FITTED, frame_hypotheses, refit, refit_driven
from ballfg.diagnosis.search.score import ALARM, Score, Scored
from ballfg.diagnosis.search.trial import LEAST_GAIN, MOST_REFITS, leading_sets, score_all, screened, shortlist
from ballfg.dynamics import EFFECTS
from ballfg.dynamics.effects.measurement import SpinLabelFrame, signed_permutations

WIND_TRUE = np.array([0.5, -0.3, 0.0])


def hypothesis(name, **shape):
    return Hypothesis(EFFECTS[name], shape, tuple(c.name for c in EFFECTS[name].coefficients if c.absent is not None))


CANDIDATES = [
    hypothesis("wind"),
    hypothesis("drag_speed", reference=4.0),
    hypothesis("table_tilt"),
    hypothesis("spin_decay"),
    hypothesis("spin_label_scale"),
    hypothesis("buoyancy"),
]


def scores(fit, candidates):
    return score_all(weigh(fit), candidates)


@pytest.fixture(scope="module")
def scored(windy_fit):
    return scores(windy_fit, CANDIDATES)


@pytest.fixture(scope="module")
def wind_refit(windy_fit, scored):
    return refit(windy_fit, scored[0])


def test_wind_explains_most(scored):
    assert scored[0].hypothesis.name == "wind"
    assert scored[0].p_value < 1e-6
    explained = [s.score.explained for s in scored if s.score is not None]
    assert explained == sorted(explained, reverse=True)


def test_p_values_are_corrected_for_the_number_of_hypotheses(windy_fit, scored):
    alone = scores(windy_fit, [CANDIDATES[3]])[0]
    among = next(s for s in scored if s.hypothesis.name == "spin_decay")
    assert among.p_value == pytest.approx(min(1.0, len(CANDIDATES) * among.score.p_value), rel=1e-12)
    assert alone.p_value == alone.score.p_value


def test_without_hypotheses_nothing_is_scored_or_foretold(windy_fit):
    model = weigh(windy_fit)
    scored, screen = screened(model, [], random_motion(windy_fit))
    assert scored == [] == score_all(model, [])
    assert screen.neighbours == {} == leading_sets(screen, scored, 5)


def test_one_step_comes_near_the_wind(scored):
    """The score's one step from absent; the fit without wind has bent drag and first states."""
    np.testing.assert_allclose(scored[0].score.estimate, WIND_TRUE, atol=0.15)


def test_the_refit_finds_the_wind(wind_refit):
    names = [f"flight.wind.{a}" for a in "xyz"]
    for value, truth in zip(values_of(wind_refit.fit, names, {}).values(), WIND_TRUE, strict=True):
        assert abs(value.value - truth) < 4 * value.sigma
        assert value.sigma < 0.1


def test_friction_is_found_though_its_absence_is_a_minimum(make_ball, make_launches, make_shots, make_fit):
    """Without friction spins are fitted that friction contradicts; from its usual strength the way is open."""
    strong = make_ball(friction={"mu": 0.5})
    shots = make_shots(strong, make_launches(12, 21), 21, rate=50.0, labelled=False, duration=1.0).stretches
    before = make_fit(without_effect(make_ball(), "friction"), shots)
    after = refit(before, Scored(hypothesis("friction"), None, 0.0))
    assert after.delta_bic < -1000.0
    # from its absence it would stay at 0; spins that nobody labelled leave it a little open
    assert after.fit.unknowns.values["bounce.friction.mu"] == pytest.approx(0.5, abs=0.1)


def test_a_shear_is_found_with_its_reference(make_ball, make_launches, make_shots, make_fit):
    """The height at which the air stands still is fitted: what is tried at first is the middle of the data."""
    true = {"x": 0.8, "y": 0.0, "reference": 0.9}
    shots = make_shots(make_ball(wind_shear=true), make_launches(12, 22), 22, rate=50.0).stretches
    after = refit(make_fit(make_ball(), shots), Scored(hypothesis("wind_shear", reference=1.2), None, 0.0))
    names = [f"flight.wind_shear.{n}" for n in ("x", "reference")]
    for value, truth in zip(values_of(after.fit, names, {}).values(), (0.8, 0.9), strict=True):
        assert abs(value.value - truth) < 4 * value.sigma


def test_bic_counts_tracks(windy_fit, wind_refit):
    gain = 2.0 * (windy_fit.cost - wind_refit.fit.cost)
    assert wind_refit.delta_bic == pytest.approx(-gain + 3 * np.log(16), rel=1e-12)
    assert gain > 100.0
    # one step of the score foresaw the gain, from where the evidence has its maximum, and up to the bend of the flights
    # and the weights of far samples: a fifth here
    assert gain == pytest.approx(wind_refit.scored.score.explained, rel=0.3)


def test_nothing_is_found_where_nothing_is(calm_fit):
    found = scores(calm_fit, CANDIDATES)
    assert all(s.p_value > ALARM for s in found)
    assert all(s.gain < 1.0 for s in found)


def test_turning_the_scene_changes_nothing(windy, windy_fit, scored, make_fit, make_ball, turn):
    """Explained and p of wind as a whole stay, its estimate turns; a scalar's estimate stays."""
    angle, data = 2.2, windy.stretches
    labels, starts, positions = (turn(v, angle) for v in (data.labels, data.starts, data.positions))
    about = replace(data, labels=labels, starts=starts, positions=positions)
    found = {s.hypothesis.name: s for s in scores(make_fit(make_ball(), about, settle_noise=False), CANDIDATES)}
    plain = make_fit(make_ball(), data, settle_noise=False)
    for before in scores(plain, CANDIDATES):
        after = found[before.hypothesis.name]
        assert after.score.explained == pytest.approx(before.score.explained, rel=2e-3, abs=2e-3)
        assert np.log(after.p_value) == pytest.approx(np.log(before.p_value), rel=2e-3, abs=2e-2)
        estimate = torch.from_numpy(before.score.estimate)
        if before.hypothesis.name == "wind":
            estimate = turn(estimate, angle)
        elif before.hypothesis.name == "table_tilt":
            estimate = turn(torch.cat((estimate, estimate.new_zeros(1))), angle)[:2]
        estimate = estimate.numpy()
        np.testing.assert_allclose(after.score.estimate, estimate, rtol=5e-3, atol=5e-3 * np.abs(estimate).max())


def scored_with(name, gain):
    return Scored(hypothesis(name), Score(np.zeros(1), np.ones(1), 10.0, 0.5, 1, 20), 0.5, gain=gain)


def test_the_shortlist_holds_the_best_shape_of_each_effect():
    listed = [
        replace(scored_with("wind", 90.0), hypothesis=hypothesis("gust_region", center_x=2.0)),
        replace(scored_with("wind", 100.0), hypothesis=hypothesis("gust_region", center_x=1.0)),
        scored_with("wind", 80.0),
        scored_with("table_tilt", LEAST_GAIN - 0.1),
        replace(scored_with("spin_decay", 5.0), score=None),
    ]
    assert [s.hypothesis.name for s in shortlist(listed)] == ["gust_region", "wind"]
    assert shortlist(listed)[0].hypothesis.shape == {"center_x": 1.0}
    assert shortlist([]) == []
    names = [n for n in EFFECTS if EFFECTS[n].coefficients][: MOST_REFITS + 2]
    assert len(shortlist([scored_with(n, 100.0) for n in names])) == MOST_REFITS


def test_gravity_that_was_taken_to_be_exact(make_ball, make_launches, make_shots, make_fit):
    """A declared effect's exact coefficient is a hypothesis too: it can be scored and refitted."""
    data = make_shots(make_ball(gravity={"g": 9.4}), make_launches(8, 22), 22, duration=0.5, rate=40.0).stretches
    before = make_fit(make_ball(), data)
    (found,) = scores(before, [hypothesis("gravity")])
    assert found.p_value < ALARM
    after = refit(before, found)
    assert after.delta_bic < 0.0
    (value,) = values_of(after.fit, ["flight.gravity.g"], {}).values()
    assert abs(value.value - 9.4) < 4 * value.sigma


@pytest.fixture(scope="module")
def magnusless(make_ball):
    return without_effect(make_ball(), "magnus")


def lifted(make_ball, make_launches, make_shots, model, seed, duration=0.5):
    """Twelve shots with 150 rad/s of topspin about the axis across, which nobody labelled."""
    starts = make_launches(12, seed, spin=15.0)
    starts[:, 5] += 0.0 if duration > 0.3 else 1.0
    starts[:, 6:8] += 150.0 * torch.nn.functional.normalize(torch.stack((-starts[:, 4], starts[:, 3]), -1), dim=-1)
    return make_shots(model, starts, seed, labelled=False, duration=duration, rate=50.0).stretches


def test_an_unlabelled_spin_shows_its_lift(make_ball, make_launches, make_shots, make_fit, magnusless):
    before = make_fit(magnusless, lifted(make_ball, make_launches, make_shots, make_ball(), 31))
    (score,) = scores(before, [hypothesis("magnus")])
    found = refit_driven(before, hypothesis("magnus"))
    assert found.scored.p_value < 1e-6
    assert found.delta_bic < -50.0
    assert found.scored.score.explained > (score.score.explained if score.score else 0.0)
    lift = found.fit.unknowns.values["flight.magnus.k"] * found.fit.unknowns.launcher[0, 1]
    assert lift == pytest.approx(0.0028 * 150.0, rel=0.15)  # only the product is in the flights


@pytest.mark.parametrize("bounces", [True, False], ids=["with a bounce", "in free flight"])
def test_no_lift_is_found_where_none_is(make_ball, make_launches, make_shots, make_fit, magnusless, bounces):
    """In free flight nothing but the lift would tell the spins: each is free to fit noise."""
    data = lifted(make_ball, make_launches, make_shots, magnusless, 32, 0.5 if bounces else 0.24)
    before = make_fit(magnusless, data)
    assert bool(data.heights.isfinite().any()) is bounces
    found = refit_driven(before, hypothesis("magnus"))
    assert found.scored.p_value > ALARM
    assert found.delta_bic > 0.0


GENERAL = Hypothesis(SpinLabelFrame, {}, tuple(c.name for c in SpinLabelFrame.coefficients))
MIRROR = np.diag([1.0, -1.0, 1.0])
EXCHANGE = np.array([[0.0, 1.0, 0.0], [0.0, 0.0, -1.0], [1.0, 0.0, 0.0]])

FIRST = np.diag([1.0, 1.0, -1.0])
"""The one after the identity in the list of all."""


def matrix(hypothesis):
    return np.array([hypothesis.shape[c.name] for c in SpinLabelFrame.coefficients]).reshape(3, 3)


@pytest.fixture(scope="module")
def data(make_ball, make_launches, make_shots):
    """Twelve shots to all sides, with spins of 100 rad/s per axis."""
    starts = make_launches(12, 41, spread=3.0, spin=100.0)
    return make_shots(make_ball(), starts, 41, duration=0.5, rate=50.0).stretches


@pytest.fixture(scope="module", params=[MIRROR, EXCHANGE, FIRST], ids=["mirrored", "exchanged", "first"])
def wrong(request, data, make_fit, make_ball):
    """A frame and the fit to labels in it."""
    labels = data.labels @ torch.from_numpy(request.param).T
    return request.param, make_fit(make_ball(), replace(data, labels=labels))


def test_the_frame_is_found(wrong):
    frame, before = wrong
    found = frame_hypotheses(before, GENERAL)
    assert len(found) == FRAMES_FITTED
    assert all(h.strengths == () for h in found)
    np.testing.assert_array_equal(matrix(found[0]), frame)


def test_the_refit_reads_the_labels_in_it(wrong):
    frame, before = wrong
    found = frame_hypotheses(before, GENERAL)
    refits = [refit(before, Scored(h, None, 1e-6)) for h in found]
    assert refits[0].delta_bic < refits[1].delta_bic
    assert refits[0].delta_bic < -100.0
    after = refits[0].fit
    spins = after.problem.stretches.labels.numpy() @ np.linalg.inv(frame).T
    assert np.abs(after.unknowns.starts[:, 6:] - spins).max() < 5 * 4.0


def test_all_frames_but_the_one_at_hand():
    frames = signed_permutations().numpy()
    np.testing.assert_array_equal(frames[0], np.eye(3))
    assert len({f.tobytes() for f in frames}) == 48
    assert np.allclose(frames @ frames.swapaxes(1, 2), np.eye(3))
