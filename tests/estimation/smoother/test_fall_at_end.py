"""Tracks that end while a ball rolls over an end of the table: errors in stated covariances, against closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

import ballfg as bf
from tests.estimation.online.test_rolling_off import LONG, NOISE, TABLE, distances, rolled


def ended(rate: float, after: int, seed: int, table: bf.Surfaces = TABLE) -> tuple[bf.Estimate, NDArray]:
    """The estimate of a track whose last sample is the one of that number after the end, and its true states."""
    noise = np.random.default_rng(seed)
    leaves = 0.5 + noise.uniform() / rate
    times = np.arange(int(np.ceil(leaves * rate)) + after) / rate
    truth = rolled(0.6 + 0.2 * seed, times, leaves)
    positions = truth[:, :3] + noise.normal(0.0, NOISE, (len(times), 3))
    settings = bf.Settings.for_measured(bf.nominal_model(), position_noise=(NOISE,) * 3)
    return bf.estimate(bf.Track(times, positions), surfaces=table, settings=settings), truth


@pytest.mark.parametrize("rate", [100.0, *(pytest.param(rate, marks=pytest.mark.thorough) for rate in (60.0, 250.0))])
def test_a_last_state_just_over_an_end_is_known_as_well_as_stated(rate):
    found = []
    for seed in range(6):
        for after in (1, 2, 3, 5):
            estimate, truth = ended(rate, after, seed)
            found.append(distances(estimate.states[-1:] - truth[-1:], estimate.covariances[-1:])[0])
    assert np.median(found) < 8.0  # 7 to 24 where the fall begins at a stamp
    assert np.mean(np.array(found) > 30.0) < 0.05


def test_a_ball_that_is_not_over_the_end_yet_stays_known():
    for seed in range(3):
        near, truth = ended(100.0, -4, seed)
        far, _ = ended(100.0, -4, seed, LONG)
        assert np.array_equal(near.states, far.states)
        assert np.array_equal(near.covariances, far.covariances)
        assert distances(near.states[-1:] - truth[-1:], near.covariances[-1:])[0] < 25.0
