"""The swept disc: its parts against differences, its fit against balls drawn by counting."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.vision.detection.streak import Look, Patch, _linearised, fit_streak, start, swept
from tests.vision.drawn import coverage

VALUES = np.array([20.3, 18.8, 4.0, -3.0, 6.5, 60.0, 0.85, 0.2, -0.1])


def grid(size: int) -> tuple[np.ndarray, np.ndarray]:
    y, x = np.mgrid[:size, :size].astype(np.float32)
    return x.ravel(), y.ravel()


def patches(streak: float, count: int, noise: float, shade: float = 0.1, seed: int = 0) -> list:
    """Patches and true centres and halves: contrast 60 before a background that varies by 8."""
    rng = np.random.default_rng(seed)
    made = []
    for _ in range(count):
        half = streak / 2 * _unit(rng)
        size = 2 * int(np.ceil(streak / 2 + 11)) + 1
        centre = size // 2 + rng.uniform(-0.5, 0.5, 2)
        on, lit = coverage(size, centre, half, 6.5, shade * _unit(rng))
        x, y = grid(size)
        behind = 8 * np.sin(0.3 * x + 1) * np.cos(0.2 * y)
        change = on.ravel() * (60 - behind) + 60 * lit.ravel() + rng.normal(0, noise, x.size)
        patch = Patch(
            x, y, np.round(change).astype(np.float32), behind.astype(np.float32), 0.0, float(np.hypot(noise, 0.29))
        )
        made.append((patch, centre, half))
    return made


def _unit(rng: np.random.Generator) -> np.ndarray:
    angle = rng.uniform(0, 2 * np.pi)
    return np.array([np.cos(angle), np.sin(angle)])


@pytest.mark.parametrize("row", range(6))
def test_derivatives_agree_with_differences(row: int) -> None:
    x, y = grid(40)
    parameter = (0, 1, 2, 3, 4, 6)[row]
    step = np.zeros(9)
    step[parameter] = (
        0.02  # single precision leaves 1e-7 / 0.02, the second difference 0.02^2 / 6 of a third derivative
    )
    high, low = swept(x, y, VALUES + step)[0], swept(x, y, VALUES - step)[0]
    np.testing.assert_allclose(swept(x, y, VALUES)[1][row], (high - low) / 0.04, atol=1e-3)


def test_without_contrast_the_expectations_alone_tell_the_step() -> None:
    """Downhill in half^2 / (2 L^2) + (mean - look)' I (mean - look) / 2, which is what is left of the objective."""
    x, y = grid(40)
    empty = np.zeros_like(x)
    values, look = VALUES.copy(), Look(np.array([0.6, 0.05, 0.1]), np.diag([4.0, 9.0, 25.0]) + 0.5)
    values[5] = 1e-4
    normal, gradient, residual = _linearised(Patch(x, y, empty, empty, 0.0, 1.0), values, look)
    assert np.abs(residual).max() < 1e-3
    expected = np.zeros(9)
    expected[2:4] = -values[2:4] / 15.0**2
    expected[6:] = look.information @ (look.mean - values[6:])
    rest = [2, 3, 6, 7, 8]
    np.testing.assert_allclose(gradient[rest], expected[rest], rtol=1e-4)
    np.testing.assert_allclose(normal[6:, 6:], look.information, rtol=1e-4)
    np.testing.assert_allclose(normal[2:4, 2:4], np.eye(2) / 15.0**2, atol=1e-6)


@pytest.mark.parametrize("streak", [0.0, 3.0, 10.0, 25.0])
def test_coverage_is_that_of_a_counted_disc(streak: float) -> None:
    half = np.array([0.6, -0.8]) * streak / 2
    on, lit = coverage(51, np.array([25.2, 24.9]), half, 6.5, np.array([0.3, 0.1]))
    x, y = grid(51)
    area, parts = swept(x, y, np.array([25.2, 24.9, *half, 6.45, 1.0, 0.9, 0.0, 0.0]))
    assert np.abs(area - on.ravel()).max() < 0.03
    assert np.abs(0.3 * parts[6] + 0.1 * parts[7] - lit.ravel()).max() < 0.04
    assert area.sum() == pytest.approx(np.pi * 6.5**2, rel=0.02)


