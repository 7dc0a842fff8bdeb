"""Hops as low as the noise: counted where they can be, and covered by the covariance where they cannot."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.result import Status
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.estimation.smoother.second_look.hop_grid import RESTS, SPEEDS, HopGrid, HopLaw, averaged
from ballfg.estimation.smoother.second_look.hopping_ball import HoppingBall
from ballfg.estimation.smoother.second_look.low_hops import counted, uncounted_note
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks import Track
from tests.estimation.low_bounces import LIMIT, LYING, MODEL, SETTINGS, SURFACES, beside_bounces, hopping_out
from tests.estimation.nees import nees

G, RESTITUTION, FASTEST = 9.81, 0.93, 0.5
NEARLY_EXACT = HopLaw(G, FASTEST, RESTITUTION * HopLaw.speeds(FASTEST), np.full(SPEEDS, 0.005), 0.01)


def hop_heights(speed: float, since: float, times: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Heights, vertical velocities, and bounces so far, hop by hop in closed form. Args: speed, since: at time 0."""
    heights, rises, bounces = [], [], []
    for time in times:
        left, now, count = since + time, speed, 0
        while left >= 2.0 * now / G:
            left, now, count = left - 2.0 * now / G, RESTITUTION * now, count + 1
        heights.append(now * left - 0.5 * G * left**2)
        rises.append(now - G * left)
        bounces.append(count)
    return np.array(heights), np.array(rises), np.array(bounces)


def test_the_grid_is_the_average_over_all_hops() -> None:
    """Against a sum over 40,000 hops of a nearly exact ball, weighed with the samples' likelihood."""
    rng, times, sigma = np.random.default_rng(3), np.arange(20) / 150.0, 0.002
    truth = hop_heights(0.35, 0.02, times)
    heights = truth[0] + rng.normal(0.0, sigma, len(times))
    found = HopGrid(NEARLY_EXACT, 96, 1e-4).moments(times, heights, np.full(len(times), sigma))
    speeds = rng.uniform(0.05, FASTEST, 40_000)
    tried = [hop_heights(u, f * 2.0 * u / G, times) for u, f in zip(speeds, rng.uniform(0, 1, 40_000), strict=True)]
    z, v, bounces = (np.array(column) for column in zip(*tried, strict=True))
    weights = np.exp(-0.5 * (((heights - z) / sigma) ** 2).sum(axis=1))
    weights /= weights.sum()
    assert np.abs(found.mean[:, 0] - weights @ z).max() < 0.3 * sigma
    assert np.abs(found.mean[:, 1] - weights @ v).max() < 0.06
    assert found.bounces.sum() == pytest.approx(weights @ bounces[:, -1], abs=0.1)
    wide, dense = found.second[:, 1, 1] - found.mean[:, 1] ** 2, weights @ v**2 - (weights @ v) ** 2
    assert 0.7 < np.sqrt(wide.mean() / dense.mean()) < 1.5


def test_before_the_first_sample_each_hop_is_as_probable_and_rest_has_its_share() -> None:
    shares = HopGrid(NEARLY_EXACT, 48, 1e-4)._first
    assert shares.sum() == pytest.approx(1.0)
    assert shares[-1] == RESTS
    assert np.ptp(shares[:-1]) == 0.0


def test_the_gap_of_a_ball_is_its_height_above_where_it_touches() -> None:
    ball = HoppingBall(MODEL, SETTINGS["coefficients estimated"])
    gap = ball.gap(np.array([[0.0, 0.0, LYING], [0.1, 0.2, LYING + 0.05]]), 0.0)
    assert gap[1] - gap[0] == pytest.approx(0.05)
    assert abs(gap[0]) < 0.01


def test_a_ball_that_lies_still_is_known_to() -> None:
    rng, times = np.random.default_rng(1), np.arange(150) / 150.0
    grid, noise = HopGrid(NEARLY_EXACT, 48, 1e-4), np.full(150, 0.002)
    known = grid.moments(times, rng.normal(0.0, 0.002, 150), noise)
    assert known.resting[-1] > 0.999
    assert known.speed[-1] < 1e-3
    assert known.bounces[-20:].sum() < 1e-3


def test_the_height_of_the_surface_is_found_with_the_hops() -> None:
    rng, times, noise = np.random.default_rng(2), np.arange(120) / 150.0, np.full(120, 0.002)
    heights = hop_heights(0.45, 0.0, times)[0] + 0.003 + rng.normal(0.0, 0.002, 120)
    levels = np.linspace(-0.008, 0.008, 9)
    said = HopGrid(NEARLY_EXACT, 48, 1e-4).evidence(times, heights, noise, levels)
    assert abs(levels[said.argmax()] - 0.003) <= 0.002
    one = HopGrid(NEARLY_EXACT, 48, 1e-4)
    alone = one.evidence(times, heights - levels[said.argmax()], noise, np.zeros(1))
    assert alone[0] == pytest.approx(said.max(), rel=1e-9)


