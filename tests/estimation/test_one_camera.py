"""Strokes from one camera: rallies cut at their hits, states against the truth, and clutter that is none."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
import torch

from ballfg.dynamics import Surfaces
from ballfg.dynamics.motion.rollout import rollout
from ballfg.estimation import Status
from ballfg.estimation.observations.sightings import sighted_track
from ballfg.estimation.one_camera import Strokes, track_one_camera
from ballfg.estimation.rally.arcs import BENT, CARRIED, MOSTLY, arcs, telling
from ballfg.estimation.rally.field import FLATTEST, Field, at_court, without_lens
from ballfg.estimation.rally.reconstruct import search
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Candidates, Detections
from tests.estimation.observations.sighted_rig import TABLE, World, looking, world

RATE, NOISE = 50.0, 0.5
SIDE = looking("side", (-0.2, -4.0, 2.2))
HITS = (0.0, 0.62, 1.22, 1.84)
"""s, at which the ball is hit; the last one ends the rally."""


@pytest.fixture(scope="module")
def ball() -> World:
    made = world()
    return made._replace(surfaces=replace(made.surfaces, extent=(-1.37, 1.37, -0.76, 0.76)))


def rally(ball: World, hits: Sequence[float] = HITS) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s and states (n, 9) of strokes to and fro, each with a bounce, between hits at times, s."""
    state, times, states = np.array([-1.3, -0.2, TABLE + 0.25, 4.5, 0.2, 0.6, 0.0, 60.0, 0.0]), [], []
    for number, (start, end) in enumerate(pairwise(hits)):
        stamps = np.arange(np.ceil(start * RATE), np.ceil(end * RATE)) / RATE
        since = torch.from_numpy(np.append(np.append(0.0, stamps - start), end - start))
        with torch.no_grad():
            path = rollout(ball.model, torch.from_numpy(state[None]), since, ball.surfaces)[0].numpy()
        times.append(stamps)
        states.append(path[1:-1])
        to = 1.0 if number % 2 else -1.0
        state = np.concatenate((path[-1, :3], [4.6 * to, 0.15, 1.2, 0.0, 50.0 * to, 0.0]))
    return np.concatenate(times), np.concatenate(states)


def seen(times: np.ndarray, states: np.ndarray, seed: int, hidden: float = 0.05, camera: Camera = SIDE) -> Detections:
    """The ball in most frames, two wrong candidates in each, and a light that glides through the picture."""
    rng, frames = np.random.default_rng(seed), []
    pixels = camera.project(states[:, :3]) + NOISE * rng.standard_normal((len(times), 2))
    numbers = {round(t * RATE): row for row, t in enumerate(times)}
    for frame in range(max(numbers) + 21):
        found, scores = [*rng.uniform((0, 0), camera.size, (2, 2))], [0.35, 0.4]
        found.append(np.array([100.0 + 3.0 * frame, 600.0]) + NOISE * rng.standard_normal(2))
        scores.append(0.5)
        if frame in numbers and rng.uniform() > hidden:
            found.append(pixels[numbers[frame]])
            scores.append(0.9)
        frames.append((100.0 + frame / RATE, Candidates.at(np.array(found), NOISE, scores)))
    return Detections.of_frames("side", frames)


def judged(strokes: Strokes, times: np.ndarray, states: np.ndarray) -> list[float]:
    """m, the root mean square error of each stroke."""
    errors = []
    for estimate in strokes.estimates:
        rows = np.searchsorted(times, estimate.times - 100.0 - 1e-6)
        errors.append(float(np.sqrt(((estimate.states[:, :3] - states[rows, :3]) ** 2).sum(axis=1).mean())))
    return errors


