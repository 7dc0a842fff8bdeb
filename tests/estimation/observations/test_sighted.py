"""Tracks that cameras saw: rough paths, and the smoother on pixels against truth, removal and triangulation."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.estimation.observations.ray_path import BEFORE, SPEED, SPREAD, Rays, _robust, rough_path
from ballfg.estimation.observations.rig import in_order
from ballfg.estimation.observations.sightings import SAME_MOMENT, sighted_track, sightings_of
from ballfg.estimation.online.online import Online
from ballfg.estimation.registry import make_estimator
from ballfg.estimation.result import Status
from ballfg.estimation.settings import Settings
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.loss import Loss
from ballfg.factors.noise import ProcessNoise
from ballfg.simulation import MeasurementNoise, MotionNoise as TrueNoise, SimulationConfig, simulate
from ballfg.tracks import Track
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera import Camera
from tests.estimation.nees import inside, nees
from tests.estimation.observations.sighted_rig import NOISE, RIG, Scene, World, late, scene, seen, track_of, world


@pytest.fixture(scope="module")
def ball() -> World:
    return world()


@pytest.fixture(scope="module")
def made(ball: World) -> Scene:
    return scene(0, ball)


def smoother(ball: World, **changes: object) -> Smoother:
    return Smoother(ball.model, ball.surfaces, Settings(**changes))


def bounces(made: Scene) -> np.ndarray:
    """s, true times at which the ball came up."""
    times = made.sightings.times
    return times[1:][np.diff(made.truth[:, 5]) > 1.0]


def test_rough_path_is_good_to_its_sigmas_even_at_the_bounce(made: Scene) -> None:
    track = track_of(made)
    error = track.positions - made.truth[:, :3]
    assert np.sqrt((error**2).mean()) < 8e-4
    assert np.abs(error).max() < 5e-3
    np.testing.assert_allclose(np.sqrt(((error / track.sigmas) ** 2).mean(axis=0)), 1.0, atol=0.3)
    np.testing.assert_array_equal(track.times, made.sightings.times)


def test_path_before_a_moment_knows_nothing_later(made: Scene) -> None:
    times = made.sightings.times
    moments = times[30:]
    path = rough_path(Rays.of(made.sightings, times, RIG), moments, BEFORE)
    short = made.sightings.select(np.arange(101))
    again = rough_path(Rays.of(short, times[:101], RIG), moments[70:71], BEFORE)
    np.testing.assert_allclose(again.positions[0], path.positions[70], atol=1e-9)
    away = np.abs(moments[:, None] - bounces(made)).min(axis=1) > 0.02
    assert np.abs(path.positions - made.truth[30:, :3])[away].max() < 8e-3


def test_sightings_of_one_moment_share_a_state(ball: World) -> None:
    made = scene(1, ball, phases=(0.0, 0.0, 1e-4 * 120.0), duration=0.2)
    track = track_of(made)
    assert len(track) == 24
    seen = sightings_of(track)
    np.testing.assert_array_equal(seen.state, np.repeat(np.arange(24), 3))
    np.testing.assert_allclose(seen.delay.reshape(-1, 3), np.tile([0.0, 0.0, 1e-4], (24, 1)), atol=1e-12)
    assert seen.delay.max() < SAME_MOMENT
    estimate = smoother(ball).estimate(track)
    assert np.abs(estimate.states - made.truth[::3])[:, :3].max() < 1.5e-3


def test_one_camera_alone_still_gives_states(ball: World) -> None:
    """Two cameras are blind for 0.1 s: the third one's sightings stay, and states among them are close to the truth."""
    made = scene(2, ball)
    t = made.sightings.times
    kept = (made.sightings.camera == 0) | (t < 0.1) | (t > 0.2)
    track = track_of(Scene(made.sightings.select(kept), made.truth[kept]))
    alone = (track.times > 0.12) & (track.times < 0.18)
    assert alone.sum() == 7
    assert (track.sigmas[alone] >= 0.1).all()
    error = smoother(ball).estimate(track).states - made.truth[kept]
    assert np.abs(error[:, :3]).max() < 2e-3


