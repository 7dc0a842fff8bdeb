"""Whiteness along tracks whose tracker has a memory: an alarm without its name, none with it.

Coefficients that change along a recording: found, said in numbers, and silent where nothing changes.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from scipy import stats

from ballfg.diagnosis.fit.patterns import DRIFT, drift_block
from ballfg.diagnosis.fit.stretches import joined
from ballfg.diagnosis.generic_test import ALARM
from ballfg.diagnosis.residual_tests.generic import generic_tests
from ballfg.diagnosis.residual_tests.whiteness import _p_value, _summed, whiteness
from ballfg.tracks.noise import TrackNoise
from tests.diagnosis.conftest import POSITION_NOISE

MEMORY, TIME, JITTER = 0.003, 0.02, 0.001
TRACKER = TrackNoise(position=(POSITION_NOISE,) * 3, memory=(MEMORY,) * 3, memory_time=TIME)


def wandering(stretches, seed):
    """The stretches with errors that last beside their white ones."""
    rng = np.random.default_rng(seed)
    times = stretches.times.numpy()
    apart = np.abs(times[:, :, None] - times[:, None, :])
    root = np.linalg.cholesky(np.exp(-apart / TIME))
    errors = MEMORY * root @ rng.standard_normal((*times.shape, 3))
    return replace(stretches, positions=stretches.positions + torch.from_numpy(errors))


@pytest.fixture(scope="module")
def lasting(make_ball, make_launches, make_shots, make_fit):
    return make_fit(make_ball(), wandering(make_shots(make_ball(), make_launches(12, 81), 81).stretches, 3))


def test_the_moments_of_the_statistic_are_those_of_its_quadratic_form():
    """U = r'(W + c) r of r = M e: its mean, variance and third cumulant as traces of whole matrices."""
    rng = np.random.default_rng(3)
    n, k, d = 2, 7, 8
    taken = np.stack([np.linalg.qr(rng.standard_normal((3 * k, d)))[0] for _ in range(n)])
    apart = np.arange(k)[:, None] - np.arange(k)
    kernel = np.tile(np.exp(-0.5 * (apart / 2.0) ** 2) - np.eye(k), (n, 1, 1))
    lone = np.zeros((n, k, 3))
    lone[:, 2] = 0.7  # no pair of samples differs from another one, so that the noise counts as even
    total, variance, third = _summed(lone, taken.reshape(n, k, 3, d), np.ones((n, k), dtype=bool), kernel)
    moments = np.zeros(3)
    for rows in taken:
        M, W = np.eye(3 * k) - rows @ rows.T, np.kron(kernel[0], np.eye(3))
        c = -np.trace(M @ W) / np.trace(M)
        A = M @ (W + c * np.eye(3 * k))
        moments += [c * np.trace(M), 2.0 * np.trace(A @ A), 8.0 * np.trace(A @ A @ A)]
    np.testing.assert_allclose([total, variance, third], moments, rtol=1e-9)


@pytest.mark.parametrize("freedom", [2, 7, 40])
def test_p_values_of_a_chi_square_are_exact(freedom):
    """Its first three moments decide; here all others follow from them."""
    for value in (0.3, 1.0, 2.5):
        expected = stats.chi2.sf(value * freedom, freedom)
        assert _p_value((value - 1.0) * freedom, 2.0 * freedom, 8.0 * freedom) == pytest.approx(expected, rel=1e-9)


def test_a_memory_is_an_alarm_until_it_is_known(lasting):
    system = lasting.linearised
    assert whiteness(lasting, system).p_value < 1e-6
    assert whiteness(lasting, system, TRACKER).p_value > 0.01
    (time,) = [t for t in generic_tests(lasting, tracker=TRACKER) if t.name == "time"]
    assert time.p_value > ALARM


def test_balls_that_differ_from_track_to_track_are_no_tracker(lasting, make_ball, make_launches, make_shots, make_fit):
    """Twelve balls of as many masses: all of the drift is in their drags. Not so a memory."""
    rng, parts = np.random.default_rng(7), []
    for number, launch in enumerate(make_launches(12, 84)):
        ball = make_ball(drag={"k": 0.12 + 0.03 * rng.standard_normal()})
        shot = make_shots(ball, launch[None], number).stretches
        parts.append(replace(shot, names=(f"{number:03d}",), track=np.array([number])))
    found, *_ = generic_tests(make_fit(make_ball(), joined(parts)))
    assert (found.name, found.p_value < ALARM) == ("tracks", True)
    assert "flight.drag.k most of all" in found.where
    memory, *_ = generic_tests(lasting)
    assert (memory.name, memory.p_value < ALARM) == ("time", True)