def test_a_rally_is_cut_at_its_hits(ball: World) -> None:
    times, states = rally(ball)
    strokes = track_one_camera(seen(times, states, 3), SIDE, ball.model, ball.surfaces)
    assert strokes.tracking.names == ["000", "001", "002"]
    assert [estimate.name for estimate in strokes.estimates] == strokes.tracking.names
    for estimate, begin, end in zip(strokes.estimates, HITS, HITS[1:], strict=False):
        assert estimate.times[0] - 100.0 == pytest.approx(begin, abs=0.1)
        assert estimate.times[-1] - 100.0 == pytest.approx(end, abs=0.1)
        assert len(estimate.contacts) in (1, 2)
    assert max(judged(strokes, times, states)) < 0.08
    assert strokes.doubts == []
    first, *others = strokes.estimates
    unsure = replace(strokes, estimates=(replace(first, status=Status.NOT_CONVERGED), *others))
    assert unsure.doubts == [f"track 000: {Status.NOT_CONVERGED.value}"]
    ball_one = strokes.tracking.balls[0]
    np.testing.assert_array_equal(ball_one.points, strokes.estimates[0].states[:, :3])
    assert strokes.tracking.seen(ball_one, 0)[0][0] == pytest.approx(HITS[0] * RATE, abs=5)


def test_what_does_not_fall_is_no_ball(ball: World) -> None:
    times, states = rally(ball)
    empty = seen(times, states, 4, hidden=1.1)
    assert track_one_camera(empty, SIDE, ball.model, ball.surfaces).estimates == ()


@pytest.mark.parametrize("sized", [False, True])
def test_a_shoe_that_sways_is_no_ball(ball: World, sized: bool) -> None:
    """It moves as smoothly as a ball, and one near the camera that lift carries might move so; three times as large."""
    times, states = rally(ball)
    found, rng = seen(times, states, 6), np.random.default_rng(6)
    t = found.frames - 100.0
    place = np.stack(
        [np.full_like(t, 2.3), 0.35 * np.sin(2.0 * t) + 0.1 * np.sin(7.0 * t), np.full_like(t, 0.05)], axis=1
    )
    shoe = SIDE.project(place) + NOISE * rng.standard_normal((len(t), 2))
    parts = [found.in_frame(number) for number in range(len(t))]
    both = [
        (frame, Candidates.at(np.vstack((one.pixels, pixel)), NOISE, [*one.scores, 0.8]))
        for frame, one, pixel in zip(found.frames.tolist(), parts, shoe, strict=True)
    ]
    seen_both = Detections.of_frames("side", both)
    if sized:
        mine, other = (np.isclose(seen_both.scores, score) for score in (0.9, 0.8))
        radii = np.tile([0.0, 1.0], (len(seen_both), 1))
        row = np.minimum(np.searchsorted(times, seen_both.times - 100.0 - 1e-6), len(times) - 1)
        for where, points, large in ((mine, states[row, :3], 1.1), (other, place[seen_both.frame], 3.3)):
            depth = points[where] @ SIDE.rotation[2] + SIDE.tvec[2]
            radii[where] = (large * 1000.0 * ball.model.radius / depth)[:, None] * [1.0, 0.02]
        seen_both = replace(seen_both, radii=radii)
    strokes = track_one_camera(seen_both, SIDE, ball.model, ball.surfaces)
    assert len(strokes.estimates) == 3
    assert max(judged(strokes, times, states)) < 0.08


@pytest.mark.thorough
def test_how_far_away_a_lob_without_a_bounce_was_is_told_by_its_radius(ball: World) -> None:
    """Radii are all measured a tenth too large, as those of the strokes with a bounce show."""
    hits = (*HITS, 2.44, 3.06, 3.66)
    times, states = rally(ball, hits)
    lob, start = np.arange(4.4, 5.0, 1.0 / RATE), np.array([-0.8, 0.2, TABLE + 0.3, 2.5, 0.1, 3.2, 0.0, 60.0, 0.0])
    with torch.no_grad():
        path = rollout(ball.model, torch.from_numpy(start[None]), torch.from_numpy(lob - 4.4), ball.surfaces)[0].numpy()
    times, states = np.append(times, lob), np.vstack((states, path))
    found, rng = seen(times, states, 3, hidden=0.0), np.random.default_rng(8)
    balls = np.flatnonzero(np.isclose(found.scores, 0.9))
    depth = states[:, :3] @ SIDE.rotation[2] + SIDE.tvec[2]
    radii, true = np.tile([0.0, 1.0], (len(found), 1)), 1000.0 * ball.model.radius / depth
    large = 1.1 * np.exp(0.03 * rng.standard_normal(len(balls)))
    radii[balls] = np.stack((true * large, 0.02 * true), axis=1)
    for known in (radii, np.zeros((0, 2))):
        strokes = track_one_camera(replace(found, radii=known), SIDE, ball.model, ball.surfaces)
        assert len(strokes.estimates) == (7 if len(known) else 6)
        assert max(judged(strokes, times, states)) < 0.15
        assert all(one.status is Status.OK for one in strokes.estimates)
        sized = [one.sightings.radii is not None for one in strokes.tracking.balls]
        assert sized == [len(known) > 0] * len(sized)


