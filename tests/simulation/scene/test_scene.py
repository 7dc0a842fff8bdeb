"""A recording: the rig, clocks and shutters, flights at any moment, frames and what is seen in them."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch

from ballfg.dynamics import rollout
from ballfg.simulation import SimulationConfig, parse_effects, simulate, table_tennis
from ballfg.simulation.cameras import looking_at, table_rig
from ballfg.simulation.scene.backdrop import backdrop
from ballfg.simulation.scene.config import Clock, SceneConfig
from ballfg.simulation.scene.recording import Recording, record, visible_columns
from ballfg.simulation.scene.renderer import Renderer
from ballfg.simulation.scene.room import furniture, movers
from ballfg.simulation.scene.shutter import PATH_POINTS, free_running

SMALL = (320, 180)
CLEAN: dict[str, Any] = {"noise": 0.0, "flicker": 0.0, "distractors": False}


@pytest.fixture(scope="module")
def clean() -> Recording:
    return record(SceneConfig(shots=2, seed=4, rate=100.0, **CLEAN), table_rig())


def test_rig_sees_the_table_and_the_flights() -> None:
    cameras = table_rig()
    corners = [[x, y, 0.76] for x in (0.0, 2.74) for y in (-0.7625, 0.7625)]
    for camera in cameras:
        assert camera.in_view(corners).all()
        assert np.linalg.norm(camera.centre - [1.37, 0.0, 0.96]) == pytest.approx(3.0)
    recording = record(SceneConfig(shots=60, interval=0.5, rate=50.0), cameras)
    points = np.concatenate([flight.knots[:, :3] for flight in recording.flights])
    views = np.sum([camera.in_view(points) for camera in cameras], axis=0)
    assert (views >= 2).mean() > 0.995
    assert (views == 3).mean() > 0.97
    rays = np.stack([(camera.centre - [1.37, 0.0, 0.96]) / 3.0 for camera in cameras])
    assert abs(np.linalg.det(rays)) > 0.1  # the three look from no common plane


def test_lenses_are_barrels() -> None:
    for camera in table_rig():
        wide, high = camera.size
        corners = np.array([[0.0, 0.0], [wide - 1.0, 0.0], [0.0, high - 1.0], [wide - 1.0, high - 1.0]])
        rays = np.linalg.solve(camera.matrix, np.column_stack((corners, np.ones(4))).T).T
        moved = camera.project((rays - camera.tvec) @ camera.rotation) - corners
        inwards = (np.array([wide, high]) / 2 - corners) / np.hypot(wide / 2, high / 2)
        assert (np.abs(np.linalg.norm(moved, axis=1) - 50.0) < 15.0).all(), camera.name
        assert ((moved * inwards).sum(axis=1) > 0.99 * np.linalg.norm(moved, axis=1)).all(), camera.name


def test_a_smaller_rig_sees_the_same() -> None:
    point = [1.0, 0.3, 1.1]
    for large, small in zip(table_rig(), table_rig(SMALL), strict=True):
        np.testing.assert_allclose((small.project(point) + 0.5) * 4, large.project(point) + 0.5, atol=1e-9)


def test_a_camera_looks_at_its_target_and_is_level() -> None:
    camera = looking_at("a", [0.0, -3.0, 2.0], [1.0, 0.0, 1.0], 900.0, (641, 481), off_centre=(3.0, -2.0))
    np.testing.assert_allclose(camera.centre, [0.0, -3.0, 2.0], atol=1e-12)
    np.testing.assert_allclose(camera.project([1.0, 0.0, 1.0]), [323.0, 238.0], atol=1e-9)
    assert camera.project([1.0, 0.0, 1.1])[1] < 238.0  # up is up
    assert camera.project([1.3, -0.1, 1.0])[0] > 323.0  # right is right
    assert camera.rotation[0, 2] == pytest.approx(0.0)
    with pytest.raises(ValueError, match="centre must not stand over or under target"):
        looking_at("a", [0.0, 0.0, 3.0], [0.0, 0.0, 1.0], 900.0, (641, 481))


def test_flights_are_the_shots_of_the_simulator() -> None:
    effects = parse_effects(["wind.x=0.5"])
    tracks = simulate(SimulationConfig(tracks=3, seed=7, undeclared=effects))
    recording = record(SceneConfig(shots=3, seed=7, undeclared=effects), table_rig(SMALL))
    for track, flight in zip(tracks, recording.flights, strict=True):
        within = flight.start + track.true_times <= flight.end
        states = flight.states(flight.start + track.true_times[within])
        np.testing.assert_allclose(states, track.true_states[within], atol=2e-6)
        assert flight.end - flight.start == pytest.approx(track.true_times[-1], abs=0.0101)


def test_flights_are_followed_through_bounces(clean: Recording) -> None:
    flight = clean.flights[0]
    rng = np.random.default_rng(0)
    times = np.sort(rng.uniform(0.0, flight.end - flight.start, 300))
    expected = rollout(flight.model, torch.from_numpy(flight.knots[:1]), torch.from_numpy(times), flight.surfaces)
    assert (np.diff(np.sign(expected[0, :, 5].detach().numpy())) > 0).any()  # it bounces
    np.testing.assert_allclose(flight.states(flight.start + times), expected[0].detach().numpy(), atol=1e-6)
    np.testing.assert_allclose(flight.states([flight.start, flight.end]), flight.knots[[0, -1]], atol=1e-9)
    with pytest.raises(ValueError, match="times must lie in the flight '000'"):
        flight.states(flight.end + 0.01)


def test_launches_follow_each_other() -> None:
    recording = record(SceneConfig(shots=4, interval=0.4), table_rig(SMALL))
    starts = np.diff([flight.start for flight in recording.flights])
    assert (np.abs(starts - 0.4) < 0.05).all()
    counts = np.bincount(np.concatenate([passage.frames for passage in recording.passages[0]]))
    assert counts.max() >= 2  # several balls at once


def test_stamps_are_as_the_clock_says() -> None:
    clocks = {"left": Clock(phase=0.003, offset=0.004), "far": Clock(offset=-0.002)}
    recording = record(SceneConfig(shots=1, clocks=clocks), table_rig(SMALL))
    for frames, phase, offset in zip(recording.frames, (0.003, 0.0, 0.0), (0.004, 0.0, -0.002), strict=True):
        count = len(frames.times)
        np.testing.assert_allclose(frames.times, phase + np.arange(count) / 120.0, atol=1e-12)
        np.testing.assert_allclose(frames.stamps - frames.times, offset, atol=1e-12)
        assert recording.flights[-1].end + 0.5 - frames.times[-1] < 1 / 120.0


def test_jitter_and_dropped_frames() -> None:
    plain = record(SceneConfig(shots=6), table_rig(SMALL)).frames
    spoilt = record(SceneConfig(shots=6, jitter=0.001, dropout=0.1), table_rig(SMALL)).frames
    for before, after in zip(plain, spoilt, strict=True):
        assert np.isin(after.times, before.times).all()
        assert 1 - len(after.times) / len(before.times) == pytest.approx(0.1, abs=0.03)
        assert np.std(after.stamps - after.times) == pytest.approx(0.001, rel=0.1)
        assert (np.diff(after.stamps) > 0).all()
    assert not np.array_equal(spoilt[0].times, spoilt[1].times)
    few = record(SceneConfig(shots=1, dropout=0.95), table_rig(SMALL)).frames
    assert [frames.times[0] for frames in few] == [0.0, 0.0, 0.0]  # a recording begins with a frame of each camera


def test_free_running_cameras_never_expose_together() -> None:
    phases = []
    for seed in range(20):
        clocks = free_running(["a", "b", "c"], 100.0, seed)
        phase = np.sort([clock.phase for clock in clocks.values()])
        assert np.diff(phase).min() > 0.0016
        assert 0.0 < phase[0] < phase[-1] < 0.01
        phases.append(clocks["a"].phase)
    assert np.ptp(phases) > 0.006


def test_visible_says_where_balls_are(clean: Recording) -> None:
    for number, camera in enumerate(clean.cameras):
        table = visible_columns(clean, number)
        for flight in clean.flights:
            rows = table["trajectory"] == flight.name
            time = table["t_true"][rows]
            frames = clean.frames[number].times
            inside = (frames >= flight.start + 0.001) & (frames <= flight.end - 0.001)
            centres = flight.states(frames[inside])[:, :3]
            seen = camera.in_view(centres)
            np.testing.assert_array_equal(table["frame"][rows], np.flatnonzero(inside)[seen])
            for names, moment in ((("u", "v"), 0.0), (("u_open", "v_open"), -0.001), (("u_close", "v_close"), 0.001)):
                pixels = camera.project(flight.states(time + moment)[:, :3])
                np.testing.assert_allclose(np.column_stack([table[name][rows] for name in names]), pixels, atol=1e-6)
            depth = camera.depth(flight.states(time)[:, :3])
            np.testing.assert_allclose(table["radius"][rows], 1000.0 * 0.02 / depth, rtol=1e-9)
        margin = np.minimum(np.minimum(table["u"], 1279 - table["u"]), np.minimum(table["v"], 719 - table["v"]))
        assert (table["whole"][margin > 20] == 1).all()
        assert (table["whole"][margin < 3] == 0).all()


def test_frames_show_the_ball_where_it_is(clean: Recording) -> None:
    number = 1
    camera, frames = clean.cameras[number], clean.frames[number]
    renderer = Renderer(clean.config, camera, number)
    empty = renderer.draw(0.0, []).astype(float)
    for passage in clean.passages[number]:
        for row in range(5, len(passage.frames), 40):
            image = renderer.draw(float(frames.times[passage.frames[row]]), [passage.paths[row]]).astype(float)
            v, u = np.nonzero(np.abs(image - empty).max(axis=2) > 20)
            middle = np.array([u.mean(), v.mean()])
            assert np.linalg.norm(middle - camera.project(passage.centres[row])) < 0.5  # the edge of the mask is coarse
            assert np.ptp(u) < 30
            assert np.ptp(v) < 30
    np.testing.assert_array_equal(renderer.draw(0.0, []), empty)  # nothing is left behind


def test_paths_go_from_opening_to_closing(clean: Recording) -> None:
    passage, times = clean.passages[0][1], clean.frames[0].times
    flight = clean.flights[1]
    moments = times[passage.frames[7]] + clean.config.exposure * np.linspace(-0.5, 0.5, PATH_POINTS)
    np.testing.assert_allclose(passage.paths[7], flight.states(moments)[:, :3], atol=1e-9)


def test_table_is_drawn_where_it_is() -> None:
    """The middle line, 3 mm of white: the centroid of its light along a column lies on its projection."""
    camera, kind = table_rig()[1], SceneConfig().ball
    image = backdrop(camera, kind, np.random.default_rng(0)).image.sum(axis=2)
    off = []
    for x in np.linspace(0.4, 2.3, 120):
        u, v = camera.project([x, 0.0, 0.76])
        column = round(u)
        way = np.diff(camera.project([[x - 0.05, 0.0, 0.76], [x + 0.05, 0.0, 0.76]]), axis=0)[0]
        expected = v + (column - u) * way[1] / way[0]
        rows = np.arange(round(expected) - 3, round(expected) + 4)
        light = image[rows, column] - np.linspace(image[rows[0], column], image[rows[-1], column], len(rows))
        off.append((rows * light).sum() / light.sum() - expected)
    assert np.abs(off).max() < 0.4  # a line thinner than a pixel says no more than which pixel
    assert abs(np.mean(off)) < 0.03


def test_light_flickers_with_the_mains() -> None:
    config = SceneConfig(shots=1, noise=0.0, flicker=0.05, distractors=False)
    renderer = Renderer(config, table_rig(SMALL)[0], 0)
    still = renderer.draw(0.0, []).mean()
    times = np.array([0.0025, 0.0075, 0.0125, 0.005])
    light = [renderer.draw(float(time), []).mean() / still for time in times]
    expected = 1 + 0.05 * np.sinc(100.0 * 0.002) * np.sin(2 * np.pi * 100.0 * times)
    np.testing.assert_allclose(light, expected, atol=0.002)


def test_noise_grows_with_the_light() -> None:
    config = SceneConfig(shots=1, noise=3.0, flicker=0.0, distractors=False)
    renderer = Renderer(config, table_rig(SMALL)[0], 0)
    images = np.stack([renderer.draw(0.0, []) for _ in range(40)]).astype(float)
    mean, deviation = images.mean(axis=0), images.std(axis=0, ddof=1)
    for low, high in ((20, 60), (100, 150)):
        part = (mean > low) & (mean < high)
        expected = np.sqrt(np.mean(9.0 * (1 + mean[part] / 128.0)) + 1 / 12)
        assert np.sqrt(np.mean(deviation[part] ** 2)) == pytest.approx(expected, rel=0.02)
    steps = images[1:] - images[:-1]
    assert abs(np.corrcoef(steps[0].ravel(), steps[2].ravel())[0, 1]) < 0.02  # frames share no noise


def test_other_things_move() -> None:
    config = SceneConfig(shots=1, noise=0.0, flicker=0.0)
    for number, camera in enumerate(table_rig(SMALL)):
        renderer = Renderer(config, camera, number)
        first, later = (renderer.draw(time, []).astype(float) for time in (0.0, 0.3))
        moved = np.abs(first - later).max(axis=2) > 20
        assert 20 < moved.sum() < 2000


def test_a_short_reflection_glides_over_the_floor() -> None:
    """What looks most like a ball beside one: small, bright, on its way to and fro along x."""
    for time in np.linspace(0.0, 20.0, 41):
        reflection = movers(float(time))[-1]
        assert min(reflection.colour) > 150
        assert np.linalg.norm(np.diff(reflection.ends, axis=0)) == pytest.approx(0.17, abs=0.01)
        assert 0.4 < reflection.ends[:, 0].min() < reflection.ends[:, 0].max() < 2.9
        assert reflection.ends[:, 2].max() < 0.02


def test_the_launcher_stands_where_the_balls_come_from() -> None:
    ball = table_tennis()
    muzzle = np.array([ball.launcher.x, 0.0, ball.surfaces.table_height + ball.launcher.height])
    behind = [box for box in furniture(ball) if 0.0 < muzzle[0] - box.high[0] < 0.05]
    assert any((box.low[1:] < muzzle[1:]).all() and (muzzle[1:] < box.high[1:]).all() for box in behind)


def test_the_same_seed_gives_the_same_frames() -> None:
    def some(seed: int) -> bytes:
        recording = record(SceneConfig(shots=1, seed=seed), table_rig(SMALL))
        images = recording.images(2)
        return b"".join(next(images).tobytes() for _ in range(70))

    first = some(1)
    assert some(1) == first
    assert some(2) != first


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"shots": 0}, "shots must lie in 1"),
        ({"rate": 1.0}, "rate must be at least 5"),
        ({"exposure": 0.009}, "exposure must be at most 0.95 of the frame interval, 0.00792 s at 120 Hz"),
        ({"jitter": 0.002}, "jitter must be at most 0.15 frames"),
        ({"colour": "pink"}, "colour must be one of white, orange; got 'pink'"),
        ({"noise": -1.0}, "noise must be at least 0"),
        ({"settings": {"speed": [99]}}, "speed must lie in 8 .. 14"),
        ({"undeclared": parse_effects(["time_offset.x=0.01"])}, "changes how positions are measured"),
    ],
)
def test_refuses(changes: dict[str, Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SceneConfig(**changes)


def test_refuses_cameras() -> None:
    config = SceneConfig(shots=1, clocks={"middle": Clock()})
    rig = table_rig(SMALL)
    with pytest.raises(ValueError, match="clocks must be of cameras left, right, far; got one of 'middle'"):
        record(config, rig)
    with pytest.raises(ValueError, match="names of their own; got left, left"):
        record(SceneConfig(shots=1), [rig[0], rig[0]])
    with pytest.raises(ValueError, match="phase must be at least 0"):
        Clock(phase=-0.1)
    outside = table_rig(SMALL, distance=6.0)
    with pytest.raises(ValueError, match="camera 'left' must stand in the room"):
        Renderer(SceneConfig(shots=1), outside[0], 0)
    with pytest.raises(ValueError, match="distance must be positive"):
        table_rig(SMALL, distance=0.0)