def test_start_has_the_moments_of_a_swept_disc() -> None:
    ((patch, centre, half),) = patches(15.0, 1, 0.0, shade=0.0)
    values = start(patch, Look.unknown())
    np.testing.assert_allclose(values[:2], centre, atol=0.3)
    assert abs(values[2:4] @ half) == pytest.approx(7.5**2, rel=0.15)
    assert values[4] == pytest.approx(6.5, rel=0.15)
    empty = Patch(patch.x, patch.y, -np.abs(patch.change), patch.background, 0.0, 1.0)
    assert start(empty, Look.unknown()) is None


@pytest.mark.parametrize(("streak", "bound"), [(0.0, 0.05), (5.0, 0.07), (12.0, 0.12)])
def test_centres_are_sub_pixel_and_honest(streak: float, bound: float) -> None:
    errors, nees = [], []
    for patch, centre, _ in patches(streak, 100, 3.0):
        fit = fit_streak(patch, start(patch, Look.unknown()), Look.unknown())
        errors.append(fit.centre - centre)
        nees.append(errors[-1] @ np.linalg.solve(fit.covariance[:2, :2], errors[-1]))
        assert fit.settled
        assert fit.unexplained < 0.02
    assert np.sqrt(np.mean(np.square(errors))) < bound
    assert np.abs(np.mean(errors, axis=0)).max() < 0.02
    assert 1.4 < np.mean(nees) < 3.0  # chi-square of 2 over 100: 2 +- 0.2 were the model exact


@pytest.mark.parametrize("streak", [5.0, 12.0, 25.0])
def test_streak_ends_are_found(streak: float) -> None:
    errors = []
    for patch, centre, half in patches(streak, 20, 3.0):
        fit = fit_streak(patch, start(patch, Look.unknown()), Look.unknown())
        sign = np.sign(fit.half @ half)
        errors += [fit.centre + sign * fit.half - centre - half, fit.centre - sign * fit.half - centre + half]
    assert np.sqrt(np.mean(np.square(errors))) < 0.3


def test_shading_would_pull_a_fit_that_did_not_know_of_it() -> None:
    none = Look(np.array([0.85, 0.0, 0.0]), np.diag([10.0, 1e6, 1e6]))
    pulled, free = [], []
    for patch, centre, _ in patches(6.0, 30, 1.0, shade=0.3):
        pulled.append(fit_streak(patch, start(patch, none), none).centre - centre)
        free.append(fit_streak(patch, start(patch, Look.unknown()), Look.unknown()).centre - centre)
    assert np.sqrt(np.mean(np.square(free))) < 0.3 * np.sqrt(np.mean(np.square(pulled)))


def test_what_is_no_ball_is_given_up() -> None:
    x, y = grid(41)
    rng = np.random.default_rng(0)
    cross = 60.0 * ((np.abs(x - 20) < 2) | (np.abs(y - 20) < 2)) + rng.normal(0, 2, x.size)
    patch = Patch(x, y, cross.astype(np.float32), np.zeros_like(x), 0.0, 2.0)
    fit = fit_streak(patch, start(patch, Look.unknown()), Look.unknown())
    assert fit.unexplained > 0.15
    assert not fit.settled


@pytest.mark.parametrize("radius", [20.0, 25.0])
def test_a_disc_that_covers_all_pixels_is_anywhere(radius: float) -> None:
    """Then no pixel tells its centre, and what single precision rounds must not make up any knowledge of it."""
    x, y = (axis.ravel().astype(np.float32) for axis in np.meshgrid(np.arange(16.0), np.arange(16.0)))
    for seed in range(3):
        change = (10.0 + 0.06 * np.random.default_rng(seed).normal(size=256)).astype(np.float32)
        patch = Patch(x, y, change, np.zeros(256, dtype=np.float32), 100.0, 0.2)
        fit = fit_streak(patch, np.array([7.5, 7.5, 0.0, 5.0, radius, 10.0, 0.9, 0.0, 0.0]), Look.unknown())
        sigmas = np.sqrt(np.linalg.eigvalsh(fit.covariance[:2, :2]))
        np.testing.assert_allclose(sigmas, 100.0, rtol=0.01)
        assert fit.values[5] == pytest.approx(10.0, abs=0.1)
