"""The camera of rendered pictures of a table, against the truth."""

import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import COURT, looking, panned, picture
from ballfg.vision.broadcast.court import read_court
from ballfg.vision.broadcast.find import cameras_of, find_court
from ballfg.vision.broadcast.lines import moved, slopes
from ballfg.vision.broadcast.motion import find_motion, likely
from tests.vision.broadcast.tennis import TENNIS


@pytest.mark.parametrize(
    "camera",
    [looking((0.5, -8.0, 3.5), (0.0, 0.0, 0.0), 1000.0, 0.05), looking((-9.0, 0.0, 3.5), (0.5, 0.0, 0.0), 1500.0)],
    ids=["side", "behind"],
)
def test_a_panned_and_zoomed_camera_is_found(camera):
    rng = np.random.default_rng(1)
    cameras = panned(camera, 14, 0.06, -0.1)
    images = [picture(one, rng) for one in cameras]
    (shot,) = find_motion(lambda: iter([(0.04 * k, image) for k, image in enumerate(images)]), COURT, 14).shots
    assert len(shot) == 14
    for found, true, covariance in zip(shot.cameras, cameras, shot.covariances, strict=True):
        assert np.linalg.norm(found.place - true.place) < 0.02 * np.linalg.norm(true.place)
        assert found.focal == pytest.approx(true.focal, rel=0.02)
        assert np.abs(found.project(COURT.corners) - true.project(COURT.corners)).max() < 1.5
        assert (np.linalg.eigvalsh(covariance) > 0.0).all()


def test_nothing_is_made_out_of_pictures_without_a_court():
    with pytest.raises(ValueError, match="the whole court"):
        find_motion(lambda: ((0.04 * k, np.zeros((360, 640, 3), np.uint8)) for k in range(12)), COURT, 12)


LOW = looking((-6.5, 0.3, 1.4), (0.3, 0.0, 0.1), 1100.0)
"""Behind a player's end, where the table is seen at 12 degrees."""


@pytest.mark.parametrize("seed", range(4))
def test_a_camera_low_behind_the_court_is_found_from_rough_corners(seed):
    rough = LOW.project(COURT.corners) + np.random.default_rng(seed).normal(0.0, 0.7, (4, 2))
    found = [one for one in cameras_of(rough[None, ::-1], COURT, LOW.size) if one.place[2] < 2.0]
    assert min(np.linalg.norm(one.place - LOW.place) for one in found) < 0.06 * np.linalg.norm(LOW.place)
    assert min(np.abs(one.project(COURT.corners) - rough).max() for one in found) < 2.0


def test_a_camera_is_found_though_a_player_hides_a_corner():
    camera = looking((-6.5, 0.3, 1.9), (0.3, 0.0, 0.1), 1400.0)
    player = np.array([(-2.4, y, z) for y, z in ((-0.8, -0.7), (-0.35, -0.7), (-0.35, 0.55), (-0.8, 0.55))])
    image = picture(camera, np.random.default_rng(2), others=[(player, (40, 40, 190))])
    inside, corner = camera.project(player), camera.project(COURT.corners)[0]
    assert (inside.min(axis=0) + 30.0 < corner).all()
    assert (corner < inside.max(axis=0) - 30.0).all()
    (best, _), *_ = likely(image, find_court(image, COURT), COURT)
    assert np.linalg.norm(best.place - camera.place) < 0.02 * np.linalg.norm(camera.place)
    assert best.focal == pytest.approx(camera.focal, rel=0.02)


def test_derivatives_of_pixels_are_those_of_differences():
    camera, points, step = looking((1.0, -8.0, 4.0), (0.0, 0.0, 0.0), 1200.0, -0.1), COURT.corners, 1e-6
    _, slope = slopes(camera, points)
    for number in range(7):
        change = step * np.eye(7)[number]
        ahead, back = (moved(camera, way * change).project(points) for way in (1.0, -1.0))
        np.testing.assert_allclose(slope[..., number], (ahead - back) / (2.0 * step), atol=1e-5)


def test_a_tennis_court_of_a_user_gives_the_camera(tmp_path):
    (tmp_path / "tennis.yaml").write_text(TENNIS, encoding="utf-8")
    court, rng = read_court(str(tmp_path / "tennis.yaml")), np.random.default_rng(3)
    assert (court.net, court.net_reach) == (0.914, 6.4)
    cameras = panned(looking((0.5, -24.0, 9.0), (0.0, 0.0, 0.3), 800.0), 12, 0.05, 0.02)
    images = [picture(camera, rng, court=court) for camera in cameras]
    motion = find_motion(lambda: ((k / 25.0, image) for k, image in enumerate(images)), court, len(images))
    (shot,) = motion.shots
    assert np.linalg.norm(shot.cameras[-1].place - cameras[-1].place) < 0.1
    assert shot.cameras[-1].focal == pytest.approx(cameras[-1].focal, rel=0.005)
