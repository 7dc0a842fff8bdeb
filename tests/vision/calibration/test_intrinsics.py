"""Lenses recovered from rendered boards and from exact corners; sigmas against scatter; views that cannot tell."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from ballfg.vision import Camera
from ballfg.vision.calibration.boards import Charuco, Chessboard, View
from ballfg.vision.calibration.intrinsics import (
    _FLAGS,
    RAYS,
    Intrinsics,
    _fit,
    _has_pole,
    calibrate_intrinsics,
    covariance_of_lens,
    coverage,
    pixel_grid,
    sigma_of_rays,
    turn,
)
from ballfg.vision.calibration.report import Calibration, summary
from tests.vision.calibration.board_scenes import CHARUCO, CHESSBOARD, TRUE, exact_views, image_of, poses


def astray(one: Camera, other: Camera) -> np.ndarray:
    """(m, 2) px by which `other` sees the rays of one's pixels elsewhere, all turned alike so that it is least."""
    grid = pixel_grid(one)
    rays = np.column_stack((one.normalized(grid), np.ones(len(grid))))
    shift = (other.project(rays) - grid).ravel()
    slopes = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), other.matrix, other.distortion)[1]
    return (shift - slopes[:, :3] @ np.linalg.lstsq(slopes[:, :3], shift)[0]).reshape(-1, 2)


def apart(one: Camera, other: Camera) -> float:
    """px, the longest of these."""
    return float(np.linalg.norm(astray(one, other), axis=1).max())


@pytest.mark.parametrize(
    ("board", "reach"),
    [
        pytest.param(CHESSBOARD, 1.0, marks=pytest.mark.thorough, id="chessboard"),
        pytest.param(CHARUCO, 1.7, id="charuco"),
    ],
)
def test_lens_is_recovered_from_images(board: Chessboard | Charuco, reach: float) -> None:
    rng = np.random.default_rng(0)
    views = []
    for i, pose in enumerate(poses(board, 10, rng, tilt=0.5, reach=reach)):
        pixels, points = board.find(image_of(board, *pose, rng)) or (np.zeros((0, 2)), np.zeros((0, 3)))
        views.append(View(f"{i}.png", TRUE.size, pixels, points))
    found = calibrate_intrinsics("left", views)
    assert found.rms < 0.1
    np.testing.assert_allclose(found.camera.matrix[[0, 1], [0, 1]], TRUE.matrix[[0, 1], [0, 1]], rtol=3e-3)
    np.testing.assert_allclose(found.camera.matrix[:2, 2], TRUE.matrix[:2, 2], atol=3.0)
    errors = np.linalg.norm(astray(TRUE, found.camera), axis=1)
    usual, worst = found.ray_sigma
    assert np.quantile(errors, RAYS) < min(0.5, 5 * usual)
    assert errors.max() < 5 * worst
    assert len(found.views) + len(found.left_out) + len(found.missed) == 10


@pytest.mark.parametrize("count", [0, 4, 5])
def test_every_lens_model_recovers_its_own(count: int) -> None:
    """Corners to 1e-3 px: what is left is the model's own error."""
    true = replace(TRUE, distortion=TRUE.distortion[:count])
    found = calibrate_intrinsics("left", exact_views(30, np.random.default_rng(3), 1e-3, true), count)
    assert found.camera.distortion.shape == (count,)
    assert found.sigmas.shape == (4 + count,)
    assert apart(true, found.camera) < 0.1


@pytest.mark.parametrize("count", [8, 12, 14])
def test_larger_models_fit_the_corners_as_well(count: int) -> None:
    """Whether they are known well enough is another question; see the refusals below."""
    fitted = _fit("left", exact_views(9, np.random.default_rng(3), 0.1), count)
    assert fitted.camera.distortion.shape == (count,)
    assert fitted.rms < 0.1 * np.sqrt(2)


def test_sigmas_are_the_scatter_of_calibrations() -> None:
    """Whitened errors of fx, fy, cx, cy over 30 calibrations of other noise: mean square 1, give or take 4 sigma."""
    true = TRUE.matrix[[0, 1, 0, 1], [0, 1, 2, 2]]
    clean = exact_views(15, np.random.default_rng(1), 0.0)
    whitened = []
    for seed in range(30):
        rng = np.random.default_rng(seed)
        noisy = [replace(view, pixels=view.pixels + rng.normal(0, 0.1, view.pixels.shape)) for view in clean]
        found = calibrate_intrinsics("left", noisy)
        whitened.append((found.camera.matrix[[0, 1, 0, 1], [0, 1, 2, 2]] - true) / found.sigmas[:4])
    assert 0.5 < np.mean(np.square(whitened)) < 1.7


def test_rms_is_the_noise() -> None:
    found = calibrate_intrinsics("left", exact_views(20, np.random.default_rng(2), 0.2))
    assert found.rms == pytest.approx(0.2 * np.sqrt(2), rel=0.05)  # of a length in the plane
    np.testing.assert_allclose([view.rms for view in found.views], found.rms, rtol=0.35)


