"""Time offsets of cameras: a planted 4 ms come back, with an honest sigma; stamps move; what tells none is refused."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.online.online import Online
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.estimation.smoother.time_offsets import estimate_time_offsets
from ballfg.tracks import Track
from tests.estimation.observations.sighted_rig import RIG, World, late, scene, track_of, world

TRUE = np.array([0.0, 0.004, -0.0015])
"""s, by which the cameras' stamps are late while they are taken to be right."""


@pytest.fixture(scope="module")
def ball() -> World:
    return world()


def unsuspecting(seed: int, ball: World) -> Track:
    """A flight whose stamps are late, in the hands of who does not know it."""
    return track_of(scene(seed, ball, rig=late(TRUE), duration=0.4), str(seed), RIG)


def test_a_track_finds_its_offsets_and_moves_its_stamps(ball: World) -> None:
    settings = Settings(time_offsets={"right": 0.01, "back": 0.01})
    made = scene(0, ball, rig=late(TRUE), duration=0.4)
    estimate = Smoother(ball.model, ball.surfaces, settings).estimate(track_of(made, cameras=RIG))
    assert estimate.status is Status.OK
    assert estimate.unknown_names == ("time_offset.right", "time_offset.back")
    error = estimate.unknowns - TRUE[1:]
    assert np.abs(error).max() < 2e-4
    sigma = np.sqrt(np.diagonal(estimate.unknown_covariance))
    assert (np.abs(error) < 3.0 * sigma).all()
    assert (sigma < 1.5e-4).all()
    assert estimate.coefficient_names == ()
    assert estimate.cross_covariances.shape == (len(estimate.times), 9, 0)
    stamps = made.sightings.times - np.append(0.0, estimate.unknowns)[made.sightings.camera]
    np.testing.assert_allclose(estimate.times, np.sort(stamps), atol=2e-5)
    velocity = (estimate.states - made.truth)[np.argsort(stamps), 3:6]
    assert np.median(np.linalg.norm(velocity, axis=1)) < 0.02


def test_a_recording_finds_offsets_to_a_tenth_of_a_millisecond(ball: World) -> None:
    found = estimate_time_offsets([unsuspecting(k, ball) for k in (1, 2)], ball.model, ball.surfaces, Settings())
    assert found.settled
    assert found.tracks == 2
    error = (found.offsets - TRUE)[1:]
    assert np.abs(error).max() < 1e-4
    assert (np.abs(error) < 3.0 * found.sigmas[1:]).all()
    assert (found.sigmas[1:] < 8e-5).all()
    assert [camera.name for camera in found.cameras] == ["left", "right", "back"]


def test_another_reference_shifts_them_all(ball: World) -> None:
    """Flights look the same a little later: what is told is the offsets' differences."""
    tracks = [unsuspecting(3, ball)]
    about = [estimate_time_offsets(tracks, ball.model, ball.surfaces, Settings(), name) for name in ("left", "right")]
    apart = [found.offsets - found.offsets[0] for found in about]
    assert about[1].offsets[1] == 0.0
    np.testing.assert_allclose(apart[0], apart[1], atol=1e-5)


def moved_by(track: Track, offsets: tuple[float, ...]) -> Track:
    return sightings_of(track).with_offsets(track, np.array(offsets))


def test_offsets_follow_the_coefficients_of_the_ball(ball: World) -> None:
    settings = Settings(coefficients={"flight.drag.k": 0.02}, time_offsets={"back": 0.01})
    track = moved_by(unsuspecting(4, ball), (0.0, 0.0, 0.002))
    problem = Smoother(ball.model, ball.surfaces, settings).problem(track)
    assert (problem.ball.names, problem.width) == (("flight.drag.k",), 1)
    assert problem.unknowns.names == ("time_offset.back",)
    assert problem.unknowns.means == [-0.002]  # believed where it was before the track was moved
    assert problem.unknowns.origins == [0.002]
    np.testing.assert_allclose(sightings_of(track).moved, [0.0, 0.0, 0.002])
    np.testing.assert_allclose(problem.coefficient_sigmas, [0.02, 0.01])
    with pytest.raises(ValueError, match="must name cameras of the track, left, right, back; got 'top'"):
        Smoother(ball.model, ball.surfaces, Settings(time_offsets={"top": 0.01})).problem(track)


def test_refuses_what_tells_no_offset(ball: World) -> None:
    track = track_of(scene(5, ball, duration=0.2))
    with pytest.raises(ValueError, match="tracks must hold at least one"):
        estimate_time_offsets([], ball.model, ball.surfaces, Settings())
    with pytest.raises(ValueError, match="reference must be one of the cameras left, right, back; got 'top'"):
        estimate_time_offsets([track], ball.model, ball.surfaces, Settings(), "top")
    other = moved_by(track, (0.0, 0.001, 0.0))
    with pytest.raises(ValueError, match="seen by the same cameras"):
        estimate_time_offsets([track, other], ball.model, ball.surfaces, Settings())
    with pytest.raises(ValueError, match="cannot move stamps that have passed"):
        Online(ball.model, ball.surfaces, Settings(time_offsets={"right": 0.01}))
    with pytest.raises(ValueError, match=r"time_offsets\['right'\] must be at least 1e-12, at most 1e\+09; got 0"):
        Settings(time_offsets={"right": 0.0})
