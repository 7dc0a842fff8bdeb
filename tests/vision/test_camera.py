"""Cameras: torch's projection against OpenCV's, rays against projection, derivatives against differences."""

import cv2
import numpy as np
import pytest
import torch

from ballfg.vision import Camera
from ballfg.vision.projection import CameraBank

DISTORTIONS = {
    0: [],
    4: [-0.2, 0.05, 0.001, -0.002],
    5: [-0.2, 0.05, 0.001, -0.002, 0.01],
    8: [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003],
    12: [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003, 0.001, -0.002, 0.0015, 0.0005],
    14: [-0.2, 0.05, 0.001, -0.002, 0.01, 0.02, -0.01, 0.003, 0.001, -0.002, 0.0015, 0.0005, 0.02, -0.03],
}


def camera(count: int = 5, **changes: object) -> Camera:
    fields = {
        "name": "left",
        "size": (1280, 720),
        "matrix": [[1000.0, 0, 640.0], [0, 1010.0, 350.0], [0, 0, 1]],
        "distortion": DISTORTIONS[count],
        "rvec": [1.2, -0.9, 0.7],
        "tvec": [0.1, 0.3, 3.0],
    }
    return Camera(**(fields | changes))


def points(camera: Camera, n: int = 200) -> np.ndarray:
    rng = np.random.default_rng(0)
    local = np.column_stack((rng.uniform(-1.2, 1.2, (n, 2)), rng.uniform(2.0, 5.0, n)))
    return (local - camera.tvec) @ camera.rotation


@pytest.mark.parametrize("count", list(DISTORTIONS))
def test_torch_projects_as_opencv(count: int) -> None:
    bent = camera(count)
    bank = CameraBank([camera(0, name="other", tvec=[0, 0, 5.0]), bent])
    world = points(bent)
    opencv, _ = cv2.projectPoints(world, bent.rvec, bent.tvec, bent.matrix, bent.distortion)
    number = torch.ones(len(world), dtype=torch.int64)
    np.testing.assert_allclose(bank.project(torch.from_numpy(world), number).numpy(), opencv[:, 0], atol=1e-9)


@pytest.mark.parametrize("count", list(DISTORTIONS))
def test_rays_lead_to_what_was_projected(count: int) -> None:
    bent = camera(count)
    world = points(bent)
    rays = bent.rays(bent.project(world))
    towards = world - bent.centre
    towards /= np.linalg.norm(towards, axis=1, keepdims=True)
    np.testing.assert_allclose(rays, towards, atol=1e-9)


@pytest.mark.parametrize("count", list(DISTORTIONS))
def test_jacobian_agrees_with_autograd_and_differences_of_opencv(count: int) -> None:
    bent = camera(count)
    bank = CameraBank([camera(0, name="other", tvec=[0, 0, 5.0]), bent])
    world, number = points(bent, 20), np.ones(20, dtype=np.int64)
    pixels, jacobian = bank.jacobian(world, number)
    place = torch.from_numpy(world).requires_grad_()
    seen = bank.project(place, torch.from_numpy(number))
    np.testing.assert_allclose(pixels, seen.detach().numpy(), rtol=1e-12)
    for axis in range(2):
        (slope,) = torch.autograd.grad(seen[:, axis].sum(), place, retain_graph=True)
        np.testing.assert_allclose(jacobian[:, axis], slope.numpy(), rtol=1e-9, atol=1e-9)
    for axis in range(3):
        step = np.eye(3)[axis] * 1e-5
        slope = (bent.project(world + step) - bent.project(world - step)) / 2e-5
        np.testing.assert_allclose(jacobian[..., axis], slope, rtol=1e-6, atol=1e-5)


def test_what_is_behind_the_camera_is_not_seen() -> None:
    bent = camera()
    behind = bent.centre - bent.rotation[2]
    assert np.isnan(bent.project(behind)).all()
    assert not bent.in_view(behind)
    bank = CameraBank([bent])
    assert bank.project(torch.from_numpy(behind)[None], torch.zeros(1, dtype=torch.int64)).isnan().all()
    assert all(np.isnan(found).all() for found in bank.jacobian(behind[None], np.zeros(1, dtype=np.int64)))


def test_view_ends_at_the_image() -> None:
    plain = camera(0)
    rays = plain.rays([[-0.4, 0.0], [-0.6, 0.0], [1279.4, 719.4], [1279.6, 719.0]])
    assert plain.in_view(plain.centre + 2.0 * rays).tolist() == [True, False, True, False]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"matrix": np.eye(2)}, "camera 'left': matrix must have shape"),
        ({"matrix": [[1000, 0, 640], [0, -1000, 360], [0, 0, 1]]}, "fx, fy > 0"),
        ({"distortion": [0.1, 0.2, 0.3]}, "distortion must have one of 0, 4, 5, 8, 12, 14 coefficients; got 3"),
        ({"rvec": [0, 0, np.nan]}, "rvec must be finite"),
        ({"tvec": "here"}, "tvec must be an array of numbers"),
        ({"size": (0, 720)}, "size must be width and height in pixels; got .*Correct it."),
        ({"name": " "}, "printable text"),
        ({"time_offset": np.inf}, "time_offset must be finite"),
        ({"time_offset": 1e12}, "time_offset must be in s"),
        ({"readout": 16.0}, "readout must be -0.1 to 0.1 s; got 16. It is shorter than a frame; give seconds."),
        ({"exposure": -0.01}, "exposure must be 0 to 0.1 s; got -0.01. It is shorter than a frame; give seconds."),
        ({"covariance": np.eye(6)}, "covariance must have shape"),
        ({"covariance": -np.eye(7)}, "covariance must be symmetric and positive definite"),
    ],
)
def test_refuses(changes: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message.replace("(", r"\(")):
        camera(**changes)


def test_rows_of_a_rolling_shutter_are_seen_one_after_the_other() -> None:
    rows = np.array([[10.0, 0.0], [900.0, 359.5], [500.0, 719.0]])
    rolling = camera(0, readout=0.01, time_offset=0.1)
    np.testing.assert_allclose(
        rolling.true_times(np.array([1.0, 1.0, 2.0]), rows), [0.895 + 0.005 / 720, 0.9, 1.905 - 0.005 / 720], atol=1e-15
    )
    upwards = camera(0, readout=-0.01)
    assert np.all(np.diff(upwards.true_times(np.ones(3), rows)) < 0.0)
    assert np.array_equal(camera(0, time_offset=0.1).true_times(np.ones(3), rows), np.ones(3) - 0.1)


def test_what_lies_beyond_where_the_lens_turns_back_is_not_seen() -> None:
    barrel = camera(4, distortion=[-0.3, 0.0, 0.0, 0.0])  # r (1 - 0.3 r^2) is highest at r = 1 / sqrt(0.9)
    assert barrel.widest == pytest.approx(1.0 / np.sqrt(0.9), abs=2e-3)
    assert camera(0).widest == np.inf
    rays = np.array([[0.9, 0.0, 1.0], [1.6, 0.0, 1.0], [0.0, -1.9, 1.0]]) @ barrel.rotation
    seen = barrel.project(barrel.centre + 2.0 * rays)
    assert np.isfinite(seen).all(axis=1).tolist() == [True, False, False]
    assert barrel.in_view(barrel.centre + 2.0 * rays).tolist() == [False, False, False]
    torch_seen = CameraBank([barrel]).project(
        torch.from_numpy(barrel.centre + 2.0 * rays), torch.zeros(3, dtype=torch.int64)
    )
    np.testing.assert_allclose(torch_seen.numpy(), seen, atol=1e-9)
