"""Pose and focal length from table points: planted cameras come back, and the covariance is that of the scatter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2, kstest

from ballfg.vision.calibration.extrinsics import calibrate_extrinsics
from ballfg.vision.calibration.focal import pose_and_focal
from ballfg.vision.calibration.report import UNLIKELY, Calibration, summary
from ballfg.vision.camera import Camera
from ballfg.vision.projection import ZOOM, changed
from tests.vision.calibration.test_extrinsics import AT, CORNERS, PLACES, marked, shaken, standing, turned


def grown(camera: Camera, zoom: float) -> Camera:
    return changed(camera, np.append(np.zeros(ZOOM), zoom))


@pytest.mark.parametrize("place", PLACES[:3])
def test_a_planted_camera_comes_back(place: tuple[float, float, float]) -> None:
    """Nine points without noise correct a focal length that is 5 % off, if it is known to 5 %."""
    camera = standing(place)
    found = pose_and_focal(grown(camera, 0.05), marked(camera, tuple(AT), 0.1), 0.05).camera
    np.testing.assert_allclose(found.centre, place, atol=0.01)
    assert found.matrix[0, 0] == pytest.approx(camera.matrix[0, 0], rel=3e-3)
    assert found.matrix[1, 1] / found.matrix[0, 0] == pytest.approx(camera.matrix[1, 1] / camera.matrix[0, 0])


def test_covariances_are_those_of_the_scatter() -> None:
    """Corners at 1 px, focal lengths off by 5 %: squares of whitened errors are of chi-square with seven degrees."""
    camera, rng, squares = standing(PLACES[1]), np.random.default_rng(0), []
    for _ in range(150):
        lens = grown(camera, 0.05 * rng.standard_normal())
        found = pose_and_focal(lens, shaken(marked(camera, sigma=1.0), rng), 0.05).camera
        error = np.concatenate(
            (-turned(camera, found), found.centre - camera.centre, [np.log(found.matrix[0, 0] / camera.matrix[0, 0])])
        )
        squares.append(error @ np.linalg.solve(found.covariance, error))
    low, high = chi2.ppf([0.001, 0.999], 7 * 150) / 150
    assert low < np.mean(squares) < high


def whitened_square(camera: Camera, found: Camera) -> float:
    zoom = np.log(found.matrix[0, 0] / camera.matrix[0, 0])
    error = np.concatenate((-turned(camera, found), found.centre - camera.centre, [zoom]))
    return float(error @ np.linalg.solve(found.covariance, error))


def test_marks_that_are_worse_than_stated_widen_the_covariance() -> None:
    """Nine points at 1 px, stated to 0.5 px: chi-square with the noise stated has a mean of four times seven."""
    camera, rng, squares = standing(PLACES[1]), np.random.default_rng(0), []
    for _ in range(60):
        seen = replace(shaken(marked(camera, tuple(AT), 1.0), rng), sigma=0.5)
        found = pose_and_focal(grown(camera, 0.05 * rng.standard_normal()), seen, 0.05)
        assert found.marked.sigma == 0.5
        squares.append(whitened_square(camera, found.camera))
    assert np.mean(squares) < 14.0


def test_covariances_of_both_ways_agree() -> None:
    """A focal length known to 1e-4 is as good as an exact lens: turns and moves are correlated alike."""
    seen = shaken(marked(standing(PLACES[1]), tuple(AT), 1.0), np.random.default_rng(0))
    alone, both = (
        found.covariance
        for found in (calibrate_extrinsics(standing(PLACES[1]), seen), pose_and_focal(standing(PLACES[1]), seen, 1e-4))
    )
    sigmas = np.sqrt(np.diag(alone))
    np.testing.assert_allclose(both / np.outer(sigmas, sigmas), alone / np.outer(sigmas, sigmas), atol=0.01)


def test_a_focal_length_known_to_a_fifth_is_found_wherever_it_is() -> None:
    """Nine points at 0.5 px are not explained at focal lengths that are tried, and at the one between them they are."""
    camera, rng, squares = standing(PLACES[0]), np.random.default_rng(0), []
    for zoom in np.linspace(-0.4, 0.4, 41):
        found = pose_and_focal(grown(camera, zoom), shaken(marked(camera, tuple(AT)), rng), 0.2).camera
        assert abs(np.log(found.matrix[0, 0] / camera.matrix[0, 0])) < 0.1
        squares.append(whitened_square(camera, found))
    assert np.mean(squares) < chi2.ppf(0.999, 7 * 41) / 41


@pytest.mark.parametrize(("names", "off"), [(CORNERS, 0.06), (tuple(AT), 0.04)])
def test_residuals_beyond_the_noise_are_noted(names: tuple[str, ...], off: float) -> None:
    """Chances of right lenses are even; a wrong focal length has hardly one, and with its sigma it has again."""
    camera, rng, chances = standing(PLACES[0]), np.random.default_rng(0), []
    for _ in range(200):
        place = calibrate_extrinsics(camera, shaken(marked(camera, names), rng))
        chances.append(place.chance)
        assert ("note: " in " ".join(summary(Calibration(place.camera, None, place)))) == (place.chance < UNLIKELY)
    assert kstest(chances, "uniform").pvalue > 0.01
    seen = shaken(marked(camera, names), rng)
    wrong = calibrate_extrinsics(grown(camera, off), seen)
    assert wrong.rms < 4.0 * seen.sigma
    assert wrong.chance < 1e-5
    said = " ".join(summary(Calibration(wrong.camera, None, wrong)))
    assert "note: noise of 0.5 px explains that with a chance of " in said
    assert "--focal-sigma 0.05" in said
    assert pose_and_focal(grown(camera, off), seen, 0.05).chance > 0.01


@pytest.mark.parametrize("sigma", [0.0, 0.5, np.nan])
def test_bad_sigmas_are_refused(sigma: float) -> None:
    camera = standing(PLACES[1])
    with pytest.raises(ValueError, match=r"focal_sigma must be at least 0\.0001, at most 0\.3"):
        pose_and_focal(replace(camera), marked(camera), sigma)