def test_rows_of_rolling_shutters_are_seen_one_after_the_other(ball: World) -> None:
    """What was seen at the same moments gives the same states, whatever the stamps."""
    rolling = tuple(replace(camera, readout=readout) for camera, readout in zip(RIG, (0.012, -0.007, 0.0), strict=True))
    plain, made = scene(2, ball), scene(2, ball, rig=rolling)
    assert np.abs(made.sightings.times - plain.sightings.times).max() > 1e-3
    tracks = track_of(plain), track_of(made, cameras=rolling)
    one, other = (smoother(ball).estimate(track) for track in tracks)
    np.testing.assert_allclose(other.times, one.times, atol=1e-12)
    np.testing.assert_allclose(other.states, one.states, rtol=1e-6, atol=1e-6)


def test_between_takes_the_sightings_along(made: Scene) -> None:
    part = track_of(made).between(0.1, 0.2)
    seen = sightings_of(part)
    assert part.rough
    assert len(part) == len(seen) == 37
    np.testing.assert_array_equal(seen.state, np.arange(37))
    np.testing.assert_allclose(seen.sightings.times - part.times, 0.0, atol=1e-12)
    assert "CameraSightings(37 of 37 samples)" in repr(part)


@pytest.mark.parametrize("start", [0.0, 1.7e9])
@pytest.mark.parametrize("offset", [0.01, 0.0137, -0.1])
def test_cameras_in_step_may_have_late_stamps(ball: World, start: float, offset: float) -> None:
    """A stamp less its offset is rounded, so that of two equal moments either may come out first."""
    stamps = start + 0.02 * np.arange(1, 31)
    since = stamps - start
    points = np.column_stack((-1.0 + 4.0 * since, 0.1 * since, 1.0 + 3.2 * since - 4.9 * since**2))
    rig = (RIG[0], replace(RIG[1], time_offset=offset))
    pixels = np.concatenate([camera.project(points) for camera in rig])
    by, times = np.repeat([0, 1], 30), np.concatenate((stamps, stamps + offset))
    sightings = in_order(Sightings(("left", "right"), by, times, pixels, np.tile(np.eye(2), (60, 1, 1))), rig)
    track = sighted_track("a", sightings, rig)
    assert len(track) == 30
    np.testing.assert_allclose(track.times - track.times[0], since - since[0], atol=1e-6)
    online = Online(ball.model, ball.surfaces, Settings(), cameras=rig)
    for row in range(60):
        camera = sightings.cameras[sightings.camera[row]]
        now = online.push_sighting(float(sightings.times[row]), camera, sightings.pixels[row], np.eye(2))
    assert now is not None
    np.testing.assert_allclose(now.position, points[-1], atol=0.01)


def test_refuses_what_is_no_track(made: Scene) -> None:
    with pytest.raises(ValueError, match="'back' is missing among left, right"):
        sighted_track("a", made.sightings, RIG[:2])
    with pytest.raises(ValueError, match=r"in order of true time; row 1, camera 'right', is earlier"):
        sighted_track("a", made.sightings, (RIG[0], replace(RIG[1], time_offset=0.004), RIG[2]))
    alone = np.flatnonzero(made.sightings.camera == 1)
    with pytest.raises(ValueError, match="one camera saw must be seen 5 times or more; got 4"):
        sighted_track("a", made.sightings.select(alone[:4]), RIG)
    twice = (RIG[0], replace(RIG[0], name="right"), RIG[2])
    with pytest.raises(ValueError, match="'left' and 'right' share a centre"):
        sighted_track("a", made.sightings, twice)


def nearest_stamp_positions(made: Scene) -> Track:
    """Points of the first camera's frames with the nearest frames of the others, as if all shutters opened together."""
    own = [made.sightings.select(made.sightings.camera == c) for c in range(3)]
    points = []
    for time in own[0].times:
        rows, sides = [], []
        for camera, sightings in zip(RIG, own, strict=True):
            x, y = camera.normalized(sightings.pixels[np.argmin(np.abs(sightings.times - time))])
            for k, share in enumerate((x, y)):
                rows.append(camera.rotation[k] - share * camera.rotation[2])
                sides.append(share * camera.tvec[2] - camera.tvec[k])
        points.append(np.linalg.lstsq(np.array(rows), np.array(sides), rcond=None)[0])
    return Track(own[0].times, np.array(points), name="nearest")