def test_averages_over_heights_are_moments_of_the_mixture() -> None:
    rng, times, noise = np.random.default_rng(4), np.arange(30) / 150.0, np.full(30, 0.002)
    heights = hop_heights(0.3, 0.0, times)[0] + rng.normal(0.0, 0.002, 30)
    grid, levels, weights = HopGrid(NEARLY_EXACT, 48, 1e-4), np.array([0.0, 0.002]), np.array([0.25, 0.75])
    one, other = (grid.moments(times, heights - level, noise) for level in levels)
    both = averaged([one, other], levels, weights)
    point = np.stack((rng.normal(0.0, 0.002, 30), rng.normal(0.0, 0.3, 30)), axis=-1)
    expected = 0.25 * one.second[:, 0, 0] + 0.75 * (other.second[:, 0, 0] + 2.0 * 0.002 * other.mean[:, 0] + 0.002**2)
    np.testing.assert_allclose(both.second[:, 0, 0], expected, rtol=1e-12)
    spread = both.spread(point)
    exact = both.second[:, 0, 0] - 2.0 * point[:, 0] * both.mean[:, 0] + point[:, 0] ** 2
    np.testing.assert_allclose(spread[:, 0, 0], exact, rtol=1e-9)
    assert (np.linalg.eigvalsh(spread) > 0.0).all()


@pytest.mark.parametrize("name", ["exact model", pytest.param("coefficients estimated", marks=pytest.mark.thorough)])
def test_no_ball_that_hops_out_is_sure_of_a_wrong_state(name) -> None:
    """Five tracks; `python -m tests.estimation.low_bounces` is the same over hundreds."""
    smoother, fine = Smoother(MODEL, SURFACES, SETTINGS[name]), 0
    for states, track in hopping_out(5, seed=1):
        estimate = smoother.estimate(track)
        fine += estimate.status is Status.OK
        assert nees(estimate, states, slice(0, 6))[~beside_bounces(states)].max() < LIMIT
        assert np.linalg.eigvalsh(estimate.covariances).min() > 0.0
    assert fine >= 4


def test_bounces_that_can_be_counted_are() -> None:
    """Hops of 20 down to 5 mm, noise of 1 mm: the number of bounces is right."""
    smoother = Smoother(MODEL, SURFACES, replace(SETTINGS["exact model"], position_noise=(0.001,) * 3))
    times, rng = np.arange(90) / 150.0, np.random.default_rng(6)
    heights, _, bounces = hop_heights(0.6, 0.03, times)
    level = np.stack((0.3 * times, np.zeros(90), LYING + heights), axis=-1)
    estimate = smoother.estimate(Track(times, level + rng.normal(0.0, 0.001, level.shape)))
    assert len(estimate.contacts) == bounces[-1]
    assert estimate.status is Status.OK
    assert estimate.notes == ()


def test_where_bounces_cannot_be_counted_a_note_says_so() -> None:
    track = hopping_out(1, seed=1)[0][1]
    smoother = Smoother(MODEL, SURFACES, SETTINGS["exact model"])
    hops = smoother.low_hops(track, smoother.segment(track))
    assert uncounted_note(hops, track.times) == tuple(n for n in smoother.estimate(track).notes if "hop" in n)
    assert any(note.startswith("from ") for note in uncounted_note(hops, track.times))


def test_a_part_of_a_stretch_is_what_the_stretch_has_there() -> None:
    track = hopping_out(1, seed=1)[0][1]
    smoother = Smoother(MODEL, SURFACES, SETTINGS["exact model"])
    (one,) = smoother.low_hops(track, smoother.segment(track))
    part = one.select(one.first + 10, one.first + 30)
    assert part is not None
    assert part.first == 0
    assert part.last == 19
    np.testing.assert_array_equal(part.known.mean, one.known.mean[10:30])
    np.testing.assert_array_equal(part.known.bounces, one.known.bounces[10:29])
    assert one.select(one.last + 1, one.last + 5) is None


def test_tracks_without_low_hops_keep_their_events() -> None:
    times = 0.01 * np.arange(80)
    heights = 0.3 + 1.0 * times - 0.5 * G * times**2
    track = Track(times, np.stack((4.0 * times, 0.0 * times, np.abs(heights)), axis=-1))
    smoother = Smoother(MODEL, SURFACES, SETTINGS["exact model"])
    events: Segmentation = smoother.segment(track)
    assert smoother.low_hops(track, events) == ()
    assert counted(events, (), track.times) is events


def test_filtered_forwards_a_hop_is_known_as_well_at_its_last_sample():
    """The backward pass adds nothing there: a filter over heights of the surface is the average of the smoothers."""
    grid, levels = HopGrid(NEARLY_EXACT, 48, 1e-4), np.array([0.0, 0.002])
    rng, times = np.random.default_rng(3), np.arange(40) / 100.0
    heights, sigma = 0.004 + rng.normal(0.0, 0.002, 40), np.full(40, 0.002)
    belief = grid.unknown(levels).weighed(heights[0], 0.002)
    for ticks, height in zip(grid.ticks(times), heights[1:], strict=True):
        belief = belief.moved(ticks).weighed(height, 0.002)
    assert np.allclose(belief.said, grid.evidence(times, heights, sigma, levels), rtol=0, atol=1e-9)
    each = [grid.moments(times, heights - level, sigma) for level in levels]
    weights = np.exp(belief.said - belief.said.max())
    last, found = averaged(each, levels, weights / weights.sum()).select(slice(39, 40)), belief.moments()
    for name in ("mean", "second", "higher", "speed", "resting"):
        assert np.allclose(getattr(found, name), getattr(last, name), rtol=1e-9, atol=1e-15), name
    moves, rests = belief.moving().moments(), found.resting
    assert moves.resting == 0.0
    assert np.allclose((1.0 - rests) * moves.speed, found.speed, rtol=1e-9)
