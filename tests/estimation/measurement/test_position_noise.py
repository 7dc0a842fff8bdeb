"""The noise that is read off tracks, against the noise that was put in."""

from dataclasses import replace

import numpy as np
import pytest

import ballfg as bf
from ballfg.estimation import RadarSpeed
from ballfg.estimation.measurement.position_noise import FALLBACK, FLOOR, estimate_position_noise, noise_doubts
from ballfg.estimation.settings import Settings
from ballfg.tracks import Track

SIGMA = np.array([0.001, 0.002, 0.0035])


def bouncing(rng, n=120, rate=150.0, sigma=SIGMA):
    """A track with a bounce every 60 samples."""
    t = np.arange(n) / rate
    phase = t % 0.4
    clean = np.stack([4 * t, 0.3 * t, 0.77 + 1.96 * phase - 4.9 * phase**2], axis=1)
    return Track(t, clean + rng.normal(0, sigma, (n, 3)))


def test_white_noise_is_recovered():
    rng = np.random.default_rng(0)
    estimate = estimate_position_noise([bouncing(rng) for _ in range(40)])
    assert estimate == pytest.approx(SIGMA, rel=0.06)


@pytest.mark.parametrize(("share", "told"), [(1.0, False), (0.8, False), (0.5, True), (0.1, True)])
@pytest.mark.parametrize("own", [False, True])
def test_scatter_beyond_the_stated_noise_is_told(share, told, own):
    track = bouncing(np.random.default_rng(3))
    stated = tuple((share * SIGMA).tolist())
    if own:
        track = Track(track.times, track.positions, np.tile(stated, (len(track), 1)))
    notes = noise_doubts(track, Settings() if own else Settings(position_noise=stated))
    assert bool(notes) == told
    if told:
        assert f"where the settings say {1e3 * share * np.sqrt((SIGMA**2).mean()):.2g} mm" in notes[0]


@pytest.mark.parametrize(("share", "told"), [(1.0, False), (0.3, True)])
def test_good_and_bad_samples_with_sigmas_of_their_own(share, told):
    """Two in five samples are six times worse, and say so: as where cameras miss the ball in turn."""
    rng = np.random.default_rng(6)
    sigmas = np.where(rng.random((120, 1)) < 0.6, 1.0, 6.0) * SIGMA
    for _ in range(20):
        track = bouncing(rng, sigma=sigmas)
        notes = noise_doubts(Track(track.times, track.positions, share * sigmas), Settings())
        assert bool(notes) == told
        assert all(note.endswith("State larger ones.") for note in notes)


def test_scatter_of_other_sources_is_no_noise_of_positions():
    """An error that lasts, and stamps that jitter, count as stated; rough positions and short tracks tell nothing."""
    track = bouncing(np.random.default_rng(4))
    little = {"position_noise": (2e-4,) * 3}
    assert noise_doubts(track, Settings(**little))
    assert not noise_doubts(track, Settings(**little, memory=tuple(SIGMA)))
    assert not noise_doubts(track, Settings(**little, stamp_jitter=0.002))
    assert not noise_doubts(track.between(track.times[0], track.times[28]), Settings(**little))
    speeds = RadarSpeed(np.arange(120), np.full(120, 4.0), 1.0)
    assert not noise_doubts(replace(track, observations=(speeds,), rough=True), Settings(**little))


@pytest.mark.parametrize("rate", [25.0, 30.0, 35.0])
@pytest.mark.parametrize("size", [0.3, 1.0, 4.0])
def test_slow_trackers_show_their_noise(rate, size):
    """Eleven samples last longer than a flight is a cubic; fewer do not."""
    rng = np.random.default_rng(7)
    tracks = [bouncing(rng, n=24, rate=rate, sigma=size * SIGMA) for _ in range(40)]
    assert estimate_position_noise(tracks) == pytest.approx(size * SIGMA, rel=0.35)