def test_a_view_that_disagrees_is_left_out_and_named() -> None:
    rng = np.random.default_rng(4)
    views = exact_views(12, rng)
    views[5] = replace(views[5], pixels=views[5].pixels + rng.normal(0, 3.0, views[5].pixels.shape))
    found = calibrate_intrinsics("left", views)
    assert [left.view.name for left in found.left_out] == ["05.png"]
    assert found.left_out[0].rms > 2.0
    assert len(found.views) == 11
    assert found.rms < 0.15


def test_too_many_views_that_disagree() -> None:
    rng = np.random.default_rng(4)
    views = exact_views(12, rng)
    for i in range(5):
        views[i] = replace(views[i], pixels=views[i].pixels + rng.normal(0, 3.0 + 2 * i, views[i].pixels.shape))
    with pytest.raises(ValueError, match=r"camera 'left': views must agree on one lens; 5 of 12 do not \(04.png, 03"):
        calibrate_intrinsics("left", views)


@pytest.mark.parametrize("count", [0, 4, 5])
def test_covariance_is_that_of_opencv(count: int) -> None:
    """OpenCV inverts the normal equations with the poses in them; its own noise has the same degrees of freedom."""
    true = replace(TRUE, distortion=TRUE.distortion[:count])
    views = exact_views(20, np.random.default_rng(5), 0.1, true)
    points, pixels = ([np.float32(getattr(view, field)) for view in views] for field in ("points", "pixels"))
    flags = _FLAGS[count]
    _, matrix, bent, rvecs, tvecs, sigmas, _, _ = cv2.calibrateCameraExtended(
        points, pixels, TRUE.size, np.eye(3), np.zeros(0), flags=flags
    )
    camera = replace(TRUE, matrix=matrix, distortion=np.ravel(bent)[:count])
    boards = []
    for view, rvec, tvec in zip(views, rvecs, tvecs, strict=True):
        projected = cv2.projectPoints(view.points, rvec, tvec, matrix, bent)[0].reshape(-1, 2)
        boards.append((view.points, np.ravel(rvec), np.ravel(tvec), view.pixels - projected))
    mine = np.sqrt(np.diag(covariance_of_lens(camera, boards)))
    ratio = mine / np.ravel(sigmas)[: 4 + count]
    np.testing.assert_allclose(ratio, 1.0, rtol=0.03)


def test_ray_sigma_is_the_scatter_of_rays() -> None:
    """Where 20 calibrations put rays against the true lens; the sigma is that of the worse of two directions."""
    clean = exact_views(20, np.random.default_rng(1), 0.0)
    squares, expected = [], []
    for seed in range(20):
        rng = np.random.default_rng(seed)
        noisy = [replace(view, pixels=view.pixels + rng.normal(0, 0.1, view.pixels.shape)) for view in clean]
        found = calibrate_intrinsics("left", noisy)
        squares.append((astray(TRUE, found.camera) ** 2).sum(axis=1))
        expected.append(sigma_of_rays(found.camera, found.covariance))
    ratio = np.sqrt(np.mean(squares)) / np.sqrt(np.mean(np.square(expected)))
    assert 0.8 < ratio < np.sqrt(2.0)


def test_a_denominator_that_is_zero_within_the_image_is_a_pole() -> None:
    """1 + k4 q + k5 q^2 + k6 q^3 = (1 - 4 q)(1 + q + q^2): zero at a squared radius q of 0.25."""
    rational = [0.1, 0.0, 0.0, 0.0, 0.0, -3.0, -3.0, -4.0]
    camera = replace(TRUE, distortion=np.array(rational))
    assert _has_pole(camera, 0.26)
    assert not _has_pole(camera, 0.24)
    assert not _has_pole(replace(TRUE, distortion=np.array(rational[:5])), 10.0)
    assert not _has_pole(replace(TRUE, distortion=-np.array(rational)), 0.2)  # zeros where no lens is


def test_coefficients_that_the_views_cannot_tell_are_refused() -> None:
    """They fit the corners and go astray by pixels between them and the image's border."""
    views = exact_views(15, np.random.default_rng(0), 0.2)
    refused(views, r"(known to 1 px in 95% of the image|possible to undo).*fewer coefficients", 12)


def test_a_lens_without_views_to_spare_is_not_known() -> None:
    assert np.isinf(covariance_of_lens(TRUE, [])[0, 0])
    assert np.isinf(sigma_of_rays(TRUE, covariance_of_lens(TRUE, []))).all()


def refused(views: list[View], message: str, distortion: int = 5) -> None:
    with pytest.raises(ValueError, match=message):
        calibrate_intrinsics("left", views, distortion)


