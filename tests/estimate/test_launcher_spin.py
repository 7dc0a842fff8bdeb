"""Launcher settings become spin labels: axes and signs, and the simulator's own launcher as a check."""

import numpy as np
import pytest

from ballfg.estimate import LauncherSpin
from ballfg.simulate import Launcher, SimulationConfig, simulate
from ballfg.tracks import Track


def test_topspin_turns_the_top_of_the_ball_forward() -> None:
    for direction in ((1.0, 0.0), (0.0, -1.0), (0.6, 0.8)):
        velocity = np.array([5.0 * direction[0], 5.0 * direction[1], 1.0])
        spin = LauncherSpin(topspin=50.0, sidespin=40.0).spin(2.0, 0.0, velocity)
        top = np.cross(spin, [0.0, 0.0, 0.02])  # velocity of the ball's top relative to its centre
        np.testing.assert_allclose(top, 0.02 * 100.0 * np.array([*direction, 0.0]), atol=1e-12)


def test_sidespin_is_about_the_vertical() -> None:
    spin = LauncherSpin(50.0, 40.0).spin(0.0, -3.0, np.array([4.0, 0.0, 0.0]))
    np.testing.assert_allclose(spin, [0.0, 0.0, -120.0])


def test_settings_give_the_spin_of_the_simulated_launcher() -> None:
    launcher = Launcher()
    levels = LauncherSpin(launcher.topspin_scale, launcher.sidespin_scale)
    for shot in simulate(SimulationConfig(tracks=12, seed=2, spin_labels=False)):
        labelled = levels.label(shot.track)
        assert labelled.spin_label is not None
        # what is left is the launcher's shot-to-shot spread of spin and direction
        np.testing.assert_allclose(labelled.spin_label, shot.true_states[0, 6:], atol=40.0)


def test_measured_labels_win_and_missing_settings_change_nothing() -> None:
    track = Track("a", np.arange(5) * 0.01, np.arange(15.0).reshape(5, 3) * 0.05)
    assert LauncherSpin(50.0, 40.0).label(track) is track
    labels = {"spin_x": 1.0, "spin_y": 2.0, "spin_z": 3.0, "topspin": 1.0}
    measured = Track("a", track.times, track.positions, labels=labels)
    assert LauncherSpin(50.0, 40.0).label(measured) is measured


def test_a_launch_straight_up_has_no_axis_for_topspin() -> None:
    with pytest.raises(ValueError, match="velocity must have a horizontal part"):
        LauncherSpin(50.0, 40.0).spin(1.0, 0.0, np.array([0.0, 0.0, 3.0]))