@pytest.mark.parametrize("n", [7, 10])
def test_short_tracks_show_their_noise(n):
    rng = np.random.default_rng(8)
    tracks = [bouncing(rng, n=n, sigma=5.0 * SIGMA) for _ in range(200)]
    assert estimate_position_noise(tracks) == pytest.approx(5.0 * SIGMA, rel=0.2)


@pytest.mark.parametrize("rate", [30.0, 35.0, 40.0])
def test_bounces_in_most_windows_are_no_noise(rate):
    """With a bounce every 0.4 s most windows of a slow tracker hold one; the others show what is stated."""
    rng = np.random.default_rng(9)
    tracks = [bouncing(rng, n=int(1.6 * rate), rate=rate) for _ in range(50)]
    right, third = (Settings(position_noise=tuple(share * SIGMA)) for share in (1.0, 1 / 3))
    assert sum(bool(noise_doubts(track, right)) for track in tracks) <= 1
    assert sum(bool(noise_doubts(track, third)) for track in tracks) >= 48


def test_dropped_frames_leave_enough_windows():
    """A fifth of the frames is lost at 50 Hz: eleven samples often last too long, and fewer are taken."""
    rng, noted = np.random.default_rng(10), 0
    for _ in range(50):
        track = bouncing(rng, n=50, rate=50.0)
        kept = rng.random(len(track)) > 0.2
        track = Track(track.times[kept], track.positions[kept])
        noted += bool(noise_doubts(track, Settings(position_noise=tuple(SIGMA / 3))))
    assert noted >= 48


def test_every_estimator_notes_the_scatter():
    track = bouncing(np.random.default_rng(5))
    for method in ("smoother", "online", "ekf", "sliding-window"):
        good, bad = (
            bf.estimate(track, method=method, settings=Settings(position_noise=tuple(share * SIGMA)), surfaces=0.75)
            for share in (1.0, 0.4)
        )
        assert [note.split(" by")[0] for note in bad.notes] == ["the positions scatter"]
        assert good.notes == ()


def test_outliers_and_short_tracks_do_not_matter():
    rng = np.random.default_rng(1)
    tracks = []
    for _ in range(40):
        track = bouncing(rng)
        t, x = track.times, track.positions.copy()
        bad = rng.random(len(t)) < 0.03
        x[bad] += rng.normal(0, 0.1, (int(bad.sum()), 3))
        tracks += [Track(t, x), Track(t[:4], x[:4])]
    assert estimate_position_noise(tracks) == pytest.approx(SIGMA, rel=0.12)


def test_one_short_track_is_enough_for_an_order_of_magnitude():
    estimate = estimate_position_noise([bouncing(np.random.default_rng(2), n=30)])
    assert np.all((estimate > SIGMA / 2) & (estimate < SIGMA * 2))


def opening(rng, n, rate, sigma, bounce):
    """The beginning of a track, with a bounce at a share of its length; without one for None."""
    t = np.arange(n) / rate - (9.0 if bounce is None else bounce * n / rate)
    before = t < 0.0
    x, z = np.where(before, 4.0, 2.6) * t, np.where(before, -3.0, 2.7) * t - 4.9 * t**2
    return Track(t, np.stack((x, 0.3 * t, z), axis=1) + rng.normal(0.0, sigma, (n, 3)))


@pytest.mark.parametrize(("n", "rate"), [(16, 60.0), (25, 60.0), (26, 100.0), (31, 200.0)])
@pytest.mark.parametrize("sigma", [0.0005, 0.002, 0.006, 0.02])
@pytest.mark.parametrize("bounced", [False, True])
def test_the_opening_of_one_track_shows_its_noise_whether_the_ball_bounced_or_not(n, rate, sigma, bounced):
    """Most of its windows may hold the bounce. What few windows show is uncertain, and the noise larger for it."""
    rng = np.random.default_rng(11)
    bounces = rng.uniform(0.3, 0.7, 40) if bounced else [None] * 40
    found = [estimate_position_noise([opening(rng, n, rate, sigma, bounce)]) / sigma for bounce in bounces]
    assert (np.median(found, axis=0) > 0.8).all()
    assert (np.median(found, axis=0) < 2.2).all()
    assert (np.quantile(found, 0.75, axis=0) < 3.5).all()


