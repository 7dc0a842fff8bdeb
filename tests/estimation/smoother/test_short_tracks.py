"""Short tracks and tracks with gaps are honest about what they do not know."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.result import Status
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from tests.estimation.smoother.serve import (
    EXACT,
    MODEL,
    SERVE,
    SIGMA,
    TABLE,
    TIMES,
    UNCERTAIN,
    bounces,
    estimate_of,
    honest,
    measured,
    truth,
)


@pytest.mark.parametrize("count", [2, 3, 5])
def test_few_observations(count, settings) -> None:
    states = truth(SERVE)[:count]
    estimate = estimate_of(states, measured(states), settings, TIMES[:count])
    assert estimate.status is Status.OK
    honest(estimate, states)
    assert 1e-3 < estimate.sigmas[0, 3] < 0.3
    assert (estimate.sigmas[:, 6:] > 50.0).all()  # nothing is known of the spin but its prior


def test_one_observation(settings) -> None:
    """Position as measured, velocity and spin as their priors; the status says what to do."""
    states = truth(SERVE)[:1]
    positions = measured(states)
    estimate = estimate_of(states, positions, settings, TIMES[:1])
    assert estimate.status is Status.NO_VELOCITY
    assert "at least three samples" in estimate.status.value
    honest(estimate, states)
    np.testing.assert_allclose(estimate.states[0, :3], positions[0], atol=1e-6)
    np.testing.assert_allclose(estimate.sigmas[0, 3:6], 20.0, rtol=1e-6)


def test_samples_that_nothing_links(settings) -> None:
    """Stamps in another unit: every gap is too long to follow a ball over it."""
    states = truth(SERVE)[:10]
    estimate = estimate_of(states, measured(states), settings, np.arange(10) * 0.6)
    assert estimate.status is Status.NO_VELOCITY
    assert "check the unit of the stamps" in estimate.status.value
    np.testing.assert_allclose(estimate.sigmas[:, 3:6], 20.0, rtol=1e-6)
    linked = estimate_of(states, measured(states), settings, np.r_[np.arange(9) * 0.6, 4.81])
    assert linked.status is Status.OK


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("labelled", [True, False], ids=["label", "no-label"])
def test_five_observations_around_a_bounce(seed, labelled) -> None:
    """With a label the model may be exact; without, whether the ball slides or grips is open, which no Gaussian says:
    the tangential noise of `uncertain` stands for it."""
    states = truth(SERVE)
    part = slice(bounces(states)[0] - 2, bounces(states)[0] + 3)
    labels = dict(zip(("spin_x", "spin_y", "spin_z"), states[part][0, 6:].tolist(), strict=True)) if labelled else {}
    settings = replace(EXACT, spin_label_noise=5.0) if labelled else UNCERTAIN
    track = Track(TIMES[part], measured(states, seed)[part], labels=labels, name="t")
    honest(Smoother(MODEL, TABLE, settings).estimate(track), states[part])


@pytest.mark.parametrize("far", [0.0, 30.0])
def test_two_samples_a_nanosecond_apart_are_one_of_half_the_variance(far, settings) -> None:
    """Rounding must not pass for motion there. `far`: m, from the origin."""
    times, states = TIMES[:70], truth(SERVE)[:70]
    states[:, 0] += far
    positions, sigmas = measured(states), np.full((70, 3), SIGMA)
    twice, again = np.insert(times, 31, times[30] + 1e-9), positions[30] + (0.001, -0.002, 0.001)
    labels, smoother = (
        dict(zip(("spin_x", "spin_y", "spin_z"), SERVE[6:], strict=True)),
        Smoother(MODEL, TABLE, settings),
    )
    found = smoother.estimate(Track(twice, np.insert(positions, 31, again, axis=0), labels=labels))
    positions[30], sigmas[30] = 0.5 * (positions[30] + again), SIGMA / np.sqrt(2.0)
    merged = smoother.estimate(Track(times, positions, sigmas, labels=labels))
    assert found.status is merged.status is Status.OK
    assert np.abs((np.delete(found.states, 31, axis=0) - merged.states) / merged.sigmas).max() < 0.05
    np.testing.assert_allclose(np.delete(found.sigmas, 31, axis=0), merged.sigmas, rtol=0.01)


@pytest.mark.parametrize("before", [1, 8, 15])
def test_a_gap_of_a_fifth_of_a_second_across_a_bounce(before, settings) -> None:
    states = truth(SERVE)
    bounce = bounces(states)[0]
    kept = np.r_[0 : bounce - before, bounce - before + 20 : 80]
    estimate = estimate_of(states[kept], measured(states)[kept], settings, TIMES[kept])
    assert estimate.status is Status.OK
    assert len(estimate.contacts) == len(bounces(states))
    honest(estimate, states[kept])


def test_only_the_rising_part(settings) -> None:
    states = truth(SERVE)
    rising = slice(0, int(np.argmax(states[:, 5] < 0)))
    estimate = estimate_of(states[rising], measured(states)[rising], settings, TIMES[rising])
    assert estimate.status is Status.OK
    assert len(estimate.contacts) == 0
    honest(estimate, states[rising])