def test_a_tracker_that_is_taken_to_be_white_changes_nothing(calm_fit):
    system = calm_fit.linearised
    plain, same = whiteness(calm_fit, system), whiteness(calm_fit, system, TrackNoise(position=(POSITION_NOISE,) * 3))
    np.testing.assert_allclose(same.explained / same.spread, plain.explained / plain.spread, atol=0.2)


def test_jitter_alone_is_no_drift(make_ball, make_launches, make_shots, make_fit):
    stretches = make_shots(make_ball(), make_launches(12, 82), 82).stretches
    late = JITTER * torch.from_numpy(np.random.default_rng(4).standard_normal(stretches.times.shape))
    steps = torch.diff(stretches.positions, dim=1) / torch.diff(stretches.times, dim=1)[..., None]
    velocities = torch.cat((steps, steps[:, -1:]), dim=1)
    moved = replace(stretches, positions=stretches.positions + late[..., None] * velocities)
    fit = make_fit(make_ball(), moved)
    tracker = TrackNoise(position=(POSITION_NOISE,) * 3, stamp_jitter=JITTER)
    assert whiteness(fit, fit.linearised, tracker).p_value > 0.01


def test_a_force_that_is_lacking_stays_a_pattern(make_ball, make_launches, make_shots, make_fit):
    """A known memory takes up a force no more than it explains."""
    windy = make_ball(wind={"x": 0.0, "y": 0.9, "z": 0.0})
    fit = make_fit(make_ball(), wandering(make_shots(windy, make_launches(12, 83), 83).stretches, 5))
    assert min(t.p_value for t in generic_tests(fit, tracker=TRACKER)) < ALARM


def test_a_fit_that_takes_up_everything_leaves_nothing_to_test() -> None:
    """By rounding the variance of what is left may come out below zero."""
    assert _p_value(1e-14, -1e-12, 0.0) == _p_value(0.0, 0.0, 0.0) == 1.0
    assert _p_value(3.0, 1.0, 0.0) == pytest.approx(stats.norm.sf(3.0), rel=1e-9)


def test_a_stretch_of_outliers_takes_no_part() -> None:
    """Its sums would be nothing divided by nothing."""
    n, k, d = 3, 12, 4
    rng = np.random.default_rng(2)
    kept, kernel = np.ones((n, k), dtype=bool), np.abs(rng.normal(size=(n, k, k)))
    kept[1], kernel[1] = False, 0.0
    taken = 0.2 * np.linalg.qr(rng.normal(size=(n, 3 * k, d)))[0].reshape(n, k, 3, d)
    taken[1] = 0.0
    residual = rng.normal(size=(n, k, 3)) * kept[..., None]
    others = [0, 2]
    alone = _summed(residual[others], taken[others], kept[others], kernel[others])
    assert _summed(residual, taken, kept, kernel) == pytest.approx(alone, rel=1e-12)
    assert _summed(residual[1:2], taken[1:2], kept[1:2], kernel[1:2]) == (0.0, 0.0, 0.0)


COUNT = 20


@pytest.fixture(scope="module")
def two_sessions(make_ball, make_launches, make_shots, make_fit):
    """Ten shots on a table of restitution 0.95, then ten on one of 0.87."""
    parts = [
        make_shots(make_ball(restitution={"e": e}), make_launches(COUNT // 2, seed), seed).stretches
        for e, seed in ((0.95, 31), (0.87, 32))
    ]
    return make_fit(make_ball(), replace(joined(parts), track=np.arange(COUNT)))


def recording_test(fit):
    (found,) = [t for t in generic_tests(fit) if t.name == DRIFT]
    return found


def test_another_table_is_found_and_said(two_sessions):
    found = recording_test(two_sessions)
    assert found.p_value < ALARM
    assert "bounce.restitution.e changes from 0.9" in found.where
    assert " to 0.8" in found.where


def test_one_session_is_silent(calm_fit):
    assert recording_test(calm_fit).p_value > ALARM


def test_columns_are_those_of_the_coefficients_from_minus_to_plus_one_sigma(calm_fit):
    system = calm_fit.linearised
    block = drift_block(calm_fit, system)
    free = calm_fit.problem.free
    assert block.quantities == tuple(free)
    sigmas = np.array([c.sigma for c in free.values()])
    own = system.by_common[..., : len(free)] * sigmas
    np.testing.assert_allclose(block.columns[0], -own[0], rtol=1e-12)
    np.testing.assert_allclose(block.columns[-1], own[-1], rtol=1e-12)


def test_one_track_tells_nothing_of_changes(calm_fit):
    stretches = calm_fit.problem.stretches
    alone = replace(
        calm_fit, problem=replace(calm_fit.problem, stretches=replace(stretches, track=np.zeros_like(stretches.track)))
    )
    system = calm_fit.linearised
    assert drift_block(alone, system) is None
