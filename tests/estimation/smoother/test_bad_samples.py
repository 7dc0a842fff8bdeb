"""Bad samples do no harm, and a contact that cannot have been is a status."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.result import Status
from ballfg.estimation.segmentation.result import Contact
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from tests.estimation.smoother.serve import (
    EXACT,
    LATER,
    MODEL,
    SERVE,
    SIGMA,
    TABLE,
    TIMES,
    bounces,
    estimate_of,
    honest,
    intervals,
    measured,
    truth,
    truth_at,
)


@pytest.mark.parametrize(
    "bad",
    [[0], [1], [2], [-1], [40], [10, 40, 41, 60], [0, 25, 50, 75]],
    ids=["first", "second", "third", "last", "one", "four", "every-25th"],
)
@pytest.mark.parametrize("size", [0.05, 0.1])
def test_outliers_are_set_aside(bad, size, settings) -> None:
    states = truth(SERVE)
    rng = np.random.default_rng(5)
    direction = rng.standard_normal((len(bad), 3))
    positions = measured(states)
    positions[bad] += size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    estimate = estimate_of(states, positions, settings)
    assert estimate.status is Status.OK
    assert set(np.arange(80)[bad]) <= set(np.flatnonzero(estimate.quality).tolist())
    assert len(estimate.hits) == 0
    honest(estimate, states)


def test_a_shifted_run_is_set_aside(settings) -> None:
    """The tracker follows something 5 cm away for eight frames."""
    states = truth(SERVE)
    positions = measured(states)
    positions[55:63] += (0.03, -0.02, 0.04)
    estimate = estimate_of(states, positions, settings)
    assert estimate.status is Status.OK
    assert set(range(55, 63)) <= set(np.flatnonzero(estimate.quality).tolist())
    honest(estimate, states)


def test_a_shifted_run_across_a_bounce_is_set_aside(settings) -> None:
    states = truth_at(LATER)
    positions, bounce = measured(states), bounces(states)[0]
    run = slice(bounce - 3, bounce + 5)
    positions[run] += (0.03, -0.02, 0.04)
    estimate = estimate_of(states, positions, settings, LATER)
    assert estimate.status is Status.OK
    assert intervals(estimate) == bounces(states)
    assert len(estimate.hits) == 0
    assert set(range(80)[run]) <= set(np.flatnonzero(estimate.quality).tolist())
    honest(estimate, states)


def test_nothing_but_noise_is_survived(settings) -> None:
    """Positions a metre apart: whatever it says, it says it in finite numbers."""
    positions = np.random.default_rng(2).standard_normal((30, 3))
    estimate = estimate_of(np.zeros((30, 9)), positions, settings, TIMES[:30])
    assert np.isfinite(estimate.states).all()
    assert np.isfinite(estimate.covariances).all()
    assert estimate.status in (Status.OK, Status.NOT_CONVERGED)


def test_an_impossible_contact_is_a_status_not_an_exception(settings) -> None:
    """The ball is 5 m below the surface that it is said to bounce on: FAILED, measured positions, prior covariances."""
    states = truth(SERVE)[:20]
    track = Track(TIMES[:20], measured(states), name="t")
    smoother = Smoother(MODEL, TABLE, settings)
    found = replace(smoother.segment(track), contacts=(Contact(8, 0.085, -60.0),))
    problem = smoother.problem(track, found)
    estimate = smoother.result(problem, smoother.settle(problem))
    assert estimate.status is Status.FAILED
    assert "table height" in estimate.status.value
    assert np.isfinite(estimate.covariances).all()
    assert np.isnan(estimate.whitened).all()
    np.testing.assert_allclose(estimate.states[:, :2], track.positions[:, :2], atol=1e-9)


def test_sigmas_of_a_track_stay_as_they_are() -> None:
    """Outliers widen the smoother's own copy; estimating twice gives the same answer."""
    states = truth(SERVE)
    positions = measured(states)
    positions[30] += 0.2
    track = Track(TIMES, positions, sigmas=np.full((80, 3), SIGMA), name="t")
    smoother = Smoother(MODEL, TABLE, EXACT)
    first = smoother.estimate(track)
    assert track.sigmas is not None
    np.testing.assert_array_equal(track.sigmas, SIGMA)
    np.testing.assert_array_equal(smoother.estimate(track).states, first.states)
    without = smoother.estimate(Track(TIMES, positions, name="t"))
    np.testing.assert_allclose(without.states, first.states, atol=1e-12)