def test_too_few_views_and_which_show_no_board() -> None:
    views = exact_views(9, np.random.default_rng(0))
    blank = replace(views[0], name="blank.png", pixels=np.zeros((0, 2)), points=np.zeros((0, 3)))
    refused([*views[:2], blank], r"at least 3 images must show the board; got 2 of 3. No board .* in blank.png\.")
    assert calibrate_intrinsics("left", [*views, blank]).missed == ("blank.png",)


@pytest.mark.parametrize("count", [3, 4, 6])
def test_few_views_are_known_as_well_as_they_say(count: int) -> None:
    """The squared error in the metric of the stated covariance has the mean of its nine degrees of freedom."""
    true = np.array([*TRUE.matrix[[0, 1], [0, 1]], *TRUE.matrix[:2, 2], *TRUE.distortion])
    squares = []
    for seed in range(40):
        fitted = _fit("left", exact_views(count, np.random.default_rng(8000 + seed), 0.05), 5)
        found = np.array(
            [*fitted.camera.matrix[[0, 1], [0, 1]], *fitted.camera.matrix[:2, 2], *fitted.camera.distortion]
        )
        squares.append((found - true) @ np.linalg.solve(fitted.covariance, found - true))
    assert np.mean(squares) == pytest.approx(9.0, abs=3.0 * np.sqrt(2.0 * 9.0 / 40.0))


def test_few_views_are_used_with_a_warning() -> None:
    views = exact_views(8, np.random.default_rng(0), 0.02)
    for count in (4, 8):
        lens = calibrate_intrinsics("left", views[:count])
        said = " ".join(summary(Calibration(lens.camera, lens, None)))
        assert ("few images: the uncertainties hold if the board is flat" in said) == (count < 8)


def test_images_of_different_sizes() -> None:
    views = exact_views(9, np.random.default_rng(0))
    views[3] = replace(views[3], size=(480, 640))
    refused(views, "images must have one size; 00.png has 640x480 and 03.png 480x640 pixels")


@pytest.mark.parametrize("noise", [0.01, 0.3])
@pytest.mark.parametrize("seed", range(3))
def test_boards_parallel_to_the_image_cannot_tell_the_focal_length(seed: int, noise: float) -> None:
    refused(exact_views(15, np.random.default_rng(seed), noise, tilt=0.0), "boards must be turned against each other")


def test_boards_parallel_to_each_other_are_refused() -> None:
    refused(exact_views(15, np.random.default_rng(0), tilt=0.02, lean=0.5), "boards must be turned against each other")


def test_a_focal_length_that_is_hardly_known_is_refused() -> None:
    refused(
        exact_views(9, np.random.default_rng(0), 1.0, tilt=0.15), r"focal length must be known to 2 %; got \d+\.\d %"
    )


def test_corners_in_the_middle_of_the_image_only_are_refused() -> None:
    views = exact_views(12, np.random.default_rng(0), camera=replace(TRUE, size=(1280, 960)), reach=0.5)
    refused(views, r"corners must lie in 40 % of the image or more; got \d\d %")


def test_a_distortion_that_folds_the_image_is_refused() -> None:
    """Strong barrel distortion that no ray reaches beyond 0.9 of the half diagonal."""
    true = replace(TRUE, distortion=np.array([-0.75, 0, 0, 0]))
    views = [view for view in exact_views(24, np.random.default_rng(0), 0.02, true) if np.isfinite(view.pixels).all()]
    refused(views, r"distortion must be possible to undo; .* fewer coefficients than 4", 4)


def test_distortion_must_be_a_length_that_opencv_knows() -> None:
    refused(exact_views(9, np.random.default_rng(0)), "distortion must be one of 0, 4, 5, 8, 12, 14", 3)


def test_turn_and_coverage_by_hand() -> None:
    normals = np.array([[0, 0, 1], [np.sin(0.3), 0, np.cos(0.3)], [0, np.sin(0.2), np.cos(0.2)]])
    assert turn(normals) == pytest.approx(np.arccos(np.cos(0.3) * np.cos(0.2)))
    assert turn(normals[:1]) == 0.0
    assert coverage((80, 50), np.array([[-0.5, -0.5], [9.4, 9.4], [9.6, 0.0], [79.5, 49.5]])) == pytest.approx(3 / 40)


def test_the_same_views_give_the_same_numbers() -> None:
    def found() -> Intrinsics:
        return calibrate_intrinsics("left", exact_views(12, np.random.default_rng(0)))

    np.testing.assert_array_equal(found().camera.matrix, found().camera.matrix)
    np.testing.assert_array_equal(found().sigmas, found().sigmas)


def test_a_lens_is_looked_at_every_sixteen_pixels_and_at_its_border() -> None:
    grid = pixel_grid(TRUE)
    for axis, side in enumerate(TRUE.size):
        places = np.unique(grid[:, axis])
        assert (places[0], places[-1]) == (0.0, side - 1.0)
        assert 8.0 < np.diff(places).max() <= 16.0
    assert len(np.unique(grid, axis=0)) == len(grid) == np.prod([len(np.unique(axis)) for axis in grid.T])
