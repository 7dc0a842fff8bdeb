"""Pictures of other sizes, and halls of other looks: the camera and the ball against what was drawn."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import COURT, ORANGE, Look, looking, panned, picture
from ballfg.vision.broadcast.candidates import aligned_candidates
from ballfg.vision.broadcast.find import find_court, joined_segments
from ballfg.vision.broadcast.motion import find_motion
from ballfg.vision.broadcast.pictures import WIDTHS, Scale
from ballfg.vision.detection.detections import Candidates, Detections

SIZES = [(640, 360), (854, 480), (1920, 1080), (3840, 2160)]


@pytest.mark.parametrize("size", SIZES)
def test_a_picture_is_searched_at_a_usual_width_with_square_pixels(size: tuple[int, int]) -> None:
    scale = Scale.of(size)
    assert WIDTHS[0] <= scale.searched[0] <= WIDTHS[1]
    assert scale.searched[1] / size[1] == pytest.approx(scale.searched[0] / size[0], rel=1e-4)


@pytest.mark.parametrize("size", [(960, 540), (1280, 720)])
def test_a_picture_of_usual_width_stays(size: tuple[int, int]) -> None:
    assert Scale.of(size) == Scale(size, size)


def test_cameras_and_detections_come_back_in_the_pixels_of_the_video() -> None:
    scale, place = Scale.of((1920, 1080)), np.array([[0.3, 0.2, 0.1]])
    true = looking((0.5, -8.0, 3.5), (0.0, 0.0, 0.0), 1900.0, size=(1920, 1080))
    searched = replace(true, focal=true.focal * scale.factor, size=scale.searched)
    back = scale.camera_of_video(searched.camera("main"))
    np.testing.assert_allclose(back.matrix, true.camera("main").matrix, rtol=1e-12)
    assert back.size == true.size
    candidates = Candidates(true.project(place), 4.0 * np.eye(2)[None], np.ones(1), np.full((1, 2, 2), np.nan))
    seen = Detections.of_frames("main", [(0.0, candidates)])
    there = scale.detections_searched(seen)
    np.testing.assert_allclose(there.pixels, searched.project(place), rtol=1e-12)
    np.testing.assert_allclose(there.covariances[0], 4.0 * scale.factor**2 * np.eye(2))
    np.testing.assert_allclose(scale.detections_of_video(there).pixels, seen.pixels, rtol=1e-12)


def test_a_small_picture_of_a_court_gives_the_camera() -> None:
    rng = np.random.default_rng(2)
    cameras = panned(looking((0.4, -8.0, 3.6), (0.0, 0.0, 0.0), 620.0, size=(640, 360)), 12, 0.02, 0.0)
    images = [picture(one, rng) for one in cameras]
    scale = Scale.of((640, 360))
    frames = scale.frames(lambda: iter([(0.04 * k, image) for k, image in enumerate(images)]))
    (shot,) = scale.motion_of_video(find_motion(frames, COURT, len(images))).shots
    for found, true in zip(shot.cameras, cameras, strict=True):
        assert np.linalg.norm(found.place - true.place) < 0.01 * np.linalg.norm(true.place)
        assert found.focal == pytest.approx(true.focal, rel=0.01)


def test_lines_wider_than_the_ground_is_looked_for_beside_narrow_ones_are_found() -> None:
    rng = np.random.default_rng(3)
    cameras = panned(looking((-6.0, -0.4, 2.6), (0.0, 0.0, 0.0), 1900.0, size=(1280, 720)), 12, 0.02, 0.0)
    images = [picture(one, rng, look=Look(half_width=0.01)) for one in cameras]
    (shot,) = find_motion(lambda: iter([(0.04 * k, image) for k, image in enumerate(images)]), COURT, 12).shots
    assert np.linalg.norm(shot.cameras[0].place - cameras[0].place) < 0.01 * np.linalg.norm(cameras[0].place)


def test_an_edge_is_found_although_something_lies_in_its_direction() -> None:
    image = np.full((360, 640, 3), 60, dtype=np.uint8)
    cv2.rectangle(image, (300, 150), (500, 160), (200, 200, 200), -1)
    cv2.rectangle(image, (170, 150), (210, 156), (150, 150, 150), -1)
    ends = np.sort(joined_segments(image)[..., 0], axis=1)
    assert (np.abs(ends - (300.0, 500.0)) < 3.0).all(axis=1).any()
    assert (np.abs(ends - (170.0, 500.0)) < 3.0).all(axis=1).any()


def test_a_focal_length_between_those_tried_first_is_found() -> None:
    camera = looking((-5.7, -5.9, 3.1), (0.0, 0.0, 0.1), 1068.0, size=(1280, 720))
    best = find_court(picture(camera, np.random.default_rng(4)), COURT)
    assert min(np.linalg.norm(one.place - camera.place) for one, _ in best) < 0.05 * np.linalg.norm(camera.place)


def test_an_orange_ball_before_a_blue_table_is_a_candidate_of_its_colour_alone() -> None:
    rng, camera = np.random.default_rng(4), looking((0.5, -8.0, 3.5), (0.0, 0.0, 0.0), 1000.0)
    look = Look(ball=ORANGE)
    places = [np.array([[-0.6 + 0.36 * (k + share), 0.1, 0.1] for share in (-0.2, 0.2)]) for k in range(5)]
    window = [picture(camera, rng, [place], look=look) for place in places]
    window = [np.asarray(cv2.cvtColor(one, cv2.COLOR_BGR2BGRA), dtype=np.uint8) for one in window]
    true = camera.project(places[2]).mean(axis=0)
    far = {}
    for colour in ("white", "orange"):
        found = aligned_candidates(window, 2, (camera,) * 5, np.array([3.0, 8.0]), colour=colour)
        far[colour] = np.linalg.norm(found.pixels - true, axis=1).min(initial=np.inf)
    assert far["orange"] < 1.0
    assert far["white"] > 5.0
