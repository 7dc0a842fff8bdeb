"""Doubts about axes, clock, unit and surfaces of a track, where something is wrong and where a ball only looks odd."""

import numpy as np
import pytest

from ballfg.state import STANDARD_GRAVITY
from ballfg.tracks.doubts import doubts_about

RADIUS = 0.02


def bouncing(contact: float, end: float = 0.25) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s and positions (n, 3) m of a ball that bounces on z = 0 once, `contact` s after the start."""
    times = np.arange(0.0, end, 0.007)
    since, down = times - contact, 3.5
    speed = np.where(since < 0.0, -down, 0.93 * down)
    height = RADIUS + speed * since - 0.5 * STANDARD_GRAVITY * since**2
    return times, np.stack([8.0 * times, 0.3 * times, height], axis=-1)


@pytest.mark.parametrize("contact", [0.06, 0.1, 0.125, 0.15, 0.19])
def test_bounce_in_a_short_track_is_no_reversed_axis(contact):
    assert doubts_about(*bouncing(contact), (0.0,), RADIUS) == ()


@pytest.mark.parametrize("contact", [0.06, 0.125, 0.19])
def test_reversed_axis_is_seen_beside_a_bounce(contact):
    times, positions = bouncing(contact, end=0.6)
    (doubt,) = doubts_about(times, positions * [1.0, 1.0, -1.0], (0.0,), RADIUS)
    assert "z seems to point down" in doubt


@pytest.mark.parametrize("contact", [0.2, 0.3, 0.4])
def test_a_bounce_where_no_surface_is_declared(contact):
    times, positions = bouncing(contact, end=0.6)
    (doubt,) = doubts_about(times, positions + np.array([0.0, 0.0, 0.5]), (0.0, -0.76), RADIUS)
    assert "bounces at z = 0.5" in doubt
    assert "(they are at 0 and -0.76 m)" in doubt


@pytest.mark.parametrize("way", [1.0, -1.0], ids=["lifted", "put down"])
def test_a_ball_that_lies_and_is_lifted_has_not_bounced(way):
    """It must come down to its lowest place and rise from there."""
    times = np.arange(0.0, 0.4, 0.007)
    height = 0.5 + 3.0 * np.maximum(way * (times - 0.2), 0.0)
    positions = np.stack([0.5 * times, np.zeros_like(times), height], axis=-1)
    assert doubts_about(times, positions, (0.0,), RADIUS) == ()


@pytest.mark.parametrize("end", [0.6, 0.29], ids=["beside a bounce", "alone"])
def test_low_samples_are_no_bounces(end):
    times, positions = bouncing(0.3, end)
    positions[[12, 25], 2] -= 0.25
    assert doubts_about(times, positions, (0.0,), RADIUS) == ()


@pytest.mark.parametrize("off", [-0.06, -0.04, 0.04, 0.06])
@pytest.mark.parametrize("contact", [0.2, 0.3, 0.4])
def test_a_table_some_centimetres_off_is_seen(contact, off):
    """Its bounces would count as hits; the lowest sample alone lies up to 12 mm above the ball's lowest place."""
    times, positions = bouncing(contact, end=0.6)
    noisy = positions + np.random.default_rng(5).normal(0.0, 0.002, positions.shape)
    (doubt,) = doubts_about(times, noisy, (off, -0.76), RADIUS)
    assert "bounces at z = 0.00" in doubt
    assert doubts_about(times, noisy, (0.012 * np.sign(off), -0.76), RADIUS) == ()


def hopping(speed: float = 2.5, rate: float = 100.0) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s and positions (n, 3) m of a ball that leaves z = 0 with `speed` m/s again and again; 2 mm noise."""
    times = np.arange(0.0, 2.2, 1.0 / rate)
    since = np.mod(times + 0.1, 2.0 * speed / STANDARD_GRAVITY)
    height = RADIUS + speed * since - 0.5 * STANDARD_GRAVITY * since**2
    path = np.stack([times, 0.2 * times, height], axis=-1)
    return times, path + np.random.default_rng(2).normal(0.0, 0.002, path.shape)


@pytest.mark.parametrize(("slower", "longer", "told"), [(2.0, 1.0, 2.45), (1.0, 1.0 / 0.3048, 32.2)])
def test_a_wrong_clock_or_unit_shows_in_the_fall(slower, longer, told):
    """Frames at 120 Hz written as at 60 Hz; feet for metres."""
    times, positions = hopping()
    doubts = doubts_about(slower * times, longer * positions, (0.0,), longer * RADIUS, 0.12)
    (doubt,) = (one for one in doubts if "falls with" in one)
    assert float(doubt.split("falls with ")[1].split()[0]) == pytest.approx(told, rel=0.15)
    assert doubts_about(times, positions, (0.0,), RADIUS, 0.12) == ()


def test_what_air_can_do_is_no_doubt():
    """A golf ball rises on its lift and loses speed along its way as if it fell that way."""
    times = np.arange(0.0, 1.5, 0.02)
    along = 60.0 * times - 0.5 * 8.0 * times**2
    positions = np.stack([0.0 * times, along, 1.0 + 12.0 * times - 0.5 * 2.0 * times**2], axis=-1)
    assert doubts_about(times, positions, (0.0,), RADIUS, 0.0055) == ()
    (doubt,) = doubts_about(times, positions, (0.0,), RADIUS, 0.0)
    assert "falls with 2 m/s^2" in doubt


def test_bounces_at_one_height_show_a_surface_that_is_not_declared():
    (doubt,) = doubts_about(*hopping(), (), RADIUS)
    assert "no surface is declared. Give" in doubt
    times, positions = hopping()
    positions[:, 2] += 0.25 * np.floor(times / 0.51)  # a ball juggled ever higher
    assert doubts_about(times, positions, (), RADIUS) == ()
