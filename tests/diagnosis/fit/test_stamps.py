"""Stamps that are wrong: missing frames are put in their places, a far clock is seen, good stamps are left alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.diagnosis.fit.stamps import Evidence, Stamps, frame_counts, look_at_stamps
from ballfg.tracks import Track

RATE, NOISE, DRAG, GRAVITY = 120.0, 0.002, 0.12, 9.81


def shot(number: int) -> Track:
    """A ball that flies along a parabola with drag, bounces once, and is seen at every frame."""
    rng = np.random.default_rng(number)
    velocity = np.array([rng.uniform(4.0, 7.0), rng.uniform(-1.0, 1.0), rng.uniform(0.5, 2.0)])
    place, places = np.array([0.0, 0.0, 1.1]), []
    for _ in range(100):
        places.append(place)
        for _ in range(10):
            step = 1.0 / RATE / 10
            velocity = velocity - step * (DRAG * np.linalg.norm(velocity) * velocity + np.array([0, 0, GRAVITY]))
            place = place + step * velocity
        if place[2] < 0.78 and velocity[2] < 0.0:
            velocity = velocity * np.array([0.8, 0.8, -0.9])
    seen = np.array(places) + NOISE * rng.standard_normal((100, 3))
    return Track(3.0 + np.arange(100) / RATE, seen, name=f"{number:02d}")


def counted(track: Track, share: float) -> tuple[Track, np.ndarray]:
    """The track without some of its frames, its stamps counting the others; and the numbers of the frames kept."""
    rng = np.random.default_rng(int(track.name) + 100)
    kept = np.flatnonzero(rng.random(len(track.times)) >= share)
    times = track.times[0] + np.arange(len(kept)) / RATE
    return replace(track, times=times, positions=track.positions[kept]), kept - kept[0]


@pytest.fixture(scope="module")
def shots() -> list[Track]:
    return [shot(number) for number in range(16)]


@pytest.mark.parametrize("share", [0.1, 0.3])
def test_missing_frames_are_put_in_their_places(shots, share):
    dropped = [counted(track, share) for track in shots]
    stamps = look_at_stamps([track for track, _ in dropped], GRAVITY, DRAG)
    assert set(stamps.found) == {"counted_frames"}
    steps, wrong = 0, 0
    for track, frames in dropped:
        steps += len(frames) - 1
        wrong += int((np.diff(frame_counts(track)) != np.diff(frames)).sum())
        length = (frames[-1] - frames[0]) / RATE
        assert np.ptp(stamps.repaired(track).times) == pytest.approx(length, rel=0.03)
    assert wrong < 0.05 * steps
    assert stamps.missing == pytest.approx(share / (1.0 - share), rel=0.1)


@pytest.mark.parametrize("scale", [-0.4, 0.8])
def test_a_far_clock_is_seen(shots, scale):
    written = [replace(t, times=t.times[0] + (1.0 + scale) * (t.times - t.times[0])) for t in shots]
    stamps = look_at_stamps(written, GRAVITY, DRAG)
    assert set(stamps.found) == {"time_scale"}
    assert 1.0 + stamps.scale == pytest.approx(1.0 + scale, rel=0.05)
    repaired = stamps.repaired(written[0])
    assert np.ptp(repaired.times) == pytest.approx(np.ptp(shots[0].times), rel=0.05)


def test_good_stamps_are_left_alone(shots):
    stamps = look_at_stamps(shots, GRAVITY, DRAG)
    assert stamps == Stamps()
    assert stamps.repaired(shots[0]) is shots[0]


def test_stamps_that_are_times_are_not_counts(shots):
    """Frames that are missing in the stamps too need no repair."""
    gaps = [replace(t, times=t.times[::2], positions=t.positions[::2]) for t in shots[:8]]
    uneven = [replace(t, times=t.times[k], positions=t.positions[k]) for t in shots[8:] for k in [np.r_[:40, 45:100]]]
    assert look_at_stamps([*gaps, *uneven], GRAVITY, DRAG) == Stamps()


def test_evidence_of_numbers_that_scatter_about_zero():
    assert Evidence.of([]).p_value == 1.0
    assert Evidence.of([0.0, 0.0, 0.0]).p_value == 1.0
    assert Evidence.of([-1.0, 0.5, 0.2, -0.1, 0.4]).p_value > 0.5
    assert Evidence.of([1.0, 1.1, 0.9, 1.0, 1.05]).p_value < 1e-4
