"""Triangulation: against closed forms, a general solver, planted errors, and the covariance it states."""

import numpy as np
import pytest
from scipy.optimize import least_squares

from ballfg.vision.association.triangulate import Triangulated, _proposal, _views, triangulate
from ballfg.vision.camera import Camera
from tests.vision.filming import looking, rig

NOISE = 0.3


def seen(
    cameras: list[Camera], points: np.ndarray, noise: float = NOISE, seed: int = 0
) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    pixels = np.stack([camera.project(points) for camera in cameras], axis=1)
    pixels += noise * rng.standard_normal(pixels.shape)
    return pixels, np.broadcast_to(max(noise, 1e-3) ** 2 * np.eye(2), (*pixels.shape, 2))


def places(count: int, seed: int = 1) -> np.ndarray:
    return np.random.default_rng(seed).uniform((0.0, -0.7, 0.7), (2.7, 0.7, 1.5), (count, 3))


def nees(made: Triangulated, points: np.ndarray) -> np.ndarray:
    error = made.points - points
    return np.einsum("ni,nij,nj->n", error, np.linalg.inv(made.covariances), error)


def test_without_noise_the_point_is_the_point() -> None:
    points = places(200)
    made = triangulate(rig(), *seen(rig(), points, noise=0.0))
    np.testing.assert_allclose(made.points, points, atol=1e-9)
    assert made.used.all()
    np.testing.assert_allclose(made.residuals, 0.0, atol=1e-6)


def test_covariance_is_honest() -> None:
    """The mean of n chi-square numbers of 3 degrees has standard deviation sqrt(6 / n): 0.055 here."""
    points = places(2000)
    made = triangulate(rig(), *seen(rig(), points))
    assert nees(made, points).mean() == pytest.approx(3.0, abs=0.2)
    assert made.used.all()


def test_covariance_of_two_cameras_at_a_right_angle() -> None:
    """Each sees two axes with sigma * distance / focal; the vertical they share."""
    cameras = [
        looking("south", (0.0, -3.0, 0.0), (0.0, 0.0, 0.0), distortion=[]),
        looking("west", (-3.0, 0.0, 0.0), (0.0, 0.0, 0.0), distortion=[]),
    ]
    made = triangulate(cameras, *seen(cameras, np.zeros((1, 3)), noise=0.0))
    one = (1e-3 * 3.0 / 1000.0) ** 2
    np.testing.assert_allclose(made.covariances[0], np.diag([one, one, one / 2]), rtol=1e-6, atol=1e-18)


def side_by_side(base: float = 0.1, depth: float = 3.0) -> list[Camera]:
    return [
        looking(name, (x, -depth, 0.0), (0.0, 0.0, 0.0), distortion=[])
        for name, x in (("a", -base / 2), ("b", base / 2))
    ]


def test_covariance_is_deep_along_the_viewing_direction() -> None:
    """Two cameras a base b apart: the mean of two angles gives the place across, s z / sqrt(2), their difference the
    depth, s z^2 sqrt(2) / b; the ratio is 2 z / b."""
    base, depth = 0.3, 3.0
    cameras = side_by_side(base, depth)
    made = triangulate(cameras, *seen(cameras, np.zeros((1, 3)), noise=0.0))
    sigma = np.sqrt(np.diagonal(made.covariances[0]))
    assert sigma[1] / sigma[0] == pytest.approx(2.0 * depth / base, rel=0.01)


def test_is_the_least_squares_point_through_the_lens() -> None:
    cameras, points = rig(), places(5)
    pixels, covariances = seen(cameras, points, noise=1.0)
    made = triangulate(cameras, pixels, covariances)
    for row in range(5):
        best = least_squares(
            lambda x, row=row: np.concatenate([pixels[row, c] - cameras[c].project(x) for c in range(3)]),
            points[row],
            xtol=1e-12,
        )
        np.testing.assert_allclose(made.points[row], best.x, atol=2e-5)
    np.testing.assert_allclose(made.residuals[:, 1], pixels[:, 1] - cameras[1].project(made.points), atol=1e-12)


def test_a_wrong_candidate_does_not_move_the_point() -> None:
    cameras, points = rig(), places(1000)
    pixels, covariances = seen(cameras, points)
    wrong = np.arange(1000) % 3
    rng = np.random.default_rng(5)
    pixels[np.arange(1000), wrong] += rng.uniform(30.0, 200.0, (1000, 2)) * rng.choice([-1.0, 1.0], (1000, 2))
    made = triangulate(cameras, pixels, covariances)
    found = np.isfinite(made.points).all(axis=1)
    assert found.mean() > 0.95  # in the others the wrong one agrees with one of the two right ones by chance
    assert not made.used[found, wrong[found]].any()
    assert made.used[found].sum(axis=1).min() == 2
    assert np.linalg.norm(made.points - points, axis=1)[found].max() < 0.01
    assert nees(made, points)[found].mean() == pytest.approx(3.0, abs=0.3)


