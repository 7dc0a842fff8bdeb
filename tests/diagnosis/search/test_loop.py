"""The search: the effect that is there, silence where nothing is, and what it says of each candidate."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.stamps import Stamps
from ballfg.diagnosis.result import Errors, Outcome
from ballfg.diagnosis.search.evaluation import got_worse
from ballfg.diagnosis.search.hypothesis import has_effect, without_effect
from ballfg.diagnosis.search.loop import SearchLoop
from ballfg.diagnosis.search.process_noise import PredictiveModel
from ballfg.dynamics import EFFECTS
from ballfg.estimation.settings import Settings

CATALOGUE = [EFFECTS[name] for name in ("gravity", "wind", "table_tilt", "spin_decay")]


def holdout(search, held_out):
    """The part of a holdout that the search asks for."""
    settings = Settings(spin_label_noise=4.0)
    return SimpleNamespace(search=search, held_out=held_out, settings=settings, stamps=Stamps(), tracks=())


def shots(make_ball, make_launches, make_shots, seed, **truth):
    return make_shots(make_ball(**truth), make_launches(14, seed), seed, duration=0.6, rate=50.0).stretches


def predicting(fitted, rmse):
    """A fit that predicts with some error, in mm: the search asks for no more."""
    return PredictiveModel(fitted.problem.model, Errors(rmse, rmse, 1.0, 0.0, np.array([rmse])))


def unwatched(line):
    """Nobody watches."""


def predicts_well(fitted):
    return predicting(fitted, 10.0)


def judges_alike(model):
    """Predictions of the judging half that are as good with every model."""
    return Errors(10.0, 10.0, 1.0, 0.0, np.array([10.0]))


@pytest.fixture(scope="module")
def tilted(make_ball, make_launches, make_shots):
    """A search on shots over a table that leans by 1.1 degrees."""
    truth = {"table_tilt": {"x": 0.02, "y": 0.0}}
    data = (shots(make_ball, make_launches, make_shots, seed, **truth) for seed in (71, 72))
    said = []
    search = SearchLoop(holdout(*data), CATALOGUE, predicts_well, judges_alike, said.append).run(make_ball())
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


def test_what_predicts_worse_is_not_added(make_ball, make_launches, make_shots):
    """However much better it fits: the predictions' errors here grow by a half with every effect."""
    data = (shots(make_ball, make_launches, make_shots, seed, table_tilt={"x": 0.02, "y": 0.0}) for seed in (71, 72))

    def predict(fitted):
        return predicting(fitted, 15.0 if has_effect(fitted.problem.model, "table_tilt") else 10.0)

    search = SearchLoop(holdout(*data), [EFFECTS["table_tilt"]], predict, judges_alike, unwatched).run(make_ball())
    assert search.findings == ()
    assert search.fit is search.first
    (row,) = search.rounds[0]
    assert row.outcome is Outcome.MISLEADING
    assert row.delta_bic < -20.0


def test_what_balls_usually_have_is_found_though_no_score_calls(make_ball, make_launches, make_shots):
    """Friction, left out: its score at absence says little, and its absence is a minimum of its own."""
    data = (shots(make_ball, make_launches, make_shots, seed) for seed in (75, 76))
    declared = without_effect(make_ball(), "friction")
    search = SearchLoop(holdout(*data), [EFFECTS["friction"]], predicts_well, judges_alike, unwatched).run(declared)
    (finding,) = search.findings
    assert finding.name == "friction"
    assert abs(finding.parameters["mu"].value - 0.25) < 4 * finding.parameters["mu"].sigma


def test_what_would_have_to_be_implausibly_strong_is_not_added(make_ball, make_launches, make_shots):
    """A table that leans by 3.4 degrees: a ball would roll off, so that something else must be the reason."""
    data = (shots(make_ball, make_launches, make_shots, seed, table_tilt={"x": 0.06, "y": 0.0}) for seed in (71, 72))
    loop = SearchLoop(holdout(*data), [EFFECTS["table_tilt"]], predicts_well, judges_alike, unwatched)
    search = loop.run(make_ball())
    assert search.findings == ()
    (row,) = search.rounds[0]
    assert row.outcome is Outcome.IMPLAUSIBLE
    assert "outside of -0.03 to 0.03 rad" in search.refused["table_tilt"].reason


def judged(rmse):
    return Errors(rmse, rmse, 1.0, 0.0, np.array([rmse]))


def test_what_predicts_the_judging_half_worse_is_not_added(make_ball, make_launches, make_shots):
    data = (shots(make_ball, make_launches, make_shots, seed, table_tilt={"x": 0.02, "y": 0.0}) for seed in (71, 72))

    def judge(model):
        return judged(10.2 if has_effect(model, "table_tilt") else 10.0)

    search = SearchLoop(holdout(*data), [EFFECTS["table_tilt"]], predicts_well, judge, unwatched).run(make_ball())
    assert search.findings == ()
    (row,) = search.rounds[0]
    assert row.outcome is Outcome.MISLEADING
    assert search.refused["table_tilt"].outcome is Outcome.MISLEADING


