"""Association: from candidates with misses, clutter and a waved arm to the right balls, against planted truth."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.stats import chi2

from ballfg.vision.association.associate import AssociationSettings, associate
from ballfg.vision.association.gathering import SeenBall
from ballfg.vision.calibration.focal import pose_and_focal
from ballfg.vision.calibration.table_points import Marked, table_points
from ballfg.vision.detection.detections import Candidates, Detections
from ballfg.vision.projection import ZOOM, changed
from tests.vision.filming import CENTRES, Shot, World, film, looking, rig, shots, turned
from tests.vision.judging import judge

CAMERAS = rig()


def two_at_once(count: int, seed: int, lag: float = 0.13) -> list[Shot]:
    rng = np.random.default_rng(seed)
    second = [replace(shot, start=shot.start + lag, end=shot.end + lag) for shot in shots(count, rng)]
    return shots(count, rng) + second


@pytest.mark.parametrize(
    ("seed", "fields"),
    [
        (1, {}),
        (2, {"rates": (120.0, 120.0, 120.0), "noise": 0.4}),
        (3, {"phases": (0.0, 0.0, 0.0)}),
        (4, {"rates": (60.0, 90.0, 120.0)}),
        (5, {"rates": (240.0, 240.0, 240.0), "clutter": 3}),
    ],
)
def test_finds_the_balls_and_nothing_else(seed: int, fields: dict[str, object]) -> None:
    """NEES: about 400 points of 3 numbers each, standard deviation 0.12, and a little for shared samples."""
    world = World(two_at_once(3, seed), 3.4, seed=seed, blind={1: (1.1, 1.6)}, **fields)
    films = film(CAMERAS, world)
    balls = associate(films, CAMERAS)
    verdict = judge(balls, world, CAMERAS, films)
    assert verdict.balls == [1] * len(world.shots)
    assert (len(balls), verdict.false, verdict.mixed) == (len(world.shots), 0, 0)
    assert verdict.complete >= 0.985
    assert verdict.rmse < 0.0055 * world.noise
    assert 2.4 < verdict.nees < 3.6


def test_time_offsets_are_taken_off_the_stamps() -> None:
    world = World(two_at_once(2, 6), 2.4, seed=6)
    late = [replace(camera, time_offset=offset) for camera, offset in zip(CAMERAS, (0.0, 0.013, -2.5), strict=True)]
    films = film(late, world)
    verdict = judge(associate(films, late), world, late, films)
    assert verdict.rmse < 0.0011
    assert verdict.balls == [1, 1, 1, 1]
    sightings = associate(films, late)[0].sightings
    assert sightings.times[sightings.camera == 2].max() < 0.0  # as the camera wrote them


def test_rows_of_rolling_shutters_are_seen_one_after_the_other() -> None:
    world = World(two_at_once(2, 6), 2.4, seed=6)
    rolling = [
        replace(camera, readout=readout) for camera, readout in zip(CAMERAS, (0.014, 0.014, -0.010), strict=True)
    ]
    films = film(rolling, world)
    verdict = judge(associate(films, rolling), world, rolling, films)
    assert verdict.rmse < 0.0011
    assert (verdict.balls, verdict.false, verdict.mixed) == ([1, 1, 1, 1], 0, 0)
    assert judge(associate(films, CAMERAS), world, rolling, films).rmse > 2.0 * verdict.rmse


def test_survives_a_camera_turned_by_half_a_degree() -> None:
    world = World(two_at_once(2, 8), 2.4, seed=8)
    films = film(CAMERAS, world)
    wrong = [CAMERAS[0], turned(CAMERAS[1], 0.5, (0.6, 0.8, 0.0)), CAMERAS[2]]
    verdict = judge(associate(films, wrong), world, CAMERAS, films)
    assert verdict.balls == [1, 1, 1, 1]
    assert verdict.complete > 0.98
    assert verdict.rmse < 0.03
    assert verdict.nees < 3.0  # the covariance knows


def test_survives_covariances_that_promise_too_much() -> None:
    """Stated 0.05 px, true 0.2 px: what the rays miss each other by is taken for the calibration's error."""
    world = World(two_at_once(2, 9), 2.4, seed=9)
    films = [replace(seen, covariances=seen.covariances / 16.0) for seen in film(CAMERAS, world)]
    verdict = judge(associate(films, CAMERAS), world, CAMERAS, films)
    assert (verdict.balls, verdict.false) == ([1, 1, 1, 1], 0)
    assert verdict.complete > 0.97
    assert 1.0 < verdict.nees < 6.0


def test_same_input_same_output() -> None:
    films = film(CAMERAS, World(two_at_once(1, 2), 1.4))
    one, other = associate(films, CAMERAS), associate(films[::-1], CAMERAS)
    assert [ball.points.tobytes() for ball in one] == [ball.points.tobytes() for ball in other]
    assert [ball.sightings.pixels.tobytes() for ball in one] == [ball.sightings.pixels.tobytes() for ball in other]


def test_a_flight_through_a_blind_spot_is_one_ball_and_the_next_shot_another() -> None:
    """No camera sees anything for 0.15 s of the first flight; the second shot starts where the first ended."""
    first = Shot(0.2, 0.9, (0.1, 0.0, 1.2, 4.5, 0.2, 2.0))
    end = first.at(np.array([0.9]))[0]
    second = Shot(1.02, 1.7, (*end, -4.0, 0.1, 2.0))
    world = World([first, second], 1.9, missed=0.0, arm=False)
    films = [hidden(seen, 0.40, 0.55) for seen in film(CAMERAS, world)]
    balls = associate(films, CAMERAS)
    assert [ball.times[0] > 1.0 for ball in balls] == [False, True]
    assert np.diff(balls[0].times).max() > 0.14


