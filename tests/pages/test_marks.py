"""Contacts and hits read off states, against the closed form of a fall."""

import numpy as np
import pytest

from ballfg.pages.shot import marks
from tests.pages.made import RADIUS, TABLE, Fall


@pytest.mark.parametrize("height", [0.1, 0.3, 0.7])
def test_a_contact_is_where_the_fall_ends(height: float) -> None:
    fall = Fall(height)
    found = list(marks(fall.times, fall.states(), (TABLE,), RADIUS))
    assert [mark.kind for mark in found] == ["contact"]
    assert found[0].time == pytest.approx(fall.contact, abs=1e-9)
    assert found[0].place == pytest.approx((3.0 * fall.contact, 0.2 * fall.contact, TABLE + RADIUS), abs=1e-9)


def test_a_turn_far_above_the_table_is_a_hit() -> None:
    fall = Fall()
    found = list(marks(fall.times, fall.states(), (TABLE - 0.5,), RADIUS))
    assert [mark.kind for mark in found] == ["hit"]


def test_a_jump_of_the_velocity_is_a_hit_and_strong_drag_is_none() -> None:
    times = np.arange(20) / 100.0
    states = np.zeros((20, 9))
    states[:, 2], states[:, 3] = 2.0, 25.0 * np.exp(-4.0 * times)  # 100 m/s^2 at first
    assert not list(marks(times, states, (TABLE,), RADIUS))
    states[12:, 3] -= 6.0
    (hit,) = marks(times, states, (TABLE,), RADIUS)
    assert (hit.kind, hit.time) == ("hit", pytest.approx(0.115))


def test_the_floor_counts_and_one_state_has_no_marks() -> None:
    fall = Fall()
    states = fall.states() - np.array([0, 0, TABLE, 0, 0, 0, 0, 0, 0])
    assert [mark.kind for mark in marks(fall.times, states, (TABLE, 0.0), RADIUS)] == ["contact"]
    assert not list(marks(fall.times[:1], states[:1], (TABLE, 0.0), RADIUS))


def test_nothing_is_marked_where_the_ball_is_held() -> None:
    fall = Fall()
    held = np.abs(fall.times - fall.contact) < 0.02
    assert not list(marks(fall.times, fall.states(), (TABLE,), RADIUS, (~held).tolist()))
    assert len(list(marks(fall.times, fall.states(), (TABLE,), RADIUS, np.ones(60, bool).tolist()))) == 1


def test_nothing_is_marked_in_a_gap() -> None:
    fall = Fall()
    seen = np.abs(fall.times - fall.contact) > 0.06
    assert not list(marks(fall.times[seen], fall.states()[seen], (TABLE,), RADIUS))