def test_velocity_is_better_than_from_nearest_stamps(ball: World) -> None:
    """Velocity RMSE a third of that of triangulating as if synchronised, or less; 0.24 over eight flights."""
    squares = []
    for seed in range(3):
        made = scene(seed, ball)
        first = made.sightings.camera == 0
        positions = nearest_stamp_positions(made)
        x, y, z = estimate_position_noise([positions]).tolist()
        rivals = (
            smoother(ball).estimate(track_of(made)).states[first],
            smoother(ball, position_noise=(x, y, z)).estimate(positions).states,
        )
        away = np.abs(positions.times[:, None] - bounces(made)).min(axis=1) > 1 / 120
        squares.append([(((s - made.truth[first])[away, 3:6]) ** 2).sum(axis=1).mean() for s in rivals])
    ours, theirs = np.sqrt(np.mean(squares, axis=0))
    assert ours < 0.015
    assert ours / theirs < 0.33


def test_covariances_and_innovations_are_honest() -> None:
    """NEES over simulated flights with the process noise that the settings state; NIS chi-square with 2 degrees."""
    tracks = 16
    process = {"acceleration": 0.1, "spin": 1.0, "contact_velocity": 0.02, "contact_spin": 5.0}
    config = SimulationConfig(
        tracks=tracks,
        seed=5,
        rate=110.0,
        process=TrueNoise(**process),
        noise=MeasurementNoise(position=1e-6, spin=4.0),
    )
    settings = Settings(
        process=ProcessNoise(**process),
        spin_label_noise=4.0,
        sighting_loss=Loss(),
        label_loss=Loss(),
        spin_loss=Loss(),
        find_events=False,
    )
    estimator = Smoother(config.ball.model, config.ball.surfaces, settings)
    rng, values, nis = np.random.default_rng(0), [], []
    aside = np.array([1.37, 0.0, 0.0])  # the simulator's table begins at the origin
    rig = [replace(c, tvec=c.tvec - c.rotation @ aside) for c in RIG]
    rig = [replace(c, matrix=[[700.0, 0, 640], [0, 700.0, 360], [0, 0, 1]]) for c in rig]
    for simulated in simulate(config):
        times = simulated.track.times
        made = seen(simulated.true_states, np.arange(len(times)) % 3, times, rng, rig)
        track = sighted_track("a", made.sightings, rig, simulated.track.labels)
        estimate = estimator.estimate(track)
        assert estimate.status is Status.OK
        assert len(track) == len(times)
        values.append(nees(estimate, made.truth).mean())
        nis += estimate.nis.tolist()
    assert inside(np.mean(values), 9, tracks)
    assert np.mean(nis) == pytest.approx(2.0, abs=0.15)
    assert estimate.whitened.shape == (len(sightings_of(track)), 2)


def test_innovation_is_the_distance_from_what_all_others_predict(ball: World, made: Scene) -> None:
    """A sighting really left out: what it would show, and how surely, by the smoother on the others."""
    made = Scene(made.sightings.select(np.arange(60)), made.truth[:60])
    estimator = smoother(ball, sighting_loss=Loss(), spin_loss=Loss(), find_events=False)
    track = track_of(made)
    whole = estimator.estimate(track)
    for row in (20, 33, 47):
        # its own noise made so large that it says nothing: the state stays, the sighting does not count
        noise = made.sightings.covariances.copy()
        noise[row] *= 1e10
        blind = replace(made.sightings, covariances=noise)
        rest = estimator.estimate(sighted_track("a", blind, RIG))
        camera = RIG[made.sightings.camera[row]]
        centre = rest.states[row, :3]
        slope = np.stack(
            [(camera.project(centre + e) - camera.project(centre - e)) / 2e-5 for e in 1e-5 * np.eye(3)], 1
        )
        spread = NOISE**2 * np.eye(2) + slope @ rest.covariances[row, :3, :3] @ slope.T
        distance = made.sightings.pixels[row] - camera.project(centre)
        assert whole.nis[row] == pytest.approx(distance @ np.linalg.solve(spread, distance), rel=0.02, abs=1e-3)