def test_a_light_without_streaks_does_not_hide_those_of_the_ball(ball: World) -> None:
    """The share of the time for which the shutter is open is that of the ball's streaks."""
    times, states = rally(ball)
    found, share = seen(times, states, 3, hidden=0.0), 0.5
    rows = np.flatnonzero(np.isclose(found.scores, 0.9))
    way = share / RATE * np.gradient(found.pixels[rows], found.times[rows], axis=0)
    streaks = np.full_like(found.streaks, np.nan)
    streaks[rows] = found.pixels[rows, None] + 0.5 * way[:, None] * np.array([[-1.0], [1.0]])
    chosen, field = search(replace(found, streaks=streaks), SIDE, ball.model, ball.surfaces)
    assert field is not None
    assert field.exposure == pytest.approx(share, abs=0.1)
    assert len(chosen.strokes) == 3


def test_of_a_time_shift_nothing_changes(ball: World) -> None:
    times, states = rally(ball)
    found = seen(times, states, 5)
    moved = replace(found, frames=found.frames + 3.0)
    late = replace(SIDE, time_offset=0.5)
    one, other, third = (
        track_one_camera(*given, ball.model, ball.surfaces) for given in ((found, SIDE), (moved, SIDE), (found, late))
    )
    assert len(one.estimates) == len(other.estimates) == len(third.estimates) == 3
    for a, b, c in zip(one.estimates, other.estimates, third.estimates, strict=True):
        np.testing.assert_allclose(b.times, a.times + 3.0, atol=1e-9)
        np.testing.assert_allclose(c.times, a.times - 0.5, atol=1e-9)
        np.testing.assert_allclose(b.states, a.states, rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(c.states, a.states, rtol=1e-4, atol=1e-3)


@pytest.mark.parametrize("up", [4.0, -6.0])
def test_of_a_worlds_origin_nothing_changes(ball: World, up: float) -> None:
    """A table at 4.76 m, as over a marker in a cellar, has as much room above it as one at 0.76 m."""
    times, states = rally(ball)
    found, shift = seen(times, states, 5), np.array([10.0, -5.0, up])
    camera = replace(SIDE, tvec=SIDE.tvec - SIDE.rotation @ shift)
    ends = (8.63, 11.37, -5.76, -4.24)
    moved = replace(ball.surfaces, table_height=TABLE + up, floor_height=up, extent=ends)
    one = track_one_camera(found, SIDE, ball.model, ball.surfaces)
    other = track_one_camera(found, camera, ball.model, moved)
    assert len(one.estimates) == len(other.estimates) == 3
    for a, b in zip(one.estimates, other.estimates, strict=True):
        np.testing.assert_allclose(b.states[:, :3] - shift, a.states[:, :3], atol=1e-3)


def test_a_light_that_glides_is_no_evidence_of_a_ball_but_a_flight_is(ball: World) -> None:
    times, states = rally(ball)
    found, pinhole = without_lens(seen(times, states, 3), SIDE)
    scale, fall = at_court(pinhole, ball.surfaces)
    field = Field.of(found, scale, fall=fall)
    seeds, rated, foretold = arcs(field)
    light = np.isclose(found.scores, 0.5)
    assert (rated.density[light] > field.density[light]).mean() > 0.95
    assert (rated.density[light] * 2.0 * np.pi * np.sqrt(np.linalg.det(field.covariances[light]))).max() <= 1.0 + 1e-9
    np.testing.assert_array_equal(rated.density[~light], field.density[~light])
    assert not any(light[rows].mean() >= MOSTLY for rows in seeds)
    assert not light[np.array(foretold.rows)].all(axis=1).any()
    # it takes as long as gravity needs to show; along a line of sight it never does
    assert telling(field) == pytest.approx((2.0 * BENT * 2.0 * np.sqrt(180.0) / (CARRIED * fall)) ** 0.5)
    assert (arcs(replace(field, fall=0.0))[1].density == field.density).all()


def test_gravity_shows_as_much_as_a_camera_sees_of_it(ball: World) -> None:
    _, pinhole = without_lens(Detections.of_frames("side", [(0.0, Candidates.none())]), SIDE)
    scale, fall = at_court(pinhole, ball.surfaces)
    drop = pinhole.project(np.array([[0.0, 0.0, TABLE], [0.0, 0.0, TABLE - 0.01]]))
    assert fall == pytest.approx(9.80665 * 100.0 * np.linalg.norm(drop[1] - drop[0]), rel=0.02)
    assert scale == pytest.approx(1000.0 / np.linalg.norm(SIDE.centre - [0.0, 0.0, TABLE]))
    down = replace(pinhole, rvec=np.array([np.pi, 0.0, 0.0]), tvec=np.array([0.0, 0.0, 4.0]))
    assert at_court(down, ball.surfaces)[1] == pytest.approx(0.0, abs=1e-9)
    # without ends it is where the middle of the picture shows the ground, but not beyond some times the height
    endless = Surfaces(TABLE)
    assert at_court(down, endless)[0] == pytest.approx(1000.0 / (4.0 - TABLE))
    level = replace(pinhole, rvec=np.array([np.pi / 2.0, 0.0, 0.0]), tvec=np.array([0.0, TABLE + 3.0, 0.0]))
    assert level.centre[2] == pytest.approx(TABLE + 3.0)
    assert at_court(level, endless)[0] == pytest.approx(1000.0 * FLATTEST / 3.0)


def test_a_lens_with_distortion_and_two_focal_lengths_is_undone(ball: World) -> None:
    times, states = rally(ball)
    matrix = np.array([[1100.0, 0.0, 650.0], [0.0, 900.0, 350.0], [0.0, 0.0, 1.0]])
    wide = replace(SIDE, matrix=matrix, distortion=np.array([-0.25, 0.05, 0.001, 0.0, 0.0]))
    found = seen(times, states, 3, camera=wide)
    flat, pinhole = without_lens(found, wide)
    points = states[:, :3]
    focal = np.sqrt(1100.0 * 900.0)
    np.testing.assert_allclose(np.diag(pinhole.matrix)[:2], focal)
    balls = flat.pixels[np.isclose(found.scores, 0.9)]
    off = np.linalg.norm(balls[:, None] - pinhole.project(points), axis=2).min(axis=1)
    assert np.median(off) < 2.0 * NOISE
    # a small step in the picture has the length that its covariance says
    (one, *_), step = found.pixels, np.array([0.1, 0.05])
    both = Detections.of_frames("side", [(0.0, Candidates.at([one, one + step], 1.0))])
    undone, _ = without_lens(replace(both, radii=[[5.0, 0.2], [0.0, 1.0]]), wide)
    larger = np.linalg.det(undone.covariances[0]) ** 0.25  # of what has the length of a pixel, in the mean
    np.testing.assert_allclose(undone.radii[0], [5.0 * larger, 0.2 * larger])
    assert undone.radii[1, 0] == 0.0
    moved = undone.pixels[1] - undone.pixels[0]
    assert moved @ np.linalg.inv(undone.covariances[0]) @ moved == pytest.approx(step @ step, rel=1e-3)
    assert without_lens(flat, pinhole) == (flat, pinhole)
    strokes = track_one_camera(found, wide, ball.model, ball.surfaces)
    assert len(strokes.estimates) == 3
    assert max(judged(strokes, times, states)) < 0.08


@pytest.mark.thorough
def test_a_rolling_shutter_shows_a_ball_when_its_row_is_read(ball: World) -> None:
    """What was seen at the same moments gives the same states, whatever the stamps."""
    times, states = rally(ball)
    plain, rolling = seen(times, states, 3, hidden=0.0), replace(SIDE, readout=0.016)
    rows = plain.pixels[np.isclose(plain.scores, 0.9)]
    frames = plain.frames.copy()
    frames[: len(rows)] -= rolling.true_times(np.zeros(len(rows)), rows)
    one, other = (
        track_one_camera(replace(plain, frames=stamps), camera, ball.model, ball.surfaces)
        for stamps, camera in ((plain.frames, SIDE), (frames, rolling))
    )
    assert len(one.estimates) == len(other.estimates) == 3
    assert max(judged(other, times, states)) < 0.08
    for straight, rolled in zip(one.estimates, other.estimates, strict=True):
        np.testing.assert_allclose(rolled.times, straight.times, atol=1e-9)
        assert np.abs((rolled.states - straight.states) / straight.sigmas).max() < 1e-6
    blind = track_one_camera(replace(plain, frames=frames), SIDE, ball.model, ball.surfaces).estimates[0]
    assert np.abs((blind.states - one.estimates[0].states) / one.estimates[0].sigmas).max() > 0.3


def test_streaks_add_states_at_both_ends_of_exposures(ball: World) -> None:
    times, states = rally(ball)
    plain = seen(times, states, 3, hidden=0.0)
    plain = plain.select(~np.isclose(plain.scores, 0.5))  # a light that glides without a streak hides the exposure
    rows = np.flatnonzero(np.isclose(plain.scores, 0.9))
    way = 0.01 * np.gradient(plain.pixels[rows], plain.times[rows], axis=0)
    streaks = plain.streaks.copy()
    streaks[rows] = plain.pixels[rows, None] + 0.5 * way[:, None] * np.array([[-1.0], [1.0]])
    exposed = replace(SIDE, exposure=0.01)
    strokes = track_one_camera(replace(plain, streaks=streaks), exposed, ball.model, ball.surfaces)
    assert strokes.tracking.rate == RATE
    for estimate, one in zip(strokes.estimates, strokes.tracking.balls, strict=True):
        assert len(estimate) > 1.7 * len(one.sightings)


def test_a_court_needs_no_ends(ball: World) -> None:
    times, states = rally(ball)
    for ends in (None, (-np.inf, np.inf, -np.inf, np.inf)):
        strokes = track_one_camera(seen(times, states, 3), SIDE, ball.model, replace(ball.surfaces, extent=ends))
        assert len(strokes.estimates) == 3
        assert max(judged(strokes, times, states)) < 0.08


def test_no_surface_is_refused(ball: World) -> None:
    times, states = rally(ball)
    with pytest.raises(ValueError, match="surfaces must hold one"):
        track_one_camera(seen(times, states, 3), SIDE, ball.model, Surfaces.none())


def test_a_single_flight_without_a_bounce_is_a_stroke(ball: World) -> None:
    start = np.array([-1.0, -0.2, TABLE + 0.1, 1.8, 0.1, 3.2, 0.0, 0.0, 0.0])
    times = np.arange(1, 31) / RATE
    with torch.no_grad():
        path = rollout(
            ball.model, torch.from_numpy(start[None]), torch.from_numpy(np.append(0.0, times)), ball.surfaces
        )
    states = path[0, 1:].numpy()
    for surfaces in (ball.surfaces, replace(ball.surfaces, extent=None)):
        (estimate,) = track_one_camera(seen(times, states, 3), SIDE, ball.model, surfaces).estimates
        assert not estimate.contacts
        assert len(estimate) >= 25
        assert estimate.status in (Status.OK, Status.DEPTH_UNCERTAIN)
        rows = np.searchsorted(times, estimate.times - 100.0 - 1e-6)
        off = np.linalg.norm(estimate.states[:, :3] - states[rows, :3], axis=1)
        assert np.median(off) < 3.0 * float(np.sqrt(np.trace(estimate.covariances[15, :3, :3])))


def test_two_balls_may_fly_at_the_same_time(ball: World) -> None:
    times, states = rally(ball)
    both = seen(times, states, 3)
    other = states * np.array([-1.0, -1.0, 1.0, -1.0, -1.0, 1.0, 1.0, -1.0, 1.0])
    late = seen(times, other, 4).select
    extra = late(np.isclose(seen(times, other, 4).scores, 0.9))
    order = np.argsort(np.append(both.frame, extra.frame), kind="stable")
    joined: dict[str, Any] = {
        name: np.concatenate((getattr(both, name), getattr(extra, name)))[order]
        for name in ("frame", "pixels", "covariances", "scores", "streaks", "radii")
    }
    strokes = track_one_camera(replace(both, **joined), SIDE, ball.model, ball.surfaces)
    assert len(strokes.estimates) == 6
    errors = np.minimum(judged(strokes, times, states), judged(strokes, times, other))
    assert errors.max() < 0.08
    starts = [estimate.times[0] for estimate in strokes.estimates]
    assert starts == sorted(starts)


def test_a_recording_without_a_ball_has_no_strokes(ball: World) -> None:
    rng = np.random.default_rng(7)
    one = Candidates.at(rng.uniform((0, 0), SIDE.size, (2, 2)), NOISE)
    for count in (1, 40):
        for candidates in (Candidates.none(), one):
            found = Detections.of_frames("side", [(1.7e9 + frame / RATE, candidates) for frame in range(count)])
            strokes = track_one_camera(found, SIDE, ball.model, ball.surfaces)
            assert strokes.estimates == ()
            assert strokes.tracking.balls == ()
            assert strokes.doubts == []


def test_strokes_are_joined_at_hits_and_have_their_bounces(ball: World) -> None:
    times, states = rally(ball)
    late = replace(SIDE, time_offset=0.5)
    joined, other = (
        track_one_camera(seen(times, states, 3), camera, ball.model, ball.surfaces) for camera in (SIDE, late)
    )
    of: dict[str, list[float]] = {kind: [] for kind in ("hit", "bounce", "lost")}
    for event in joined.events:
        of[event.kind].append(event.t - 100.0)
    assert of["hit"]
    assert np.abs(np.subtract.outer(of["hit"], HITS[1:-1])).min(axis=1).max() < 0.03
    assert len(of["hit"]) + len(of["lost"]) == len(joined.estimates) == 3
    (rising,) = np.nonzero(np.diff(states[:, 5]) > 1.0)
    assert {event.trajectory for event in joined.events if event.kind == "bounce"} == {"000", "001", "002"}
    for bounce in of["bounce"]:
        between = np.flatnonzero((times[rising] <= bounce + 3e-3) & (bounce - 3e-3 <= times[rising + 1]))
        assert len(between) == 1
    np.testing.assert_allclose([event.t + 0.5 for event in other.events], [one.t for one in joined.events], atol=1e-4)
    for one, moved in zip(joined.estimates, other.estimates, strict=True):
        np.testing.assert_allclose(moved.times, one.times - 0.5, atol=1e-9)
        np.testing.assert_allclose(moved.states, one.states, rtol=1e-4, atol=1e-3)
        assert [contact.interval for contact in moved.contacts] == [contact.interval for contact in one.contacts]


def test_a_start_far_away_along_the_rays_is_no_fault_of_the_units(ball: World) -> None:
    """Somebody who stands for seconds, taken for one flight that ends on the table: the fall would begin far away."""
    stamps = np.arange(0.0, 20.0, 1.0 / RATE)
    pixels = SIDE.project(np.array([[0.3, 0.2, TABLE + 0.02]])) + np.outer(stamps - 20.0, [4.0, 1.0])
    own = (np.zeros(len(stamps), dtype=np.int64), stamps, pixels, np.tile(NOISE**2 * np.eye(2), (len(stamps), 1, 1)))
    track = sighted_track("still", Sightings(("side",), *own), [SIDE], bounces=stamps[-2:-1] + 0.01, **ball._asdict())
    assert np.linalg.norm(np.ptp(track.positions, axis=0)) > 250.0
    assert Smoother(ball.model, ball.surfaces).estimate(track).status is not Status.OK
