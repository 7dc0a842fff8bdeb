"""The cameras' benchmark on recordings that nobody had to draw: candidates made from the truth."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from ballfg.benchmarks.cameras.clocks import FACTORS, NAIVE, clocks, compare
from ballfg.benchmarks.cameras.scenes import Filmed, Scenario, judge, scenarios, truth_at
from ballfg.benchmarks.cameras.suite import TURN, add_clocks, add_points, add_turns, add_velocities, turned, turns
from ballfg.benchmarks.results import Results
from ballfg.simulation.scene.config import Clock
from ballfg.simulation.scene.recording import Recording
from ballfg.vision import Detections
from ballfg.vision.tracking.pipeline import track_detections

NOISE = 0.1
"""px"""


def seen(recording: Recording, number: int) -> Detections:
    """What a detector without a fault would see."""
    rng = np.random.default_rng(number)
    camera, frames = recording.cameras[number], recording.frames[number]
    middle = recording.passages[number][0].paths.shape[1] // 2
    frame = np.concatenate([p.frames for p in recording.passages[number]])
    pixels = np.concatenate([camera.project(p.paths[:, middle]) for p in recording.passages[number]])
    order = np.argsort(frame, kind="stable")
    frame, pixels = frame[order], pixels[order] + NOISE * rng.standard_normal(pixels.shape)
    count = len(frame)
    covariances = np.broadcast_to(NOISE**2 * np.eye(2), (count, 2, 2))
    streaks = np.full((count, 2, 2), np.nan)
    return Detections(camera.name, frames.stamps, frame, pixels, covariances, np.ones(count), streaks)


def filmed(scenario: Scenario) -> Filmed:
    recording = scenario.recording()
    detections = tuple(seen(recording, number) for number in range(len(recording.cameras)))
    return Filmed(scenario, recording, detections, track_detections(detections, recording.cameras))


@pytest.fixture(scope="module")
def together() -> Filmed:
    return filmed(scenarios(2, 0)[0])


@pytest.fixture(scope="module")
def apart() -> Filmed:
    return filmed(scenarios(2, 0)[1])


def test_points_are_judged_against_the_truth(together) -> None:
    found = judge(together)
    assert found.false == 0
    assert found.found / found.seen > 0.98
    assert found.tracks == found.balls == 2
    assert 1e-4 < found.rmse < 1e-3
    assert 2.0 < found.squares.mean() < 4.0
    results = Results("cameras", 0)
    add_points(results, "seen", found)
    assert results.value("rendered scenes", "seen", "position_rmse") == pytest.approx(1e3 * found.rmse)


def test_a_point_beside_every_ball_is_false_and_a_frame_without_a_point_is_missing(together) -> None:
    ball = together.tracking.balls[0]
    points = ball.points.copy()
    points[3] += (0.0, 0.3, 0.0)
    moved = replace(ball, points=points)
    balls = (moved, *together.tracking.balls[1:])
    found, before = judge(replace(together, tracking=replace(together.tracking, balls=balls))), judge(together)
    assert found.false == 1
    assert found.found == before.found - 1
    assert found.seen == before.seen


def test_tracks_of_two_balls_and_no_track_at_all_are_told(together) -> None:
    first, second = together.tracking.balls
    half = len(first) // 2
    grafted = replace(
        first,
        times=np.concatenate((first.times[:half], second.times[half:])),
        points=np.concatenate((first.points[:half], second.points[half:])),
        covariances=np.concatenate((first.covariances[:half], second.covariances[half:])),
        views=np.concatenate((first.views[:half], second.views[half:])),
    )
    assert judge(together).mixed == 0
    assert judge(replace(together, tracking=replace(together.tracking, balls=(grafted, second)))).mixed == 1
    nothing = judge(replace(together, tracking=replace(together.tracking, balls=())))
    assert (nothing.found, nothing.tracks, len(nothing.errors)) == (0, 0, 0)
    assert nothing.seen == judge(together).seen


def test_truth_ends_with_the_flight(together) -> None:
    flight = together.recording.flights[0]
    states = truth_at(flight, np.array([flight.start - 0.01, flight.start, flight.end + 0.01]))
    np.testing.assert_array_equal(np.isnan(states).all(axis=1), [True, False, True])
    np.testing.assert_allclose(states[1], flight.knots[0])


@pytest.mark.thorough
def test_camera_factors_beat_what_pretends_to_be_synchronised(apart) -> None:
    found = compare(apart)
    results = Results("cameras", 0)
    add_velocities(results, found, 0)
    share = results.value("unsynchronised", f"{FACTORS} / {NAIVE}", "velocity_rmse")
    assert share is not None
    assert share < 0.25
    assert (found[FACTORS].counts > 0).all()
    assert results.value("unsynchronised", FACTORS, "states") == found[FACTORS].counts.sum()


def test_late_clock_is_found(apart) -> None:
    late = replace(apart.scenario, config=replace(apart.scenario.config, clocks={"right": Clock(offset=0.004)}))
    seen = filmed(late)
    np.testing.assert_allclose(clocks(seen).offsets, [0.0, 0.004, 0.0], atol=1e-4)
    results = Results("cameras", 0)
    add_clocks(results, [seen])
    errors = [results.value("time offset", row, "largest_error") for row in ("right, late by 4 ms", "far, on time")]
    assert all(error is not None and 0.0 < error < 0.1 for error in errors)


def test_turned_camera_stands_where_it_stood(together) -> None:
    camera = together.recording.cameras[1]
    for axis in range(3):
        other = turned(camera, axis)
        np.testing.assert_allclose(other.centre, camera.centre, atol=1e-12)
        cosine = (np.trace(other.rotation @ camera.rotation.T) - 1.0) / 2.0
        assert np.degrees(np.arccos(cosine)) == pytest.approx(TURN, rel=1e-6)


def test_turned_cameras_are_named(together) -> None:
    found = list(turns(together))
    assert len(found) == 9
    assert [turn.named for turn in found] == [turn.camera for turn in found]
    assert max(abs(turn.found - TURN) for turn in found) < 0.1
    results = Results("cameras", 0)
    add_turns(results, found, together)
    assert results.value("no camera turned", "agreement", "named") == 0.0
    assert results.value("a camera turned by 0.5 degrees", "agreement", "named") == 1.0
