"""The extended Kalman filter on what real tracks bring: contacts, outliers, hits, gaps, few samples, odd stamps."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from ballfg.dynamics import nominal_model
from ballfg.dynamics.analytic import AnalyticModel
from ballfg.dynamics.effects.flight import Gravity
from ballfg.dynamics.motion.arrays import advance_jacobian
from ballfg.estimation.filters.ball_filter import BallFilter
from ballfg.estimation.filters.ekf import ExtendedKalmanFilter, _Run
from ballfg.estimation.result import Status
from ballfg.estimation.segmentation.result import Quality
from ballfg.estimation.settings import Settings
from ballfg.factors.noise import ProcessNoise
from ballfg.state import POSITION, VELOCITY
from ballfg.tracks import Track
from tests.estimation.filters.filtering import LOW, PLAIN, SERVE, TABLE, run, simulate, with_positions
from tests.estimation.nees import nees


def test_contact_is_found_where_it_was(flight):
    _, track = flight
    result = run(track)
    (contact,) = result.contacts
    assert track.times[contact.interval] <= contact.time <= track.times[contact.interval + 1]
    assert contact.height == 0.0
    assert len(result.hits) == 0
    assert (result.quality == Quality.GOOD).all()


@pytest.mark.parametrize("smooth", [False, True])
def test_planted_outliers_are_flagged_and_do_no_harm(flight, smooth):
    truth, track = flight
    planted = [0, 7, 20, 21, 22, 50]
    positions = track.positions.copy()
    positions[planted] += [0.03, -0.04, 0.05]
    clean, result = run(track, smooth=smooth), run(with_positions(track, positions), smooth=smooth)
    assert np.flatnonzero(result.quality == Quality.OUTLIER).tolist() == planted
    assert len(result.hits) == 0
    moved = np.abs(result.states[-1] - clean.states[-1]) / clean.sigmas[-1]
    assert moved.max() < 2.0
    assert nees(result, truth)[-1] < chi2.ppf(0.999, 9)
    assert nees(result, truth)[0] < chi2.ppf(0.999, 9)


@pytest.mark.parametrize("bad", [0, 1, 2, 3])
def test_an_outlier_among_the_first_samples_is_named(flight, bad):
    truth, track = flight
    positions = track.positions.copy()
    positions[bad, 1] += 0.06
    result = run(with_positions(track, positions))
    assert np.flatnonzero(result.quality == Quality.OUTLIER).tolist() == [bad]
    assert nees(result, truth)[10] < chi2.ppf(0.999, 9)


@pytest.mark.parametrize(("height", "believed"), [(0.03, (0, 1)), (0.07, (1, 2))])
def test_only_near_a_surface_need_the_first_samples_not_lie_on_a_parabola(rng, height, believed):
    """Within 5 cm of it there may be a bounce between them. The first sample is 6 cm off."""
    start = np.array([0.0, 0.0, TABLE.table_height + 0.02 + height, 5.0, 0.5, 0.5, 10.0, 60.0, 20.0])
    _, track = simulate(nominal_model(), PLAIN, start, np.arange(4) * 0.01, rng)
    positions = track.positions.copy()
    positions[0, 1] += 0.06
    filtering = _Run(ExtendedKalmanFilter(nominal_model(), TABLE, PLAIN), with_positions(track, positions))
    assert filtering._first_pair(0) == believed


def test_without_events_every_sample_counts(flight):
    _, track = flight
    positions = track.positions.copy()
    positions[30] += 0.2
    estimator = ExtendedKalmanFilter(nominal_model(), TABLE, Settings(process=PLAIN.process, find_events=False))
    result = estimator.estimate(with_positions(track, positions))
    assert (result.quality == Quality.GOOD).all()
    assert len(result.hits) == 0


@pytest.mark.parametrize("smooth", [False, True])
def test_planted_hit_is_found_in_its_interval(rng, smooth):
    first, before = simulate(nominal_model(), PLAIN, SERVE, np.arange(25) * 0.01, rng)
    struck = first[-1].copy()
    struck[3:] = [-4.0, 1.0, 2.0, 0.0, -80.0, 10.0]
    second, after = simulate(nominal_model(), PLAIN, struck, np.arange(31) * 0.01, rng)
    truth = np.concatenate((first, second[1:]))
    positions = np.concatenate((before.positions, after.positions[1:]))
    track = Track(np.arange(55) * 0.01, positions, labels=before.labels, name="struck")
    result = run(track, smooth=smooth)
    assert result.hits.tolist() == [24]
    assert (result.quality == Quality.GOOD).all()
    assert nees(result, truth, VELOCITY)[[23, 35, 54]].max() < chi2.ppf(0.999, 3)
    alone = run(before, smooth=smooth)
    assert np.abs(result.states[:24] - alone.states[:24]).max() < (2.0 if smooth else 1e-9)


def test_a_position_after_a_hit_starts_anew_at_its_measurement(rng):
    """However weak hits are said to be, where the ball was before tells nothing of where it is now."""
    first, before = simulate(nominal_model(), PLAIN, SERVE, np.arange(25) * 0.01, rng)
    struck = first[-1].copy()
    struck[3:6] = [-9.0, 1.0, 2.0]
    _, after = simulate(nominal_model(), PLAIN, struck, np.arange(11) * 0.01, rng)
    positions = np.concatenate((before.positions, after.positions[1:]))
    track = Track(np.arange(35) * 0.01, positions, labels=before.labels, name="struck")
    weak = replace(PLAIN, process=replace(PLAIN.process, hit_velocity=0.5))
    result = ExtendedKalmanFilter(nominal_model(), TABLE, weak).estimate(track)
    assert result.hits[0] == 24
    np.testing.assert_allclose(result.states[25, :3], positions[25], atol=1e-5)  # 14 cm off the prediction
    np.testing.assert_allclose(result.sigmas[25, :3], 0.002, rtol=1e-4)


@pytest.mark.parametrize("dt", [0.01, 0.2])
def test_a_wide_velocity_is_linearised_at_the_one_that_the_next_sample_tells(dt):
    """Drag-free flight from the first sample to the next one, gravity included; the mean itself stays."""
    start = np.concatenate((SERVE[:3], np.zeros(6)))
    spread = np.diag(np.repeat([1e-4, 20.0, 100.0], 3) ** 2)
    ball = BallFilter(AnalyticModel([Gravity()]), LOW, start, spread, np.eye(3, 9))
    fallen = SERVE[POSITION] + SERVE[VELOCITY] * dt - [0.0, 0.0, 9.81 * dt**2 / 2]
    point = ball.linearisation_point(fallen, dt, 1e-8 * np.eye(3))
    np.testing.assert_allclose(point[VELOCITY], SERVE[VELOCITY], atol=0.01)
    np.testing.assert_array_equal(ball.x, start)


def test_gap_of_a_fifth_of_a_second(flight):
    truth, track = flight
    keep = np.r_[0:10, 30:60]
    result = run(Track(track.times[keep], track.positions[keep], labels=track.labels, name="gap"))
    assert (result.quality == Quality.GOOD).all()
    assert nees(result, truth[keep])[[9, 10, -1]].max() < chi2.ppf(0.999, 9)


def test_gap_with_the_bounce_in_it(flight):
    truth, track = flight
    keep = np.r_[0:28, 48:60]
    result = run(Track(track.times[keep], track.positions[keep], labels=track.labels, name="gap"))
    assert [contact.interval for contact in result.contacts] == [27]
    assert nees(result, truth[keep])[[28, -1]].max() < chi2.ppf(0.999, 9)


@pytest.mark.parametrize("smooth", [False, True])
@pytest.mark.parametrize("initialise", ["prior", "window"])
@pytest.mark.parametrize("count", [1, 2, 3, 5])
def test_few_observations_give_honest_covariances(flight, count, smooth, initialise):
    truth, track = flight
    short = track.until(track.times[count - 1])
    result = run(short, smooth=smooth, initialise=initialise)
    assert result.status is (Status.NO_VELOCITY if count == 1 else Status.OK)
    assert nees(result, truth[:count]).max() < chi2.ppf(0.9999, 9)
    expected = 20.0 if count == 1 else 0.002 * np.sqrt(2) / (0.01 * (count - 1))
    assert 0.3 * expected < result.sigmas[-1, 3] < 3.0 * expected


def test_only_the_rising_part(rng):
    start = np.array([0, 0, 0.0201, 5.0, 0.5, 3.0, 10, 60, 20])
    truth, track = simulate(nominal_model(), PLAIN, start, np.arange(25) * 0.01, rng, label=False)
    result = run(track)
    assert result.contacts == ()
    assert len(result.hits) == 0
    assert nees(result, truth, slice(0, 6))[-1] < chi2.ppf(0.999, 6)


def test_stamps_a_microsecond_apart(rng):
    times = np.sort(np.concatenate((np.arange(30) * 0.01, np.arange(1, 30, 3) * 0.01 + 1e-6)))
    truth, track = simulate(nominal_model(), PLAIN, SERVE, times, rng)
    result = run(track, smooth=True)
    assert (result.quality == Quality.GOOD).all()
    assert nees(result, truth)[[1, 15, -1]].max() < chi2.ppf(0.999, 9)


@pytest.mark.parametrize("shift", np.linspace(-1.5e-3, 1.5e-3, 7))
def test_a_contact_close_to_a_stamp(shift, rng):
    """The bounce falls within 1.5 ms of a stamp, on either side; innovations must not notice."""
    exact = Settings(process=ProcessNoise(1e-3, 1e-3, 1e-3, 1e-3), position_noise=(0.002,) * 3)
    contact = advance_jacobian(nominal_model(), np.array(SERVE, dtype=float), 0.6, TABLE).contacts[0][0]
    times = np.concatenate(([0.0], contact + shift + np.arange(-30, 20) * 0.01))
    _, track = simulate(nominal_model(), exact, SERVE, times, rng)
    result = run(track)
    assert (result.quality == Quality.GOOD).all()
    assert len(result.contacts) == 1
    assert result.nis[28:40].mean() < chi2.ppf(0.9999, 36) / 12
