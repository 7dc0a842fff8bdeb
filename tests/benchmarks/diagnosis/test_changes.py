"""Changes of measured tracks against independent routes: closed forms, dense covariances, an integrator of its own."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.spatial.transform import Rotation

from ballfg.arrays import Array
from ballfg.benchmarks.diagnosis.changes import CHANGES, Changed, across, applicable
from ballfg.simulation import MeasurementNoise, SimulationConfig, simulate, table_tennis
from ballfg.simulation.synthetic import dataset_info
from ballfg.tracks import Dataset, Track
from ballfg.tracks.dataset import dataset_in_memory

EXACT = SimulationConfig(tracks=8, seed=3, rate=100.0, noise=MeasurementNoise(position=2e-5, spin=1e-3))
SHOTS = [one.track for one in simulate(EXACT)]
ROOM = dataset_in_memory(replace(dataset_info(EXACT), position_noise=2e-5, spin_noise=1e-3), SHOTS)


def changed(name: str, tracks: Sequence[Track] = SHOTS, dataset: Dataset = ROOM) -> Changed:
    return CHANGES[name](dataset, tracks, np.random.default_rng(0))


def spin(track: Track) -> Array:
    assert track.spin_label is not None
    return track.spin_label


def long_track(samples: int, seed: int) -> Track:
    """Uneven stamps, 2 to 8 ms apart."""
    rng = np.random.default_rng(seed)
    times = 3.0 + np.cumsum(rng.uniform(0.002, 0.008, samples))
    return Track(times, rng.uniform(-1.0, 1.0, (samples, 3)), name="long")


def test_a_turned_frame_turns_positions_and_nothing_else() -> None:
    turned = changed("frame_tilt")
    assert turned.strengths == {"x": 0.02, "y": 0.0}
    for before, after in zip(SHOTS, turned.tracks, strict=True):
        expected = Rotation.from_rotvec([0.02, 0.0, 0.0]).apply(before.positions)
        np.testing.assert_allclose(after.positions, expected, atol=1e-14)
        np.testing.assert_array_equal(after.times, before.times)
        assert after.labels == before.labels


def test_a_clock_that_runs_wrong_stretches_durations() -> None:
    track = long_track(50, 1)
    written = changed("time_scale", [track])
    np.testing.assert_allclose(
        written.tracks[0].times - 3.0, 1.04 * (track.times - track.times[0]) + track.times[0] - 3
    )
    np.testing.assert_array_equal(written.tracks[0].positions, track.positions)
    assert written.strengths == {"s": 0.04}


def test_a_wrong_length_stretches_heights() -> None:
    scaled = changed("scale")
    np.testing.assert_allclose(scaled.tracks[0].positions, SHOTS[0].positions * [1.0, 1.0, 1.05], atol=1e-14)
    assert scaled.strengths == {"x": 0.0, "y": 0.0, "z": 0.05}


def test_labels_in_a_turned_frame_are_components_along_its_axes() -> None:
    turned = changed("spin_label_frame")
    axes = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])  # of the labels' frame, one a row
    for before, after in zip(SHOTS, turned.tracks, strict=True):
        np.testing.assert_allclose(spin(after), [spin(before) @ axis for axis in axes], atol=1e-12)
        np.testing.assert_array_equal(after.positions, before.positions)
        assert after.labels["speed"] == before.labels["speed"]
    matrix = np.eye(3) + [[turned.strengths[row + column] for column in "xyz"] for row in "xyz"]
    np.testing.assert_array_equal(matrix, axes)


def test_jitter_moves_each_stamp_and_keeps_its_position() -> None:
    track = long_track(4000, 2)
    jittered = changed("stamp_jitter", [track])
    assert jittered.strengths == {"sigma": 0.0025}
    after = jittered.tracks[0]
    assert (np.diff(after.times) > 0.0).all()
    order = np.argsort(after.positions[:, 0])  # positions are unique: they identify the samples
    back = np.argsort(track.positions[:, 0])
    np.testing.assert_array_equal(after.positions[order], track.positions[back])
    errors = (after.times[order] - track.times[back])[np.argsort(back)]
    assert abs(errors.mean()) < 4 * 0.0025 / np.sqrt(4000)
    assert errors.std() == pytest.approx(0.0025, rel=4 / np.sqrt(8000))
    assert abs(np.corrcoef(errors[1:], errors[:-1])[0, 1]) < 4 / np.sqrt(4000)


def test_memory_has_an_exponential_covariance_over_uneven_stamps() -> None:
    track = long_track(1500, 3)
    remembered = changed("tracker_memory", [track])
    added = remembered.tracks[0].positions - track.positions
    dense = 0.006**2 * np.exp(-np.abs(track.times[:, None] - track.times) / 0.02)
    white = np.linalg.solve(np.linalg.cholesky(dense), added)
    assert (white**2).mean() == pytest.approx(1.0, abs=4 * np.sqrt(2 / white.size))
    assert abs((white[1:] * white[:-1]).mean()) < 4 / np.sqrt(white.size)
    assert added.std() == pytest.approx(0.006, rel=0.15)  # some 370 independent errors along each axis


def test_a_rig_that_sinks_half_way_lifts_the_later_half() -> None:
    moved = changed("table_height_drift")
    lifts = [after.positions - before.positions for before, after in zip(SHOTS, moved.tracks, strict=True)]
    assert all(np.array_equal(lift, np.zeros_like(lift)) for lift in lifts[:4])
    assert all(np.allclose(lift, [0.0, 0.0, 0.012], atol=1e-15) for lift in lifts[4:])


def test_every_fifth_frame_is_lost_and_the_rest_counted_through() -> None:
    lost = changed("counted_frames")
    true = written = 0
    for before, after in zip(SHOTS, lost.tracks, strict=True):
        kept = [k for k in range(len(before)) if k % 5 != 4]
        np.testing.assert_array_equal(after.positions, before.positions[kept])
        np.testing.assert_allclose(after.times, before.times[0] + 0.01 * np.arange(len(kept)), atol=1e-12)
        true, written = true + kept[-1], written + len(kept) - 1
    assert lost.strengths["missing"] == pytest.approx(true / written - 1)
    assert lost.strengths["missing"] == pytest.approx(0.25, abs=0.01)


def test_wind_moves_a_flight_as_an_integrator_of_its_own_says() -> None:
    blown = changed("wind")
    wind = np.array([blown.strengths[axis] for axis in "xyz"])
    assert np.linalg.norm(wind) == pytest.approx(0.6)
    np.testing.assert_allclose(wind[:2], 0.6 * across(SHOTS))
    flight = {name: value.item() for name, value in table_tennis().model.named_parameters()}
    drag, lift, g = (flight[f"flight.{name}"] for name in ("drag.k", "magnus.k", "gravity.g"))
    truths, farthest = {one.track.name: one.true_states[0] for one in simulate(EXACT)}, 0.0
    for before, after in zip(SHOTS, blown.tracks, strict=True):
        start = truths[before.name]
        first = int(np.argmin(before.positions[:, 2] > before.positions[:, 2].min() + 0.05))  # before any bounce
        times = before.times[:first] - before.times[0]

        def rates(_: float, state: Array, turning: Array = start[6:]) -> Array:
            air = state[3:] - wind
            force = -drag * np.linalg.norm(air) * air + lift * np.cross(turning, air)
            return np.concatenate((state[3:], force - [0.0, 0.0, g]))

        path = solve_ivp(rates, (0.0, times[-1]), start[:6], "DOP853", times, rtol=1e-10, atol=1e-12).y[:3].T
        np.testing.assert_allclose(after.positions[:first], path, atol=5e-4)
        contact = EXACT.ball.surfaces.table_height + EXACT.ball.ball.radius
        assert after.positions[:, 2].min() > contact - 0.005  # bounces move with the flight; nothing sinks in
        farthest = max(farthest, float(np.abs(path - before.positions[:first]).max()))
    assert farthest > 0.01


def test_labels_are_turned_only_where_there_are_some() -> None:
    assert list(applicable(ROOM)) == list(CHANGES)
    bare = dataset_in_memory(ROOM.info, [replace(track, labels={}) for track in SHOTS])
    assert set(CHANGES) - set(applicable(bare)) == {"spin_label_frame"}
