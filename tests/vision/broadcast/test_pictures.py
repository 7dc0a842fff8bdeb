"""Candidates and background matches in drawn pictures, and what is refused or split, against what was drawn."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import COURT, SIZE, looking, panned, picture
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.background import matched
from ballfg.vision.broadcast.candidates import aligned_candidates, find_candidates
from ballfg.vision.broadcast.motion import Shot, find_motion
from ballfg.vision.broadcast.pinhole import Pinhole
from tests.commands import printed

SIDE = looking((0.5, -8.0, 3.5), (0.0, 0.0, 0.0), 1000.0)
RADIUS, LIMITS = 0.02, np.array([3.0, 8.0])  # m; px, diameters of a ball


def flown(number: int) -> np.ndarray:
    """(2, 3) m, the ends of a bar in a picture: 9 m/s to the right, 0.4 of the time between pictures."""
    return np.array([[-1.0 + 0.36 * (number + share), 0.1, 0.35] for share in (-0.2, 0.2)])


@pytest.mark.parametrize("turn", [0.0, 0.05], ids=["still", "panned"])
def test_a_flying_ball_is_a_candidate_with_the_ends_of_its_bar(turn: float) -> None:
    rng = np.random.default_rng(4)
    cameras = panned(SIDE, 5, turn, 0.0)
    window = [picture(camera, rng, [flown(k)]) for k, camera in enumerate(cameras)]
    found = aligned_candidates(window, 2, tuple(cameras), LIMITS)
    ends = cameras[2].project(flown(2))
    off = np.linalg.norm(found.pixels - ends.mean(axis=0), axis=1)
    best = int(np.argmin(off))
    assert off[best] < 1.0
    assert found.scores[best] >= np.sort(found.scores)[-3:].min()
    length = np.linalg.norm(found.streaks[best, 1] - found.streaks[best, 0])
    assert length == pytest.approx(np.linalg.norm(ends[1] - ends[0]), rel=0.25)
    along = found.streaks[best, 1] - found.streaks[best, 0]
    assert abs(along @ (ends[1] - ends[0])) > 0.97 * length * np.linalg.norm(ends[1] - ends[0])


def test_pictures_without_a_ball_have_few_candidates() -> None:
    rng, cameras = np.random.default_rng(5), tuple(panned(SIDE, 9, 0.04, 0.02))
    images = [picture(camera, rng) for camera in cameras]
    shot = Shot(0, cameras, np.tile(1e-6 * np.eye(7), (9, 1, 1)), np.ones(9))
    found = find_candidates(lambda: iter(enumerate(images)), shot, COURT, RADIUS, 0.04 * np.arange(9.0))
    assert len(found) / 9 < 20.0


def test_the_background_moves_by_the_cameras_homography() -> None:
    rng, (one, other) = np.random.default_rng(6), panned(SIDE, 2, 0.03, 0.02)
    before, now = (cv2.cvtColor(picture(camera, rng), cv2.COLOR_BGR2GRAY) for camera in (one, other))
    match = matched(np.asarray(before, dtype=np.uint8), np.asarray(now, dtype=np.uint8))
    assert match is not None
    assert np.median(np.linalg.norm(one.onto(match.before, other) - match.now, axis=1)) < 0.3
    noise = np.asarray(rng.integers(0, 255, (540, 960)), dtype=np.uint8)
    assert matched(np.asarray(before, dtype=np.uint8), noise) is None


def test_a_cut_in_the_middle_splits_the_recording_into_shots() -> None:
    rng = np.random.default_rng(7)
    behind = looking((-9.0, 0.0, 3.5), (0.5, 0.0, 0.0), 1500.0)
    cameras = [*panned(SIDE, 12, 0.02, 0.0), *panned(behind, 12, 0.01, 0.0)]
    images = [picture(camera, rng) for camera in cameras]
    motion = find_motion(lambda: iter([(0.04 * k, image) for k, image in enumerate(images)]), COURT, 24)
    assert motion.cuts == (12,)
    assert [(shot.first, len(shot)) for shot in motion.shots] == [(0, 12), (12, 12)]
    for shot, true in zip(motion.shots, (cameras[0], cameras[12]), strict=True):
        assert np.linalg.norm(shot.cameras[0].place - true.place) < 0.03 * np.linalg.norm(true.place)


def scenes(count: int) -> list[Image]:
    rng = np.random.default_rng(8)
    return [picture(camera, rng) for camera in panned(SIDE, count, 0.01, 0.0)]


def turned() -> list[Image]:
    return [np.ascontiguousarray(np.rot90(image)) for image in scenes(12)]


def black() -> list[Image]:
    return [np.zeros((SIZE[1], SIZE[0], 3), dtype=np.uint8)] * 12


def near() -> list[Image]:
    """A close-up of a player's end: the other half of the table is beyond the picture."""
    rng, camera = np.random.default_rng(11), looking((1.5, -5.0, 1.5), (1.8, 0.0, 0.1), 1800.0)
    return [picture(one, rng) for one in panned(camera, 12, 0.01, 0.0)]