def test_a_wrong_candidate_moves_no_state(ball: World, made: Scene) -> None:
    """One sighting sixty pixels off: states move by less than a third of their standard deviations."""
    pixels = made.sightings.pixels.copy()
    pixels[120] += (50.0, -40.0)
    wrong = Scene(replace(made.sightings, pixels=pixels), made.truth)
    right, other = (smoother(ball).estimate(track_of(m)) for m in (made, wrong))
    np.testing.assert_array_equal(right.hits, other.hits)
    moved = np.abs(right.states - other.states) / right.sigmas
    away = np.arange(len(moved)) != 120
    assert moved[away].max() < 0.35
    assert moved[120].max() < 1.0  # its own camera says nothing of it now
    assert other.nis[120] > 1e3


@pytest.mark.parametrize("cameras", [RIG[:2], RIG])
def test_cameras_that_contradict_each_other_are_noted(ball: World, cameras: tuple[Camera, ...]) -> None:
    """A clock that is 20 ms late leaves errors of 20 stated sigmas; a right rig says nothing in ten scenes."""
    for seed in range(10):
        made = scene(seed, ball, rig=cameras, phases=(0.0, 1 / 3, 2 / 3)[: len(cameras)])
        assert smoother(ball).estimate(track_of(made, cameras=cameras)).notes == ()
    wrong = smoother(ball).estimate(track_of(made, cameras=late((0.0, 0.02, 0.0))[: len(cameras)]))
    (note,) = wrong.notes
    assert re.search(r"'sighting' lie [\d.]+ times as far.*'left': .*'right': .*Check the cameras' clocks", note)


@pytest.mark.parametrize("seed", [0, 3, 6])
def test_one_late_camera_of_three_is_noted(ball: World, seed: int) -> None:
    """Two good cameras have two thirds of the sightings: the median of all is then nearly right."""
    made = scene(seed, ball, rig=RIG, phases=(0.0, 1 / 3, 2 / 3))
    (note,) = smoother(ball).estimate(track_of(made, cameras=late((0.0, 0.02, 0.0)))).notes
    found = {name: float(far) for name, far in re.findall(r"'(left|right|back)': ([\d.]+)", note)}
    assert max(found, key=lambda name: found[name]) == "right"
    assert found["right"] > 10.0


@pytest.mark.parametrize("method", ["ekf", "sliding-window"])
def test_others_use_the_rough_positions(ball: World, made: Scene, method: str) -> None:
    track = track_of(made)
    plain = Track(track.times, track.positions, track.sigmas, name=track.name)
    estimator = make_estimator(method, ball.model, ball.surfaces, Settings())
    np.testing.assert_array_equal(estimator.estimate(track).states, estimator.estimate(plain).states)


def test_order_of_sightings_is_free(ball: World, made: Scene) -> None:
    """Grouped by camera, as files have them; put in order by true time they are the same track."""
    shuffled = made.sightings.select(np.argsort(made.sightings.camera, kind="stable"))
    np.testing.assert_array_equal(in_order(shuffled, RIG).pixels, made.sightings.pixels)


def test_what_no_ray_tells_is_known_as_well_as_before() -> None:
    """Two cameras at one moment tell the place, and of the velocity nothing; one camera nothing along its ray."""
    ball, covariances = np.array([0.2, 0.1, 1.0]), np.tile(NOISE**2 * np.eye(2), (2, 1, 1))
    pixels = np.concatenate([camera.project(ball[None]) for camera in RIG[:2]])
    names = tuple(camera.name for camera in RIG)
    seen_once = Sightings(names, np.array([0, 1]), np.zeros(2), pixels, covariances)
    both = Rays.of(seen_once, np.zeros(2), RIG)
    every = np.array([[0, 1]])

    def solved(inside: list[bool]):
        matrix = both.matrix[every]
        equations = np.concatenate((matrix, 0.0 * matrix), axis=-1)
        return _robust(both, every, np.array([inside]), equations, both.target[every], np.zeros((1, 2)))

    found, known, _ = solved([True, True])
    np.testing.assert_allclose(found[0, :3], ball, atol=1e-3)
    np.testing.assert_allclose(np.sqrt(np.diag(known[0])[3:]), SPEED)
    assert np.sqrt(np.diag(known[0])[:3]).max() < 0.01
    alone = np.linalg.eigvalsh(solved([True, False])[1][0, :3, :3])
    assert np.sqrt(alone[-1]) == pytest.approx(SPREAD, rel=0.01)