def test_a_refused_effect_leaves_no_pattern_to_lesser_names(make_ball, make_launches, make_shots):
    """Axes that are tilted, and a judge who refuses that: a scale that would fit most of it is not the cause."""
    data = [shots(make_ball, make_launches, make_shots, seed, frame_tilt={"x": 0.0, "y": 0.02}) for seed in (71, 72)]
    catalogue = [EFFECTS[name] for name in ("frame_tilt", "scale", "wind")]

    def judge(model):
        return judged(10.2 if has_effect(model, "frame_tilt") else 10.0)

    search = SearchLoop(holdout(*data), catalogue, predicts_well, judge, unwatched).run(make_ball())
    assert search.findings == ()
    outcomes = {row.name: row.outcome for row in search.rounds[0]}
    assert outcomes == {
        "frame_tilt": Outcome.MISLEADING,
        "scale": Outcome.SAME_PATTERN,
        "wind": Outcome.SAME_PATTERN,
    }


def test_a_distortion_is_found_about_a_center_at_the_edge_of_the_data(make_ball, make_launches, make_shots):
    truth = {"k": 0.008, "x": 2.5, "y": 0.3, "z": 0.1}
    data = (shots(make_ball, make_launches, make_shots, seed, distortion=truth) for seed in (71, 72))
    catalogue = [EFFECTS[name] for name in ("distortion", "wind", "frame_tilt", "scale")]
    search = SearchLoop(holdout(*data), catalogue, predicts_well, judges_alike, unwatched).run(make_ball())
    (finding,) = search.findings
    assert finding.name == "distortion"
    for name, value in truth.items():
        assert abs(finding.parameters[name].value - value) < 4 * finding.parameters[name].sigma, name


def errors_of(tracks):
    return Errors(float(np.sqrt(np.square(tracks).mean())), 1.0, 1.0, 0.0, np.asarray(tracks))


def test_predictions_are_worse_where_chance_does_not_make_them_so():
    before = np.random.default_rng(3).uniform(5.0, 15.0, 40)
    up_and_down = before * np.where(np.arange(40) % 2, 1.05, 0.96)  # a little worse on the whole
    assert 1.0 < errors_of(up_and_down).prediction_rmse_mm / errors_of(before).prediction_rmse_mm < 1.01
    assert not got_worse(errors_of(up_and_down), errors_of(before))
    assert got_worse(errors_of(1.005 * before), errors_of(before))  # as little, but on every track
    assert got_worse(errors_of(1.02 * up_and_down), errors_of(before))
    assert not got_worse(errors_of(0.99 * before), errors_of(before))
    one = 0.9 * up_and_down
    one[7] = 10 * before[7]  # misses the end of the table
    assert errors_of(one).prediction_rmse_mm > 1.3 * errors_of(before).prediction_rmse_mm
    assert not got_worse(errors_of(one), errors_of(before))
    missed = before.copy()
    missed[3] = 9 * before[3]  # another ball missed it before: its share in the scatter must not hide the others
    assert not got_worse(errors_of(one), errors_of(missed))
    one[8] = 10 * before[8]
    assert got_worse(errors_of(one), errors_of(before))


@pytest.mark.parametrize(
    ("typical", "ratio", "worse"), [(0.8, 1.04, False), (0.8, 1.06, True), (0.88, 1.04, False), (0.92, 1.04, True)]
)
def test_a_few_balls_may_be_predicted_worse_where_half_are_much_better(typical, ratio, worse):
    """Up to 5 % over all tracks, where the median track errs by a tenth less."""
    before = np.full(40, 10.0)
    after = typical * before
    after[:6] = np.sqrt((ratio**2 * 4000.0 - 34 * (10.0 * typical) ** 2) / 6)  # over all tracks: `ratio` of before
    assert errors_of(after).prediction_rmse_mm == pytest.approx(ratio * 10.0)
    assert got_worse(errors_of(after), errors_of(before)) is worse


def test_what_later_effects_make_superfluous_is_taken_out_again(make_ball, make_launches, make_shots):
    """The judging half is predicted best with the wind alone, which is found beside the table's tilt."""
    truth = {"table_tilt": {"x": 0.02, "y": 0.0}, "wind": {"x": 0.0, "y": 0.3, "z": 0.0}}
    data = [shots(make_ball, make_launches, make_shots, seed, **truth) for seed in (81, 82)]
    catalogue = [EFFECTS[name] for name in ("wind", "table_tilt")]

    def judge(model):
        return judged({0: 10.0, 1: 9.0, 2: 8.0}[sum(has_effect(model, e.name) for e in catalogue)])

    both = SearchLoop(holdout(*data), catalogue, predicts_well, judge, unwatched).run(make_ball())
    first, second = (finding.name for finding in both.findings)

    def judge_again(model):
        return judged(8.0 if has_effect(model, first) else 7.0)

    search = SearchLoop(holdout(*data), catalogue, predicts_well, judge_again, unwatched)._pruned(both)
    assert [finding.name for finding in search.findings] == [second]
    assert not has_effect(search.fit.problem.model, first)
    assert search.refused[first].outcome is Outcome.MISLEADING
    assert "8.0 mm off on the judging half with it, 7.0 mm without it" in search.refused[first].reason
