"""The noise of a stream that nobody stated: what its samples show."""

from __future__ import annotations

import numpy as np
import pytest

import ballfg as bf
from ballfg.estimation.online.scatter import LOOKED
from ballfg.live import Tracker

RATE, GRAVITY, DRAG = 100.0, 9.6, 0.11


def flown(n: int, rng: np.random.Generator) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stamps (n,) s, positions and velocities (n, 3) of a ball with drag and no spin, by Euler steps of 0.1 ms."""
    velocity = np.array([4.0, rng.uniform(-0.5, 0.5), rng.uniform(2.0, 4.0)])
    position, step, every = np.array([0.0, 0.0, 0.4]), 1e-4, 100
    places, ways = [], []
    for k in range(n * every):
        if k % every == 0:
            places.append(position)
            ways.append(velocity)
        pull = -DRAG * np.linalg.norm(velocity) * velocity - [0.0, 0.0, GRAVITY]
        position, velocity = position + step * velocity + 0.5 * step**2 * pull, velocity + step * pull
    return np.arange(n) / RATE, np.array(places), np.array(ways)


def settings(noise: float) -> bf.Settings:
    return bf.Settings.for_measured(bf.nominal_model(), position_noise=(noise,) * 3)


@pytest.mark.parametrize("noise", [0.0005, 0.005])
def test_velocities_are_as_uncertain_as_the_stream_shows(noise: float) -> None:
    """As with the true noise stated; the usual one overstates the sigmas of one stream twice, understates another's."""
    rng, ratios, squares = np.random.default_rng(5), [], []
    for _ in range(8):
        times, positions, velocities = flown(40, rng)
        measured = positions + rng.normal(0.0, noise, positions.shape)
        shown, stated, usual = (
            [online.push(t, p) for t, p in zip(times, measured, strict=True)][-1]
            for online in (
                bf.Online(bf.nominal_model(), 0.0),
                bf.Online(bf.nominal_model(), 0.0, settings(noise)),
                bf.Online(bf.nominal_model(), 0.0, settings(0.0015)),
            )
        )
        sigmas = [np.sqrt(np.diag(state.covariance)[3:6]) for state in (shown, stated, usual)]
        ratios.append([sigmas[0] / sigmas[1], sigmas[2] / sigmas[1]])
        off = shown.state[3:6] - velocities[-1]
        squares.append(off @ np.linalg.solve(shown.covariance[3:6, 3:6], off))
    by_shown, by_usual = np.exp(np.log(ratios).mean(axis=(0, 2)))
    assert 0.8 < by_shown < 1.4
    assert not 0.7 < by_usual < 1.4
    assert np.mean(squares) < 6.0


def test_a_stream_whose_noise_showed_is_that_of_the_noise_from_its_first_sample_on() -> None:
    rng = np.random.default_rng(6)
    times, positions, _ = flown(30, rng)
    measured = positions + rng.normal(0.0, 0.004, positions.shape)
    online = bf.Online(bf.nominal_model(), 0.0)
    assert online.scatter is not None
    for k, (t, p) in enumerate(zip(times, measured, strict=True)):
        before = online.scatter.sigma
        state = online.push(t, p)
        assert online.scatter.sigma is before or state.revised == k
        if len(online.window or ()) in LOOKED:
            same = bf.Online(bf.nominal_model(), 0.0, settings(1.0))
            for other_t, other_p in zip(times, measured, strict=True):
                other = same.push(other_t, other_p, online.scatter.sigma)
                if other_t == t:
                    break
            np.testing.assert_allclose(state.state, other.state, rtol=1e-9, atol=1e-12)
            np.testing.assert_allclose(state.covariance, other.covariance, rtol=1e-7, atol=1e-15)


def test_stated_noise_stays_and_a_copy_learns_by_itself() -> None:
    rng = np.random.default_rng(7)
    times, positions, _ = flown(12, rng)
    measured = positions + rng.normal(0.0, 0.004, positions.shape)
    assert bf.Online(bf.nominal_model(), 0.0, settings(0.002)).scatter is None
    with_settings = bf.Online(bf.nominal_model(), 0.0, settings(0.002), shown_noise=True)
    for k, (t, p) in enumerate(zip(times, measured, strict=True)):
        with_settings.push(t, p, (0.001,) * 3 if k % 2 else None)
    assert with_settings.scatter is not None
    early = with_settings.copy()
    before = early.scatter
    for k in range(60):
        with_settings.push(times[-1] + (k + 1) / RATE, measured[-1])
    assert early.scatter is before
    assert early.window is not None
    assert len(early.window) == 12
    with pytest.raises(TypeError, match="shown_noise must be True or False"):
        bf.Online(bf.nominal_model(), 0.0, shown_noise="yes")  # type: ignore[arg-type]


@pytest.mark.parametrize("copied", [3, 7, 12])
def test_a_copy_has_the_states_of_a_stream_that_was_never_copied(copied: int) -> None:
    """Also where a noise that shows later changes samples from before the copy."""
    rng = np.random.default_rng(13)
    times, positions, _ = flown(30, rng)
    measured = positions + rng.normal(0.0, 0.01, positions.shape)
    online, other = (bf.Online(bf.nominal_model(), 0.0) for _ in range(2))
    for k, (t, p) in enumerate(zip(times, measured, strict=True)):
        other = other.copy() if k == copied else other
        np.testing.assert_array_equal(online.push(t, p).covariance, other.push(t, p).covariance)
    assert online.scatter is not None
    assert (online.scatter.sigma > 0.004).all()


