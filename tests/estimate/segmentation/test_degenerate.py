"""Tracks that hardly are ones: an answer, never an exception, a warning or a NaN."""

import numpy as np
import pytest

from ballfg.dynamics import Surfaces, nominal_model
from ballfg.estimate.segmentation import Quality, segment

TABLE = Surfaces(0.75)
T = np.arange(60) / 180
PARABOLA = np.stack([0 * T, 3 * T, 1 + 2 * T - 4.9 * T**2], axis=1)


def found(times, positions, sigma=0.0015, surfaces=TABLE):
    result = segment(times, positions, np.full(3, sigma), surfaces=surfaces)
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


@pytest.mark.parametrize(
    ("times", "positions", "sigma", "message"),
    [
        (T, PARABOLA[:5], np.ones(3), r"positions \(n, 3\); got \(60,\) and \(5, 3\)"),
        (T, PARABOLA, np.ones(2), r"sigma must be \(3,\) or \(60, 3\); got \(2,\)"),
        (T, PARABOLA, np.zeros(3), r"sigma must be positive; got 0"),
        (T[::-1], PARABOLA, np.ones(3), r"time must be finite and increase; got 0.32"),
        (T, PARABOLA * np.nan, np.ones(3), r"position must be three finite numbers"),
    ],
)
def test_bad_input_is_named(times, positions, sigma, message):
    with pytest.raises(ValueError, match=message):
        segment(times, positions, sigma, surfaces=TABLE)
