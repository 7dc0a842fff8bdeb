"""Doubts about the axes of a track: a bounce in a short track is no fall upwards."""

import numpy as np
import pytest

from ballfg.state import STANDARD_GRAVITY
from ballfg.tracks.checks import doubts_about

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
