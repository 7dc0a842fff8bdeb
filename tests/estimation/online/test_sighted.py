"""Sightings one by one into iSAM2: the smoother's minimum at the end, honest states on the way, what is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.estimator import Estimator
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter
from ballfg.estimation.filters.sliding_window import SlidingWindow
from ballfg.estimation.observations.sightings import SAME_MOMENT
from ballfg.estimation.online.online import Online
from ballfg.estimation.online.state import OnlineState
from ballfg.estimation.online.stream import SightingStream
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.noise import ProcessNoise
from tests.estimation.observations.sighted_rig import RIG, Scene, World, scene, track_of, world

SAME = 1e-4
"""Posterior standard deviations: how far `estimate` may lie from the smoother; 1e-6 is what it does."""
SAME_CONTACT = 0.02
"""The same where a contact had to move to the next interval: the process noise knows its time to a part of that."""


@pytest.fixture(scope="module")
def ball() -> World:
    return world()


def pushed(online: Online, made: Scene) -> list[OnlineState | None]:
    seen = made.sightings
    rows = zip(seen.times.tolist(), seen.camera.tolist(), seen.pixels, seen.covariances, strict=True)
    return [online.push_sighting(t, seen.cameras[c], z, noise) for t, c, z, noise in rows]


@pytest.mark.parametrize(
    ("seed", "phases", "tolerance"),
    [(1, (0.0, 1 / 3, 2 / 3), SAME), (2, (0.0, 0.0, 0.0), SAME), (0, (0.0, 1 / 3, 2 / 3), SAME_CONTACT)],
    ids=["unsynchronised", "synchronised", "contact at a stamp"],
)
def test_final_estimate_is_the_smoothers(ball: World, seed: int, phases: tuple[float, ...], tolerance: float) -> None:
    made = scene(seed, ball, phases=phases, duration=0.4)
    settings = Settings.for_measured(ball.model) if seed == 2 else Settings()
    track = track_of(made)
    online = Online(ball.model, ball.surfaces, settings, lag=200).estimate(track)
    smoothed = Smoother(ball.model, ball.surfaces, settings).estimate(track)
    assert online.status is smoothed.status is Status.OK
    assert len(online.contacts) == len(smoothed.contacts) == 1
    assert (np.abs(online.states - smoothed.states) / smoothed.sigmas).max() < tolerance
    assert online.error == pytest.approx(smoothed.error, rel=1e-5)
    assert online.whitened.shape == (len(track.observations[0]), 2)


def test_rows_of_rolling_shutters_are_pushed_when_they_were_seen(ball: World) -> None:
    rolling = tuple(replace(camera, readout=readout) for camera, readout in zip(RIG, (0.012, -0.007, 0.0), strict=True))
    found = []
    for rig in (RIG, rolling):
        online = Online(ball.model, ball.surfaces, Settings(), cameras=rig)
        found.append([state for state in pushed(online, scene(1, ball, duration=0.3, rig=rig)) if state is not None])
    assert len(found[0]) == len(found[1]) > 20
    for one, other in zip(*found, strict=True):
        assert other.time == pytest.approx(one.time, abs=1e-12)
        np.testing.assert_allclose(other.state, one.state, rtol=1e-6, atol=1e-6)


def test_innovations_are_as_large_as_stated(ball: World) -> None:
    """Chi-square of 2 degrees: mean 2, median 2 ln 2. Both of n numbers scatter by 2 / sqrt(n): three times that."""
    exact = Settings(process=ProcessNoise(acceleration=0.01, spin=0.1, contact_velocity=0.01, contact_spin=0.1))
    tracks = [track_of(scene(seed, ball, duration=0.35)) for seed in (3, 4, 5)]
    nis = np.concatenate([Online(ball.model, ball.surfaces, exact, lag=200).estimate(t).nis for t in tracks])
    nis = nis[np.isfinite(nis)]
    assert len(nis) > 350
    assert nis.mean() == pytest.approx(2.0, abs=6.0 / np.sqrt(len(nis)))
    assert np.median(nis) == pytest.approx(2.0 * np.log(2.0), abs=6.0 / np.sqrt(len(nis)))


def test_states_on_the_way(ball: World) -> None:
    """A live stream: a few sightings until rays meet, then states whose errors are in their covariances."""
    made = scene(1, ball, duration=0.45)
    online = Online(ball.model, ball.surfaces, Settings(), cameras=RIG)
    states = pushed(online, made)
    known = [k for k, state in enumerate(states) if state is not None]
    assert known == list(range(known[0], len(states)))
    assert known[0] <= 6
    up = int(np.flatnonzero(np.diff(made.truth[:, 5]) > 1.0)[0])
    error = {k: states[k].state - made.truth[k] for k in known}
    before = [k for k in known if 20 <= k < up - 2]
    after = [k for k in known if k > up + 12]
    for part in (before, after):
        assert len(part) > 20
        speed = [np.linalg.norm(error[k][3:6]) for k in part]
        assert np.median(speed) < 0.05
        nees = [error[k][:6] @ np.linalg.solve(states[k].covariance[:6, :6], error[k][:6]) for k in part]
        assert np.mean(nees) < 12.0  # chi-square with 6 degrees, neighbours alike; the truth has no process noise
    assert not any(states[k].rebuilt for k in known)
    assert all(states[k].innovation.shape == (2,) for k in known)


def test_cameras_of_one_moment_join(ball: World) -> None:
    made = scene(2, ball, phases=(0.0, 0.0, 0.0), duration=0.15)
    online = Online(ball.model, ball.surfaces, Settings(), cameras=RIG)
    states = pushed(online, made)
    assert online.window is not None
    assert len(online.window) == 18
    assert [len(sample.measurements) for sample in online.window.samples] == [3] * 18
    assert np.linalg.norm((states[-1].state - made.truth[-1])[:3]) < 2e-3
    last = [np.trace(state.covariance[:3, :3]) for state in states[-3:]]
    assert last[0] > last[1] > last[2]  # each of them tells more of the same moment


def test_sightings_that_join_a_sample_know_how_much_later_they_were(ball: World) -> None:
    """Before the ball is found, while samples are held back, and after; the first of each moment makes the sample."""
    made = scene(2, ball, phases=(0.0, 0.0, 0.0), duration=0.15).sightings
    stream, placed, late = SightingStream(RIG, Settings().sighting_loss), [], 0.9 * SAME_MOMENT
    for k, time in enumerate(made.times):
        own = time + (late if k % 3 else 0.0)
        samples, joined = stream.take(own, made.cameras[made.camera[k]], made.pixels[k], made.covariances[k])
        placed += samples
        if joined is not None:
            placed[-1].measurements.append(joined)
    assert [len(sample.measurements) for sample in placed] == [3] * (len(made) // 3)
    for sample in placed:
        delays = [measurement.batch.delay.item() for measurement in sample.measurements]
        assert delays == pytest.approx([0.0, late, late], abs=1e-12)


def test_one_camera_is_carried_on_then_held_back(ball: World) -> None:
    made = scene(3, ball, duration=0.55)
    t = made.sightings.times
    kept = (made.sightings.camera == 0) | (t < 0.1)
    alone = Scene(made.sightings.select(kept), made.truth[kept])
    online = Online(ball.model, ball.surfaces, Settings(), cameras=RIG)
    states = pushed(online, alone)
    times = alone.sightings.times
    assert all(state is not None for state, time in zip(states, times, strict=True) if 0.05 < time < 0.38)
    assert all(state is None for state, time in zip(states, times, strict=True) if time > 0.43)


def test_a_wrong_sighting_hardly_moves_the_stream(ball: World) -> None:
    made = scene(4, ball, duration=0.25)
    pixels = made.sightings.pixels.copy()
    pixels[50] += (40.0, 30.0)
    wrong = Scene(replace(made.sightings, pixels=pixels), made.truth)
    online = [Online(ball.model, ball.surfaces, Settings(), cameras=RIG) for _ in range(2)]
    right, other = (pushed(o, m)[-1] for o, m in zip(online, (made, wrong), strict=True))
    moved = np.abs(right.state - other.state) / np.sqrt(np.diagonal(right.covariance))
    assert moved.max() < 0.3


def test_refuses_what_is_no_stream(ball: World) -> None:
    noise = np.eye(2)
    plain = Online(ball.model, ball.surfaces, Settings())
    with pytest.raises(ValueError, match="cameras must be given to use push_sighting"):
        plain.push_sighting(0.0, "left", [1.0, 2.0], noise)
    online = Online(ball.model, ball.surfaces, Settings(), cameras=RIG)
    with pytest.raises(ValueError, match="camera must be one of left, right, back; got 'top'"):
        online.push_sighting(0.0, "top", [1.0, 2.0], noise)
    with pytest.raises(ValueError, match="pixels must be finite"):
        online.push_sighting(0.0, "left", [1.0, np.nan], noise)
    assert online.push_sighting(0.1, "left", [600.0, 400.0], noise) is None
    with pytest.raises(ValueError, match=r"must come in order of true time; got 0.05 s of camera 'right' after 0.1 s"):
        online.push_sighting(0.05, "right", [600.0, 400.0], noise)
    with pytest.raises(ValueError, match="in order of true time"):
        online.push_sighting(0.1, "left", [600.0, 400.0], noise)


@pytest.mark.parametrize("build", [Smoother, Online, ExtendedKalmanFilter, SlidingWindow])
def test_sightings_have_no_tracker_s_memory(ball: World, build: type[Estimator]) -> None:
    """Their rough positions are not measured: memory and jitter of a tracker change nothing."""
    track = track_of(scene(1, ball, phases=(0.0, 1 / 3, 2 / 3), duration=0.3))
    told = replace(Settings(), memory=(0.004,) * 3, stamp_jitter=0.001)
    plain, other = (build(ball.model, ball.surfaces, settings).estimate(track) for settings in (Settings(), told))
    np.testing.assert_array_equal(other.states, plain.states)
    np.testing.assert_array_equal(other.covariances, plain.covariances)
