"""The launcher: the paper's ranges, its two qualitative facts, and the number of bounces."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.simulation import SimulationConfig, simulate
from ballfg.simulation.launcher import SimulatedLauncher
from ballfg.simulation.settings import SETTING_LEVELS, all_settings, parse_settings, settings_of_shots


class Shots:
    """The default simulation as arrays: settings (n, 3), true states by shot, and what the bounces did."""

    def __init__(self) -> None:
        tracks = list(simulate(SimulationConfig()))
        self.settings = np.array([[t.track.labels[name] for name in SETTING_LEVELS] for t in tracks]).astype(int)
        self.states = [t.true_states for t in tracks]
        # a contact turns the vertical speed up by more than 0.5 m/s within a frame; air and gravity cannot
        self.contacts = [np.flatnonzero(np.diff(s[:, 5]) > 0.5) + 1 for s in self.states]

    def select(self, **levels: int) -> list[int]:
        columns = list(SETTING_LEVELS)
        match = [self.settings[:, columns.index(name)] == level for name, level in levels.items()]
        return np.flatnonzero(np.all(match, axis=0)).tolist()

    def turn(self, i: int) -> float:
        """Degrees from the first to the last direction of the horizontal motion; left is positive."""
        heading = np.unwrap(np.arctan2(self.states[i][:, 4], self.states[i][:, 3]))
        return float(np.degrees(heading[-1] - heading[0]))


@pytest.fixture(scope="module")
def shots() -> Shots:
    return Shots()


def test_717_tracks_cover_all_693_settings(shots: Shots) -> None:
    assert len(shots.states) == 717
    assert {tuple(row) for row in shots.settings} == {tuple(row) for row in all_settings()}
    assert len(all_settings()) == 9 * 11 * 7


@pytest.mark.parametrize("speed", [8, 9])
def test_topspin_minus_3_comes_back_below_level_10(shots: Shots, speed: int) -> None:
    chosen = shots.select(topspin=-3, speed=speed)
    assert len(chosen) >= 11
    for i in chosen:
        first = shots.contacts[i][0]
        assert shots.states[i][first - 1, 3] > 0.5  # it came forwards
        assert shots.states[i][first, 3] < 0  # and goes back


@pytest.mark.parametrize("speed", [10, 12, 14])
def test_topspin_minus_3_goes_on_from_level_10(shots: Shots, speed: int) -> None:
    for i in shots.select(topspin=-3, speed=speed):
        assert shots.states[i][shots.contacts[i][0], 3] > 0


@pytest.mark.parametrize("sidespin", [-5, 5])
def test_full_sidespin_turns_the_track_by_about_45_degrees(shots: Shots, sidespin: int) -> None:
    turns = np.array([shots.turn(i) * np.sign(sidespin) for i in shots.select(topspin=0, sidespin=sidespin)])
    assert len(turns) >= 7
    assert np.all((turns > 35) & (turns < 56))
    # little topspin or backspin changes single tracks much (slow ones almost stop), not the typical one
    near = [i for level in (-1, 0, 1) for i in shots.select(topspin=level, sidespin=sidespin)]
    assert np.median([shots.turn(i) * np.sign(sidespin) for i in near]) == pytest.approx(45, abs=5)


def test_no_sidespin_hardly_turns(shots: Shots) -> None:
    assert all(abs(shots.turn(i)) < 8 for i in shots.select(topspin=0, sidespin=0))


def test_most_tracks_bounce_once_some_twice_or_three_times(shots: Shots) -> None:
    count = np.bincount([len(c) for c in shots.contacts], minlength=4) / len(shots.contacts)
    assert count[0] == 0
    assert count[1] > 0.6
    assert count[2] >= 0.1
    assert 0 < count[3] < 0.1
    assert len(count) == 4


def test_no_ball_bounces_beside_the_table(shots: Shots) -> None:
    places = np.array([s[i, :2] for s, contacts in zip(shots.states, shots.contacts, strict=True) for i in contacts])
    assert places[:, 0].max() < 2.74 + 0.05  # the frame after the contact
    assert np.abs(places[:, 1]).max() < 1.525 / 2 + 0.05


def test_tracks_end_before_the_ball_falls_beside_the_table(shots: Shots) -> None:
    assert min(s[:, 2].min() for s in shots.states) > 0.76 + 0.02 - 0.004


def test_settings_depend_on_the_shot_number_not_on_the_blocks() -> None:
    combinations = all_settings({"speed": [9, 10]})
    whole = settings_of_shots(combinations, 0, 500, seed=3)
    parts = [settings_of_shots(combinations, first, 50, seed=3) for first in range(0, 500, 50)]
    np.testing.assert_array_equal(np.concatenate(parts), whole)
    assert len({tuple(row) for row in whole[: len(combinations)]}) == len(combinations)


def test_settings_text() -> None:
    assert parse_settings("topspin=-3, sidespin=-1..1,speed=9") == {
        "topspin": [-3],
        "sidespin": [-1, 0, 1],
        "speed": [9],
    }


@pytest.mark.parametrize(
    ("text", "message"),
    [("topspin", "NAME=LEVEL"), ("speed=fast", "NAME=LEVEL"), ("speed=8,speed=9", "'speed' twice")],
)
def test_bad_settings_text(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        parse_settings(text)


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"spin": [1]}, "topspin, sidespin, speed; got 'spin'"),
        ({"topspin": [6]}, r"topspin must lie in -3 \.\. 5; got 6"),
        ({"topspin": []}, "got nothing"),
    ],
)
def test_levels_that_the_launcher_lacks(chosen: dict[str, list[int]], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        all_settings(chosen)


def test_launcher_refuses_impossible_values() -> None:
    with pytest.raises(ValueError, match=r"speed_slow must be at least 0\.5"):
        SimulatedLauncher(speed_slow=-3.0)
    with pytest.raises(TypeError, match="height must be a number; got 'high'"):
        SimulatedLauncher(height="high")  # type: ignore[arg-type]
    with pytest.raises(ValueError, match="x must lie between"):
        SimulatedLauncher(x=5.0)
    with pytest.raises(ValueError, match="launcher has no field 'hight'"):
        SimulatedLauncher().with_fields({"hight": 0.4})


def test_shots_scatter_about_the_aim_to_all_sides() -> None:
    """Directions by the aim's spread, speeds by theirs, around those of the level."""
    launcher, n = SimulatedLauncher(), 4000
    settings = np.tile([0.0, 0.0, 10.0], (n, 1))
    states = launcher.launch(settings, 0.76, np.random.default_rng(6)).numpy()
    speed = np.linalg.norm(states[:, 3:6], axis=1)
    azimuth, elevation = np.arctan2(states[:, 4], states[:, 3]), np.arcsin(states[:, 5] / speed)
    for angles in (azimuth, elevation):
        assert angles.std() == pytest.approx(launcher.aim_spread, rel=4.0 / np.sqrt(2 * n))
    assert abs(azimuth.mean()) < 4.0 * launcher.aim_spread / np.sqrt(n)
    assert abs(np.corrcoef(azimuth, elevation)[0, 1]) < 4.0 / np.sqrt(n)
    assert speed.std() / speed.mean() == pytest.approx(launcher.speed_spread, rel=4.0 / np.sqrt(2 * n))