@pytest.mark.parametrize("noise", [pytest.param(0.0, marks=pytest.mark.thorough), 0.0003])
def test_a_ball_that_lies_before_it_flies_is_known_as_well_as_stated(noise: float) -> None:
    """At rest a tracker repeats positions or averages them; in flight they have 3 mm."""
    rng, squares = np.random.default_rng(14), []
    for _ in range(3):
        times, positions, velocities = flown(40, rng)
        still = positions[0] + rng.normal(0.0, 1.0, (150, 3)) * noise
        online = bf.Online(bf.nominal_model(), 0.0)
        for k, p in enumerate(still):
            online.push(k / RATE, p)
        states = [online.push(1.5 + t, p + rng.normal(0.0, 0.003, 3)) for t, p in zip(times, positions, strict=True)]
        for state, velocity in zip(states[10:], velocities[10:], strict=True):
            off = state.state[3:6] - velocity
            squares.append(off @ np.linalg.solve(state.covariance[3:6, 3:6], off))
        assert np.median([state.covariance[3:6, 3:6].trace() for state in states[10:]]) < 3 * 0.08**2
    assert np.median(squares) < 6.0


def test_a_refused_sample_shows_no_noise() -> None:
    times, positions, _ = flown(20, np.random.default_rng(8))
    measured = positions + np.random.default_rng(9).normal(0.0, 0.004, positions.shape)
    online, other = (bf.Online(bf.nominal_model(), 0.0) for _ in range(2))
    for t, p in zip(times, measured, strict=True):
        for bad in ((t - 1.0, p), (t, [np.nan, 0.0, 0.0])):
            if t > 0.0:
                with pytest.raises(ValueError, match="must be"):
                    online.push(*bad)
        np.testing.assert_array_equal(online.push(t, p).covariance, other.push(t, p).covariance)


def test_pushes_with_a_budget_explain_nothing_anew() -> None:
    """Only later samples have the noise that showed."""
    times, positions, _ = flown(LOOKED[0] + 1, np.random.default_rng(10))
    measured = positions + np.random.default_rng(11).normal(0.0, 0.02, positions.shape)
    online = bf.Online(bf.nominal_model(), 0.0, budget_ms=1000.0, shown_noise=True)
    for t, p in zip(times, measured, strict=True):
        online.push(t, p)
    assert online.window is not None
    stated = np.array([sample.stated for sample in online.window.samples])
    np.testing.assert_array_equal(stated[:-1], np.full((LOOKED[0], 3), 0.0015))


def test_later_balls_begin_with_the_noise_that_the_first_one_showed() -> None:
    """Stated as it showed, it gives the states of the second ball."""
    rng, tracker, last = np.random.default_rng(12), Tracker(bf.nominal_model(), 0.0), []
    for ball in range(2):
        times, positions, _ = flown(LOOKED[-1] + 8, rng)
        measured = positions + rng.normal(0.0, 0.004, positions.shape)
        for t, p in zip(3.0 * ball + times, measured, strict=True):
            last = [update.state for update in tracker.push(t, p)]
    assert tracker.counts.balls == 2
    x, y, z = tracker.estimator.settings.position_noise
    assert (x, y, z) == pytest.approx((0.004,) * 3, rel=0.3)
    stated = bf.Settings.for_measured(bf.nominal_model(), position_noise=(x, y, z), solver="ballfg")
    other = Tracker(bf.nominal_model(), 0.0, stated)
    for t, p in zip(times, measured, strict=True):
        same = [update.state for update in other.push(t, p)]
    assert last[0] is not None
    assert same[0] is not None
    np.testing.assert_allclose(last[0].covariance, same[0].covariance, rtol=1e-6, atol=1e-15)


@pytest.mark.parametrize("noises", [(0.0, 0.003), (0.02, 0.001)])
def test_a_later_ball_of_another_noise_is_known_as_well_as_stated(noises: tuple[float, float]) -> None:
    """A simulated ball first, or one that is far away: neither its noise nor its gate stays with the tracker."""
    rng, tracker = np.random.default_rng(15), Tracker(bf.nominal_model(), -20.0)
    for ball, noise in enumerate(noises):
        squares, traces = [], []
        times, positions, velocities = flown(LOOKED[-1] + 20, rng)
        for k, (t, p) in enumerate(zip(times, positions, strict=True)):
            (update,) = tracker.push(3.0 * ball + t, p + rng.normal(0.0, noise, 3))[-1:]
            if k >= 30 and update.state is not None:
                off, spread = update.state.state[3:6] - velocities[k], update.state.covariance[3:6, 3:6]
                squares.append(off @ np.linalg.solve(spread, off))
                traces.append(np.trace(spread))
    assert len(squares) > 90
    assert 0.3 < np.median(squares) < 6.0
    assert np.median(traces) < 3 * 0.06**2
    assert (np.sqrt(tracker.gate.noise) < 0.0045).all()
