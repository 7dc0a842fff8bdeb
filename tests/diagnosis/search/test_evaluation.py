"""Held-out likelihood of the true and of an idle effect, and errors of predictions."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.fit.fit import covariance_of, fit_problem
from ballfg.diagnosis.fit.holdout import EvaluationTrack
from ballfg.diagnosis.fit.stretches import joined
from ballfg.diagnosis.search.evaluation import (
    OBSERVED,
    error_of_mean,
    on_all,
    prediction_errors,
)
from ballfg.estimation.settings import Settings
from ballfg.tracks import Track


@pytest.fixture(scope="module")
def others(make_ball, make_launches, make_shots):
    """Twelve further shots, in the wind of `windy` and in still air."""
    blowing = make_ball(wind={"x": 0.5, "y": -0.3})
    return (
        make_shots(blowing, make_launches(12, 51), 51).stretches,
        make_shots(make_ball(), make_launches(12, 52), 52).stretches,
    )


def test_the_fit_to_all_tracks_is_that_of_both_halves_at_once(windy, windy_fit, others):
    """From the fit to one half, and the states that go with it on the other."""
    found = on_all(windy_fit, others[0])
    theirs = replace(others[0], track=others[0].track + len(windy.stretches))
    problem = replace(windy_fit.problem, stretches=joined([windy_fit.problem.stretches, theirs]))
    starts = np.concatenate((windy_fit.problem.stretches.starts.numpy(), theirs.starts.numpy()))
    unknowns = replace(windy_fit.unknowns, starts=starts)
    right = fit_problem(problem, unknowns, windy_fit.noise, settle_noise=False)
    assert found.cost == pytest.approx(right.cost, rel=1e-5)  # the tolerance of a minimisation
    assert len(found.gram) == len(np.unique(windy.stretches.track)) + 12
    sigmas = np.sqrt(np.diagonal(covariance_of(right, list(problem.free))))
    difference = [found.unknowns.values[n] - right.unknowns.values[n] for n in problem.free]
    assert (np.abs(difference) < 0.1 * sigmas).all()


def test_nothing_to_predict(make_ball, surfaces):
    with pytest.raises(ValueError, match="must leave 3 samples after the first 40% of them"):
        prediction_errors(make_ball(), [], surfaces, Settings(), 1)


def evaluated(data):
    """Stretches as tracks to judge predictions by."""
    return [
        EvaluationTrack(
            Track(
                data.times[i].numpy(), data.positions[i].numpy(), labels=labels_of(data.labels[i].tolist()), name=name
            ),
            data.contacts[i][~data.contacts[i].isnan()].numpy(),
        )
        for i, name in enumerate(data.names)
    ]


def test_the_error_of_a_nis_is_its_scatter_over_repeated_recordings():
    """Tracks of unlike lengths whose samples err alike: the tracks are what is independent."""
    rng = np.random.default_rng(6)

    def drawn():
        return [np.full(n, rng.chisquare(3) / 3) for n in rng.integers(20, 60, 30)]

    means = [float(np.concatenate(drawn()).mean()) for _ in range(400)]
    stated = [error_of_mean(drawn()) for _ in range(400)]
    assert np.mean(stated) == pytest.approx(np.std(means), rel=0.1)
    assert np.isnan(error_of_mean([np.ones(5)]))


def test_errors_of_predictions(make_ball, make_launches, make_shots, surfaces):
    tracks = evaluated(make_shots(make_ball(), make_launches(4, 53), 53, duration=0.5).stretches)
    settings = Settings(position_noise=(0.003,) * 3, spin_label_noise=4.0)
    right = prediction_errors(make_ball(), tracks, surfaces, settings, 1)
    wrong = prediction_errors(make_ball(drag={"k": 0.3}), tracks, surfaces, settings, 1)
    assert right.by_track.shape == (4,)
    assert 0.003 * np.sqrt(3) * 0.5e3 < right.prediction_rmse_mm < 15.0
    assert 0.3 < right.nis < 2.0
    assert 0.8 < right.intervals_held <= 1.0
    assert 0.5 < right.nis_median < 3.5
    assert wrong.intervals_held < right.intervals_held
    assert wrong.prediction_rmse_mm > 1.5 * right.prediction_rmse_mm
    assert wrong.log_likelihood < right.log_likelihood
    assert min(right.by_track) <= right.prediction_rmse_mm <= max(right.by_track)
    assert right.apex_rmse_mm < 20.0 or np.isnan(right.apex_rmse_mm)
    for path, one in zip(right.paths, tracks, strict=True):
        seen = len(path.seen)
        assert one.track.times[seen - 1] <= OBSERVED * one.track.duration < one.track.times[seen]
        np.testing.assert_array_equal(path.seen, one.track.positions[:seen])
        np.testing.assert_array_equal(path.measured, one.track.positions[seen:])
        np.testing.assert_allclose(path.times, one.track.times[seen:] - one.track.times[seen - 1], atol=1e-12)


def labels_of(spin):
    return dict(zip(("spin_x", "spin_y", "spin_z"), spin, strict=True))
