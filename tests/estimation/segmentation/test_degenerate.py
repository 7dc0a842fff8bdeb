"""Tracks that hardly are ones: an answer, never an exception, a warning or a NaN."""

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimation.segmentation.explain import _rarity
from ballfg.estimation.segmentation.result import Quality
from tests.estimation.segmentation.whole_tracks import segment

TABLE = Surfaces(0.75)
T = np.arange(60) / 180
PARABOLA = np.stack([0 * T, 3 * T, 1 + 2 * T - 4.9 * T**2], axis=1)


def found(times, positions, sigma=0.0015, surfaces=TABLE):
    result = segment(times, positions, sigma, surfaces=surfaces)
    n = len(times)
    assert result.quality.shape == (n,)
    assert all(0 <= c.interval < n - 1 and np.isfinite(c.time) for c in result.contacts)
    assert all(0 <= i < n - 1 for i in result.hits)
    assert set(result.restarts) <= set(result.hits)
    assert all(0 <= r.first <= r.last < n - 1 for r in result.rests)
    assert sum(last - first + 1 for first, last in result.segments) == n
    return result


@pytest.mark.parametrize("n", range(9))
def test_few_samples_of_a_flight(n):
    noise = np.random.default_rng(n).normal(0, 0.0015, (n, 3))
    result = found(T[:n], PARABOLA[:n] + noise)
    assert result.usable.all()
    assert len(result.contacts) == len(result.hits) == len(result.rests) == 0


@pytest.mark.parametrize("n", [3, 5, 60])
def test_an_outlier_in_the_first_sample(n):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        positions = PARABOLA[:n] + rng.normal(0, 0.0015, (n, 3))
        direction = rng.normal(size=3)
        positions[0] += 0.15 * direction / np.linalg.norm(direction)
        result = found(T[:n], positions)
        assert result.quality[0] == Quality.OUTLIER
        assert result.usable[1:].all()
        assert len(result.hits) == 0


@pytest.mark.parametrize("bad", [[1], [2], [3], [1, 2]], ids=str)
@pytest.mark.parametrize("size", [0.05, 0.15, 0.3])
def test_outliers_among_the_first_samples(bad, size):
    for seed in range(20):
        rng = np.random.default_rng(seed)
        positions = PARABOLA + rng.normal(0, 0.0015, (60, 3))
        direction = rng.normal(size=(len(bad), 3))
        positions[bad] += size * direction / np.linalg.norm(direction, axis=1, keepdims=True)
        result = found(T, positions)
        assert len(result.hits) == 0
        assert (result.quality[bad] >= Quality.WIDE).all()
        assert set(np.flatnonzero(~result.usable)) <= set(bad)


@pytest.mark.parametrize("after", range(4))
def test_an_outlier_after_a_restart(after):
    rng = np.random.default_rng(after)
    positions = np.concatenate([PARABOLA, PARABOLA]) + rng.normal(0, 0.0015, (120, 3))
    positions[60 + after] += [0.1, -0.05, 0.1]
    result = found(np.concatenate([T, T + 1.0]), positions)
    assert result.hits.tolist() == result.restarts.tolist() == [59]
    assert np.flatnonzero(~result.usable).tolist() == [60 + after]


@pytest.mark.parametrize("n", range(2, 9))
def test_a_ball_that_leaves_the_table_is_not_taken_for_one_that_rests(n):
    rests = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        rise = rng.choice([0.0, 0.002, 0.005, 0.01]) + rng.uniform(0.6, 3) * T[:n] - 4.9 * T[:n] ** 2
        path = np.stack([0 * T[:n], 3 * T[:n], 0.77 + rise], axis=1)
        rests += len(found(T[:n], path + rng.normal(0, 0.0015, (n, 3))).rests)
    assert rests <= 1


def test_three_samples_about_a_bounce_are_not_a_rest():
    rests = 0
    for seed in range(40):
        rng = np.random.default_rng(seed)
        height = 0.77 + rng.uniform(1, 3) * np.abs(T[:3] - rng.uniform(0.2, 0.8) / 180)
        path = np.stack([0 * T[:3], 3 * T[:3], height], axis=1) + rng.normal(0, 0.0015, (3, 3))
        rests += len(found(T[:3], path).rests)
    assert rests <= 1


def test_a_ball_that_lies_still_is_a_rest_after_a_few_samples():
    rests = 0
    for seed in range(40):
        still = np.tile([0.1, 0.2, 0.77], (8, 1)) + np.random.default_rng(seed).normal(0, 0.0015, (8, 3))
        rests += len(found(T[:8], still).rests)
    assert rests >= 38


def test_only_the_rising_part():
    assert len(found(T[:30], PARABOLA[:30]).hits) == 0


def test_a_position_repeated_for_ever():
    result = found(T, np.tile([0.1, 0.2, 1.0], (60, 1)))
    assert result.contacts == ()


def test_everything_at_rest_without_noise():
    result = found(T, np.tile([0.1, 0.2, 0.77], (60, 1)))
    assert [(r.first, r.last) for r in result.rests] == [(0, 58)]


def test_outliers_only():
    rng = np.random.default_rng(0)
    for spread in (0.5, 100.0):
        result = found(
            np.arange(200) / 180, rng.uniform(-spread, spread, (200, 3)), surfaces=Surfaces.table_tennis(0.75)
        )
        assert not result.usable.all()


def test_stamps_1_4_ms_apart(make_flight):
    truth = make_flight(nominal_model(), [0, 0, 0.9, 0, 4, 0, 0, 0, 0], np.arange(200) * 1.4e-3, TABLE)
    result = found(truth.times, truth.measured(np.random.default_rng(0)))
    assert [abs(c.interval - truth.contacts[0]) <= 2 for c in result.contacts] == [True]
    assert len(result.hits) == 0


def test_a_microsecond_between_stamps():
    found(np.arange(60) * 1e-6, PARABOLA)


def test_gaps_that_nothing_bridges_restart():
    result = found(np.arange(6) * 10.0, PARABOLA[:6])
    assert result.restarts.tolist() == result.hits.tolist() == [0, 1, 2, 3, 4]
    assert result.segments == [(i, i) for i in range(6)]


def test_a_track_of_long_gaps():
    found(np.arange(40) * 0.4, np.random.default_rng(0).uniform(0.7, 1.2, (40, 3)))


@pytest.mark.parametrize("sigma", [1e-9, 1.0])
def test_absurd_noise(sigma):
    assert len(found(T, PARABOLA, sigma).hits) == 0


def test_below_every_surface():
    found(T, PARABOLA - [0, 0, 5.0], surfaces=Surfaces.table_tennis(0.75))


def test_an_event_costs_what_chance_says_and_no_more_for_closer_stamps() -> None:
    """Of a Poisson process with 50 events a second, minus the log probability of one within dt; below 1 ms alike."""
    assert _rarity(50.0, 0.01) == pytest.approx(-np.log(1.0 - np.exp(-0.5)))
    assert _rarity(50.0, 0.0015) == pytest.approx(-np.log(1.0 - np.exp(-0.075)))
    assert _rarity(50.0, 1e-6) == _rarity(50.0, 0.001)
