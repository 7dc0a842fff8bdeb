"""Factors of uncertain cameras: derivatives against differences, a changed camera by OpenCV, exact ones among them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.factors.batch import Values
from ballfg.factors.camera import FIXED, CameraFactors
from ballfg.factors.check import check_factor
from ballfg.factors.uncertain_camera import UncertainCameraFactors
from ballfg.vision.projection import CHANGES, CameraBank, changed
from tests.factors.test_camera import RIG, factors, radii

SIGMAS = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.05, 0.03])
ROOT = np.tril(np.random.default_rng(3).uniform(0.3, 1.0, (CHANGES, CHANGES))) * SIGMAS[:, None]
LOOSE = (replace(RIG[0], covariance=ROOT @ ROOT.T), RIG[1], replace(RIG[2], covariance=ROOT @ ROOT.T))
PLACES = np.array([3, FIXED, 10])
"""After three coefficients of others; the second camera is exact."""


def both(known: bool, size: float) -> tuple[UncertainCameraFactors, CameraFactors, Values]:
    """Uncertain factors, the same about the cameras as they are, and values with changes of a size in sigmas."""
    plain, values = factors(6, True, **radii(6, known))
    covariances = np.linalg.inv(plain.root.swapaxes(1, 2) @ plain.root)
    given = (plain.variables[:, 0], plain.camera, plain.pixels, covariances)
    shown = radii(6, known)
    rest = (plain.delay, np.array([FIXED, 2, 1]), None, shown.get("radii"), shown.get("ball", 0.0))
    changes = size * np.random.default_rng(5).standard_normal(2 * CHANGES)
    loose = UncertainCameraFactors(LOOSE, PLACES, *given, CameraBank(LOOSE), *rest)
    return loose, plain, replace(values, coefficients=np.concatenate((values.coefficients, changes)))


@pytest.mark.parametrize("known", [False, True])
def test_jacobians_agree_with_differences(known: bool) -> None:
    loose, _, values = both(known, 0.5)
    assert check_factor(loose, values, tolerance=1e-8) < 1e-8


@pytest.mark.parametrize("known", [False, True])
def test_a_changed_camera_sees_the_same(known: bool) -> None:
    """Changes of 1e-3 sigma: the turn's second order is 1e-10 of the picture's width."""
    loose, plain, values = both(known, 1e-3)
    parts = values.coefficients[3:].reshape(2, CHANGES)
    first, last = (changed(camera, ROOT @ z) for camera, z in zip((RIG[0], RIG[2]), parts, strict=True))
    plain.bank = CameraBank((first, RIG[1], last))
    one, other = (kind.linearize(values).residual for kind in (loose, plain))
    still = both(known, 0.0)[0].linearize(replace(values, coefficients=values.coefficients * (np.arange(17) < 3)))
    np.testing.assert_allclose(one, other, atol=1e-5)
    assert np.abs(one - still.residual)[[0, 2, 3, 5]].min(axis=0).max() > 1e-3
