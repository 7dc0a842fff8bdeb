"""Stamps counted from a first one: the same bits wherever the clock began, against integers."""

import numpy as np
import pytest

from ballfg.tracks import Track
from ballfg.tracks.stamps import elapsed, written

SINCE_1970 = 1_700_000_000_123_457
"""us"""


def stamps(ticks, origin=0):
    """Doubles of whole microseconds as a file states them."""
    return np.array([float(f"{(origin + int(t)) // 10**6}.{(origin + int(t)) % 10**6:06d}") for t in ticks])


@pytest.fixture
def ticks():
    return np.cumsum(np.random.default_rng(1).integers(1, 20_000, 500))


@pytest.mark.parametrize("origin", [0, 333_333, SINCE_1970])
def test_whole_microseconds_are_subtracted_as_integers(ticks, origin):
    times = stamps(ticks, origin)
    assert np.array_equal(elapsed(times, times[0]), (ticks - ticks[0]) / 1e6)
    assert np.array_equal(written(elapsed(times, times[0]), times[0]), times)


def test_plain_differences_are_broken_at_large_stamps(ticks):
    times = stamps(ticks, SINCE_1970)
    assert 1e-8 < np.abs((times - times[0]) - (ticks - ticks[0]) / 1e6).max() < 3e-7


def test_other_stamps_are_subtracted_as_they_are():
    times = 1.7e9 + np.arange(50) / 120.0
    assert np.array_equal(elapsed(times, times[0]), times - times[0])
    assert np.array_equal(written(times - times[0], times[0]), times)
    assert (np.diff(elapsed(np.array([1.7e9, np.nextafter(1.7e9, 2e9)]), 1.7e9)) > 0.0).all()


def test_sums_of_whole_microseconds_are_whole():
    assert written(0.1 + 0.2, 1.7e9) == 1700000000.3


@pytest.mark.parametrize("origin", [0, 333_333, SINCE_1970])
def test_the_opening_of_a_track_does_not_depend_on_its_clock(origin):
    """A stamp at the end belongs to it, also where rounding to a microsecond put it one later."""
    ticks = np.array([3, 10_000, 20_000, 249_999, 250_004, 250_006, 260_000])
    track = Track(stamps(ticks, origin), np.zeros((7, 3)))
    assert len(track.opening(0.25)) == 5
    assert len(track.opening(5.0)) == 7
    assert track.since_first().times.tolist() == ((ticks - 3) / 1e6).tolist()
    assert track.since_first().since_first().times.tolist() == track.seconds.tolist()