def hidden(seen: Detections, start: float, end: float) -> Detections:
    return seen.select((seen.times < start) | (seen.times > end))


@pytest.mark.parametrize("apart", [0.0, 0.5, 9.0, 60.0])
def test_frames_without_a_row_count_as_those_with_a_weak_candidate(apart: float) -> None:
    """A clean detector writes nothing where there is no ball: flights some time apart are not one ball."""
    world = World(shots(3, np.random.default_rng(4)), 3.2, phases=(0.0, 0.0, 0.0), missed=0.0, clutter=0, arm=False)
    clean, weak = [], []
    for seen, more in zip(film(CAMERAS, world), film(CAMERAS, replace(world, clutter=1)), strict=True):
        stamps = seen.frames + apart * np.floor(seen.frames)
        kept, frame = np.unique(seen.frame, return_inverse=True)
        clean.append(replace(seen, frames=stamps[kept], frame=frame))
        scores = np.where(np.isin(more.pixels[:, 0], seen.pixels[:, 0]), 1.0, 0.1)
        weak.append(replace(more, frames=stamps, scores=scores))
    found, other = associate(clean, CAMERAS), associate(weak, CAMERAS)
    starts = [shot.start + apart * k for k, shot in enumerate(world.shots)]
    np.testing.assert_allclose([ball.times[0] for ball in found], starts, atol=0.02)
    assert all(np.diff(ball.times).max() < 0.02 for ball in found)
    for one, same in zip(found, other, strict=True):
        np.testing.assert_allclose(one.times, same.times, atol=1e-9)
        np.testing.assert_allclose(one.points, same.points, atol=1e-9)


def test_an_arm_is_no_ball_and_neither_is_clutter() -> None:
    films = film(CAMERAS, World([], 3.0, clutter=6))
    assert associate(films, CAMERAS) == []
    assert associate([seen.select(np.zeros(len(seen), dtype=bool)) for seen in films], CAMERAS) == []


def test_low_scores_are_not_considered() -> None:
    films = film(CAMERAS, World(shots(1, np.random.default_rng(0)), 1.2))
    low = [replace(seen, scores=np.full(len(seen), 0.2)) for seen in films]
    assert associate(low, CAMERAS) == []
    assert len(associate(low, CAMERAS, AssociationSettings(least_score=0.1))) == 1


def test_a_ball_says_what_it_is_made_of() -> None:
    films = film(CAMERAS, World(shots(1, np.random.default_rng(0)), 1.2, blind={0: (0.0, 0.5)}))
    (ball,) = associate(films, CAMERAS)
    assert isinstance(ball, SeenBall)
    assert len(ball) == len(ball.times) == len(ball.points) == len(ball.covariances) == len(ball.views)
    assert set(ball.views.tolist()) <= {2, 3}
    assert (ball.views[ball.times < 0.45] == 2).all()
    assert ball.sightings.cameras == ("left", "right", "far")
    for number, seen in enumerate(films):
        mine = ball.sightings.camera == number
        rows = np.searchsorted(seen.frames, ball.sightings.times[mine])
        np.testing.assert_array_equal(seen.frames[rows], ball.sightings.times[mine])


def test_refuses_what_does_not_go_together() -> None:
    films = film(CAMERAS, World([], 0.2))
    with pytest.raises(ValueError, match="detections must be one for each of the cameras"):
        associate(films[:2], CAMERAS)
    with pytest.raises(ValueError, match="two or more"):
        associate(films[:1], CAMERAS[:1])
    with pytest.raises(ValueError, match=r"least_score must be at least 0, at most 1; got 2"):
        AssociationSettings(least_score=2.0)
    with pytest.raises(ValueError, match="least_points must be at least 3; got 1"):
        AssociationSettings(least_points=1)


@pytest.mark.parametrize("count", [2, 3])
def test_covariances_of_points_hold_those_of_the_cameras(count: int) -> None:
    """Rigs whose places and focal lengths came from the table's corners: squares of whitened errors are of chi-square.

    The calibration is that of `pose_and_focal`, the pixels those of the true cameras.
    """
    times, squares, rng = np.arange(0.0, 0.3, 0.01), [], np.random.default_rng(0)
    points = np.column_stack((0.4 + 4.0 * times, 0.3 - times, 1.1 + 1.2 * times - 4.905 * times**2))
    corners = np.stack([table_points()[f"{end}_{side}"] for end in ("near", "far") for side in ("left", "right")])
    wide = [[800.0, 0.0, 640.0], [0.0, 800.0, 360.0], [0.0, 0.0, 1.0]]
    true = [looking(str(number), centre, matrix=wide) for number, centre in enumerate(CENTRES)]
    for _ in range(25):
        seen, cameras = [], []
        for camera in true[:count]:
            pixels = camera.project(points) + 0.1 * rng.standard_normal((len(times), 2))
            shown = [Candidates.at(pixel[None], 0.1) for pixel in pixels]
            seen.append(Detections.of_frames(camera.name, zip(times.tolist(), shown, strict=True)))
            marks = camera.project(corners) + 0.5 * rng.standard_normal((4, 2))
            lens = changed(camera, np.append(np.zeros(ZOOM), 0.05 * rng.standard_normal()))
            cameras.append(pose_and_focal(lens, Marked(tuple("abcd"), corners, marks), 0.05).camera)
        (ball,) = associate(seen, cameras)
        middle = len(ball.times) // 2
        error = ball.points[middle] - points[np.argmin(np.abs(times - ball.times[middle]))]
        squares.append(error @ np.linalg.solve(ball.covariances[middle], error))
    assert np.mean(squares) < chi2.ppf(0.999, 3 * 25) / 25
