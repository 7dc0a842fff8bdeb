"""Flights: what falls and what does not, and which pieces belong together."""

import numpy as np
import pytest

from ballfg.vision.association.flights import is_ball, meeting, successions
from ballfg.vision.association.paths import Path, path
from tests.vision.filming import Shot, arm

SHOT = Shot(0.0, 0.9, (0.1, 0.0, 1.2, 4.5, 0.2, 2.0))


def track(times: np.ndarray, points: np.ndarray, sigma: float = 0.001) -> Path:
    noise = sigma * np.random.default_rng(0).standard_normal(points.shape)
    return path(times, points + noise, np.tile(sigma**2 * np.eye(3), (len(times), 1, 1)))


def piece(start: float, end: float, shot: Shot = SHOT, rate: float = 100.0) -> Path:
    times = np.arange(start, end, 1.0 / rate)
    return track(times, shot.at(times))


@pytest.mark.parametrize("rate", [60.0, 240.0])
def test_a_bouncing_ball_is_a_ball(rate: float) -> None:
    assert is_ball(piece(0.0, 0.85, rate=rate))


def test_other_things_are_not() -> None:
    times = np.arange(0.0, 3.0, 0.01)
    straight = np.outer(times, [1.0, 0.2, 0.0])
    assert not is_ball(track(times, arm(times)))
    assert not is_ball(track(times, straight))
    assert not is_ball(track(times, 0.01 * np.sin(straight)))
    assert not is_ball(
        track(times[:30], np.outer(times[:30], [90.0, 0.0, 0.0]) - np.outer(times[:30] ** 2, [0, 0, 4.9]))
    )


def test_what_hovers_is_no_ball_however_badly_it_is_seen() -> None:
    times = np.arange(0.0, 0.6, 1.0 / 120.0)
    hovering = np.array([1.0, -0.4, 1.55]) + 0.05 * np.sin(np.outer(times, [5.0, 7.0, 4.0]))
    assert not is_ball(track(times, hovering, sigma=0.012))
    assert is_ball(track(times, Shot(0.0, 0.6, (0.1, 0.0, 1.6, 2.0, 0.2, 2.5)).at(times), sigma=0.012))


def test_what_is_too_short_to_be_seen_falling_is_no_ball() -> None:
    assert not is_ball(piece(0.0, 0.03, rate=240.0))


def test_pieces_of_one_flight_meet() -> None:
    bounce = SHOT.flights[1][0]
    assert meeting(piece(0.0, 0.3), piece(0.45, 0.6)) is not None  # hidden
    assert meeting(piece(bounce - 0.2, bounce), piece(bounce + 0.02, bounce + 0.2)) is not None
    assert meeting(piece(0.0, 0.2), piece(0.55, 0.8)) is None  # hidden too long
    assert meeting(piece(0.45, 0.6), piece(0.0, 0.3)) is None


def test_pieces_of_two_flights_do_not() -> None:
    beside = Shot(0.0, 0.9, (0.1, 0.4, 1.2, 4.5, 0.2, 2.0))
    assert meeting(piece(0.0, 0.3), piece(0.33, 0.6, beside)) is None
    place = SHOT.at(np.array([0.45]))[0]
    back = Shot(0.45, 0.9, (*place, -4.0, 0.0, 1.0))
    assert meeting(piece(0.0, 0.3), piece(0.46, 0.7, back)) is None  # turned round, unseen, in so long a gap
    assert meeting(piece(0.0, 0.45), piece(0.46, 0.7, back)) is not None  # hit


def test_everyone_has_one_successor() -> None:
    beside = Shot(0.0, 0.9, (0.1, 0.05, 1.2, 4.5, 0.2, 2.0))
    tracks = [piece(0.0, 0.3), piece(0.35, 0.6), piece(0.0, 0.3, beside), piece(0.35, 0.6, beside)]
    assert sorted(successions(tracks)) == [(0, 1), (2, 3)]
