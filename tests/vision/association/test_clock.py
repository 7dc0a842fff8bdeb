"""Stamps of several cameras: the nearest, and those of a shared shutter."""

import numpy as np

from ballfg.vision.association.gathering import nearest, shared_stamps


def test_nearest() -> None:
    assert nearest(np.array([0.0, 1.0, 3.0]), np.array([-1.0, 0.4, 0.5, 0.6, 2.1, 9.0])).tolist() == [0, 0, 0, 1, 2, 2]
    assert nearest(np.array([5.0]), np.array([1.0, 7.0])).tolist() == [0, 0]


def test_a_shared_shutter_with_lost_frames_and_half_the_rate() -> None:
    frames = np.arange(100) / 100.0
    jitter = 5e-5 * np.random.default_rng(0).uniform(-1, 1, 100)
    stamps = shared_stamps([np.delete(frames, [3, 50]), (frames + jitter)[::2]], 2e-4)
    assert stamps is not None
    np.testing.assert_allclose(stamps, np.delete(frames, 3), atol=5e-5)


def test_shutters_of_their_own() -> None:
    frames = np.arange(100) / 100.0
    assert shared_stamps([frames, frames + 0.003], 2e-4) is None
    assert shared_stamps([frames, np.arange(60) / 60.0], 2e-4) is None
    assert shared_stamps([np.zeros(0), np.zeros(0)], 2e-4) is None
