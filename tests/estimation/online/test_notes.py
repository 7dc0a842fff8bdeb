"""The notes of a streamed track that is longer than the window: those of all windows, with the track's own times."""

import numpy as np

import ballfg as bf
from ballfg.estimation.online.online import Online

G, RADIUS = 9.80665, 0.02


def low(estimate: bf.Estimate) -> list[str]:
    return [note for note in estimate.notes if "may hop lower" in note]


def test_the_time_of_a_note_counts_from_the_first_sample_of_the_track():
    track = bf.Track(*_rolls(200))
    settings = bf.Settings.for_measured(bf.nominal_model(), position_noise=(0.0015,) * 3, solver="ballfg")
    whole = bf.estimate(track, surfaces=0.0, settings=settings)
    assert len(low(whole)) == 1
    streamed = Online(bf.nominal_model(), 0.0, settings, lag=30).estimate(track)
    (note,), (right,) = low(streamed), low(whole)
    assert abs(_seconds(note) - _seconds(right)) < 0.15  # 0.0 s, of its last window, where a window forgot the first


def _rolls(n: int) -> tuple[np.ndarray, np.ndarray]:
    """A ball in flight for 0.6 s that then rolls on the table without a bounce."""
    times = np.arange(n) / 100.0
    left = np.maximum(0.6 - times, 0.0)
    heights = RADIUS - 0.003 + 0.1 * left + 3.0 * left - G * left**2 / 2.0
    positions = np.stack((0.5 * times, np.zeros(n), heights), axis=1)
    return 100.0 + times, positions + np.random.default_rng(1).normal(0.0, 0.0015, (n, 3))


def _seconds(note: str) -> float:
    return float(note.split()[1])