def hall() -> list[Image]:
    """Bright shapes that move a little, without a table."""
    rng = np.random.default_rng(9)
    base = np.asarray(cv2.resize(rng.integers(0, 255, (27, 48, 3)).astype(np.uint8), SIZE), dtype=np.uint8)
    return [np.roll(base, 2 * k, axis=1) for k in range(12)]


@pytest.mark.parametrize(
    ("images", "message"),
    [
        (black, "must show the whole court"),
        (turned, "must show the whole court"),
        (hall, "must show the whole court"),
        (near, "must show the whole court"),
        (lambda: scenes(5), "10 pictures in a row"),
        (lambda: scenes(14), "must show strokes of a ball"),
    ],
    ids=["black", "turned", "no table", "close-up", "five pictures", "no ball"],
)
def test_a_video_without_a_rally_is_refused_in_one_line_and_nothing_is_written(
    images: Callable[[], Sequence[Image]], message: str, tmp_path: Path
) -> None:
    path, shown = tmp_path / "a.mp4", images()
    size = (shown[0].shape[1], shown[0].shape[0])
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, size)
    for image in shown:
        writer.write(image)
    writer.release()
    said = [
        line
        for line in printed("track", path, "--out", tmp_path / "rally", status=2).err.splitlines()
        if not line.startswith(("note: ", "ballfg track: "))
    ]
    assert len(said) == 1
    assert message in said[0]
    assert [one.name for one in tmp_path.iterdir()] == ["a.mp4"]


def travelled(count: int, step: float) -> tuple[list[Pinhole], list[Image]]:
    """Cameras that go to the left, m a picture, and turn, and what they see of a hall with walls and letters."""
    rng = np.random.default_rng(9)
    turned = panned(SIDE, count, 0.03, 0.0)
    cameras = [replace(one, place=one.place - [step * k, 0.0, 0.0]) for k, one in enumerate(turned)]
    return cameras, [picture(camera, rng) for camera in cameras]


@pytest.mark.parametrize("step", [0.0, 0.012])
def test_a_camera_that_moves_has_a_place_in_each_picture_and_one_that_stands_has_not(step: float) -> None:
    cameras, images = travelled(30, step)
    (shot,) = find_motion(lambda: iter([(0.04 * k, image) for k, image in enumerate(images)]), COURT, 30).shots
    assert (shot.near > 0.0) == (shot.shifts is not None) == (step > 0.0)
    off = np.array([one.place - true.place for one, true in zip(shot.cameras, cameras, strict=True)])
    assert np.linalg.norm(off, axis=1).max() < 0.03 * np.linalg.norm(cameras[0].place)
    if step:
        along = np.array([one.place[0] for one in shot.cameras])
        assert along[0] - along[-1] == pytest.approx(29 * step, rel=0.1)


def test_a_background_of_known_distance_is_seen_from_another_place() -> None:
    cameras, _ = travelled(2, 0.3)
    pixels, far = np.array([[100.0, 80.0], [700.0, 400.0], [480.0, 270.0]]), 8.0
    points = cameras[0].place + far * cameras[0].directions(pixels) @ cameras[0].turn
    np.testing.assert_allclose(cameras[0].onto(pixels, cameras[1], 1.0 / far), cameras[1].project(points), atol=1e-9)