def test_a_third_view_is_gated_by_the_point_s_own_uncertainty_too() -> None:
    """Two cameras side by side hardly tell the depth, which is what the third one sees: it is off by 8 px."""
    cameras, points = [*side_by_side(), looking("c", (3.0, 0.0, 0.0), (0.0, 0.0, 0.0), distortion=[])], places(300)
    points = 0.2 * (points - points.mean(axis=0))
    pixels, covariances = seen(cameras, points)
    proposed, agree, _ = _proposal(_views(cameras, pixels, covariances), 0, 1)
    off = np.linalg.norm(cameras[2].project(proposed) - pixels[:, 2], axis=1)
    assert np.median(off) > 5.0  # 17 sigma of the third view alone
    assert agree.all()  # the test refuses one right candidate in a million
    pixels[:, 2, 1] += 20.0  # across what the depth leaves open
    assert not _proposal(_views(cameras, pixels, covariances), 0, 1)[1][:, 2].any()


def test_views_may_be_missing() -> None:
    cameras, points = rig(), places(4)
    pixels, covariances = seen(cameras, points, noise=0.01)
    pixels[0, 0] = np.nan
    pixels[1, 1:] = np.nan
    pixels[2] = np.nan
    made = triangulate(cameras, pixels, covariances)
    assert np.isfinite(made.points).all(axis=1).tolist() == [True, False, False, True]
    assert made.used[0].tolist() == [False, True, True]
    assert np.isnan(made.residuals[0, 0]).all()
    assert not made.used[1:3].any()


def test_two_views_that_contradict_each_other_make_no_point() -> None:
    cameras, points = rig()[:2], places(50)
    pixels, covariances = seen(cameras, points)
    pixels[:, 0, 1] += 20.0
    assert np.isnan(triangulate(cameras, pixels, covariances).points).all()


def test_two_answers_of_two_views_each_make_no_point() -> None:
    """The third camera sees what agrees with the first at another depth: either of two may be wrong."""
    cameras, point = rig(), places(1)
    other = point + 0.2 * (point - cameras[0].centre)
    pixels, covariances = seen(cameras, point, noise=0.01)
    pixels[:, 2] = cameras[2].project(other)
    assert np.isnan(triangulate(cameras, pixels, covariances).points).all()


def test_nothing_behind_a_camera() -> None:
    cameras = [looking("a", (0.0, -3.0, 0.0), (0.0, 0.0, 0.0)), looking("b", (1.0, -3.0, 0.0), (1.0, 0.0, 0.0))]
    pixels = np.array([[[540.0, 360.0], [740.0, 360.0]]])
    made = triangulate(cameras, pixels, np.broadcast_to(np.eye(2), (1, 2, 2, 2)))
    assert np.isnan(made.points).all()


def test_parallel_rays_make_no_point() -> None:
    cameras = [looking("a", (0.0, -3.0, 0.0), (0.0, 0.0, 0.0)), looking("b", (0.1, -3.0, 0.0), (0.1, 0.0, 0.0))]
    far = np.array([[0.0, 30.0, 0.0], [0.0, 1.0, 0.0]])
    made = triangulate(cameras, *seen(cameras, far, noise=0.0))
    assert np.isfinite(made.points).all()
    made = triangulate(cameras, *seen(cameras, far, noise=0.5))
    assert np.isnan(made.points[0]).all()
    same = np.full((1, 2, 2), 300.0)
    assert np.isnan(triangulate(cameras, same, np.broadcast_to(np.eye(2), (1, 2, 2, 2))).points).all()


def test_no_points_at_all() -> None:
    made = triangulate(rig(), np.zeros((0, 3, 2)), np.zeros((0, 3, 2, 2)))
    assert made.points.shape == (0, 3)
    assert made.residuals.shape == (0, 3, 2)


def test_ten_thousand_points_at_once() -> None:
    """Each as exact as it says, and the same as in a call of its own."""
    cameras, points = rig(), places(10_000)
    pixels, covariances = seen(cameras, points)
    made = triangulate(cameras, pixels, covariances)
    assert np.isfinite(made.points).all()
    for k in (0, 4_321, 9_999):
        one = triangulate(cameras, pixels[k : k + 1], covariances[k : k + 1])
        np.testing.assert_allclose(one.points[0], made.points[k], rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("cameras", "pixels", "covariances", "message"),
    [
        (1, (5, 1, 2), (5, 1, 2, 2), "at least two"),
        (2, (5, 3, 2), (5, 3, 2, 2), "pixels must have shape"),
        (3, (5, 3, 2), (5, 3, 2), "covariances must have shape"),
        (3, (5, 3, 2), (5, 3, 2, 2), "positive definite"),
    ],
)
def test_refuses(cameras: int, pixels: tuple[int, ...], covariances: tuple[int, ...], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        triangulate(rig()[:cameras], np.full(pixels, 300.0), np.zeros(covariances))