def test_a_bounce_in_all_windows_of_the_only_track_is_no_noise():
    rng = np.random.default_rng(12)
    for _ in range(20):
        found = estimate_position_noise([opening(rng, 8, 60.0, 0.0005, bounce=0.45)])
        assert (found <= FALLBACK).all()


def test_the_noise_of_a_few_samples_is_rarely_too_small():
    """Three windows show less than half of the noise once in six times; the expected variance is seldom so small."""
    rng = np.random.default_rng(13)
    found = [estimate_position_noise([opening(rng, 9, 60.0, 0.002, bounce=None)]) / 0.002 for _ in range(200)]
    assert (np.mean(np.array(found) < 0.5, axis=0) < 0.1).all()


def test_reading_stops_when_there_is_enough():
    rng = np.random.default_rng(4)

    def endless():
        for count in range(1000):
            assert count < 250
            yield bouncing(rng)

    assert estimate_position_noise(endless()) == pytest.approx(SIGMA, rel=0.06)


@pytest.mark.parametrize("single", [False, True])
@pytest.mark.parametrize("step", [0.002, 0.01])
def test_rounded_positions_of_a_slow_axis_have_the_noise_of_the_rounding(step, single):
    """Rounded places of a ball that moves by one step in several windows lie on their cubics; (3,) are their errors."""
    times = np.arange(300) / 500.0
    path = np.outer(times, [2.9, 20.3 * step, -1.0]) - np.outer(times**2, [0.0, 0.0, 4.905])
    noisy = path + np.random.default_rng(15).normal(0.0, 1.0, path.shape) * [0.5 * step, 0.0, 0.0]
    rounded = np.round(noisy / step) * step
    found = estimate_position_noise([Track(times, rounded.astype(np.float32).astype(float) if single else rounded)])
    errors = np.sqrt(np.square(rounded - path).mean(axis=0))
    assert (found > 0.9 * errors).all()
    assert (found < 2.0 * errors).all()


def test_few_or_unrounded_places_are_no_rounding():
    """Samples far apart of rounded places, or a ball that stood in two: their steps are no noise."""
    times = np.arange(8) / 100.0
    path = np.outer(times, [3.0, 0.5, 2.0]) + np.random.default_rng(14).normal(0.0, 0.0005, (8, 3))
    assert (estimate_position_noise([Track(times, np.round(path, 3))]) < 0.002).all()
    stood = np.repeat([[0.0, 0.0, 0.0], [1.0, 0.0, 0.0]], 40, axis=0)
    assert np.array_equal(estimate_position_noise([Track(np.arange(80) / 100.0, stood)]), np.full(3, FLOOR))


def test_no_noise_gives_the_floor():
    assert np.array_equal(estimate_position_noise([bouncing(np.random.default_rng(0), sigma=0.0)]), np.full(3, FLOOR))


@pytest.mark.parametrize("n", [1, 5])
def test_nothing_to_see_gives_the_fallback(n):
    assert np.array_equal(estimate_position_noise([bouncing(np.random.default_rng(0), n=n)]), np.full(3, FALLBACK))
    slow = Track(np.arange(50) * 1.0, np.zeros((50, 3)))
    assert np.array_equal(estimate_position_noise([slow]), np.full(3, FALLBACK))


def test_a_sample_far_from_all_others_leaves_a_number() -> None:
    """It determines the cubic through its window alone: rounding took what is left of it below zero."""
    rng = np.random.default_rng(0)
    for alone in (1e-3, 0.05, 0.29):
        times = np.concatenate((np.arange(10) * 1e-6, [alone], alone + 0.2 + np.arange(10) * 1e-6))
        track = Track(times, rng.normal(0.0, 1.0, (len(times), 3)))
        sigma = estimate_position_noise([track])
        assert np.isfinite(sigma).all()
        assert (sigma > 0.0).all()
