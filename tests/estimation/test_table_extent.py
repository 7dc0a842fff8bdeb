"""The ends of a table, found from balls whose table is known."""

import math

import numpy as np
import pytest
import torch
from numpy.testing import assert_allclose

import ballfg as bf
from ballfg.dynamics import Surfaces, nominal_model, rollout
from ballfg.dynamics.surfaces import TABLE_LENGTH, TABLE_WIDTH
from ballfg.estimation import dataset_surfaces
from ballfg.estimation.configure import table_note
from ballfg.estimation.table_extent import _falls, find_table_extent
from ballfg.tracks import TABLE_TENNIS, Track, read_dataset, write_dataset
from ballfg.tracks.info import TENNIS, DatasetInfo
from tests.places import DATA

HEIGHT, RADIUS, SIGMA = 0.76, TABLE_TENNIS.radius, 0.003
MIDDLE = np.array([0.4, 1.6])
"""m, of the table in the frame."""
LONG_X = (TABLE_LENGTH, TABLE_WIDTH)
NOWHERE = (math.inf, math.inf)


def sides(size: tuple[float, float]) -> np.ndarray:
    return np.array(
        [MIDDLE[0] - size[0] / 2, MIDDLE[0] + size[0] / 2, MIDDLE[1] - size[1] / 2, MIDDLE[1] + size[1] / 2]
    )


def shots(
    size: tuple[float, float], beyond: tuple[float, float], *, count: int = 60, rate: float = 120.0, seed: int = 0
) -> list[Track]:
    """Balls that come down all over a table and at most `beyond` (m, along x and y) past its upper ends."""
    rng = np.random.default_rng(seed)
    low, high = MIDDLE - np.array(size) / 2, MIDDLE + np.array(size) / 2
    aim = rng.uniform(low, np.where(np.isinf(beyond), high, high + np.array(beyond)), (count, 2))
    fall = rng.uniform(0.35, 0.5, count)  # s until it comes down, from 0.35 m above
    rise = (9.81 * fall**2 / 2 - 0.35) / fall
    states = np.zeros((count, 9))
    states[:, 3:5] = rng.normal(0.0, 1.5, (count, 2))
    states[:, :2] = aim - states[:, 3:5] * fall[:, None] * 0.95
    states[:, 2], states[:, 5] = HEIGHT + RADIUS + 0.35, rise
    times = np.arange(int(0.7 * rate)) / rate
    with torch.no_grad():
        surfaces = Surfaces(HEIGHT, HEIGHT - 0.76, tuple(sides(size)))
        flown = rollout(nominal_model(TABLE_TENNIS), torch.from_numpy(states), torch.from_numpy(times), surfaces)
    places = flown[..., :3].numpy() + rng.normal(0.0, SIGMA, (count, len(times), 3))
    return [Track(times, place, name=f"{k:03d}") for k, place in enumerate(places)]


@pytest.mark.parametrize("size", [LONG_X, LONG_X[::-1]], ids=["long_x", "long_y"])
@pytest.mark.parametrize("rate", [60.0, 180.0])
def test_balls_that_leave_an_end_and_a_side_show_both(size, rate):
    found = find_table_extent(shots(size, (0.4, 0.4), rate=rate), HEIGHT, RADIUS)
    assert found is not None
    assert found.sides[0] == found.sides[2] == -math.inf
    error = np.array(found.sides)[[1, 3]] - sides(size)[[1, 3]]
    assert np.abs(error).max() < 0.1
    assert np.all(np.abs(error) < 3 * np.array(found.sigmas)[[1, 3]] + 0.01)
    assert found.bounces > 20
    assert found.falls > 5


def test_only_the_end_past_which_balls_fall_is_limited():
    found = find_table_extent(shots(LONG_X, (0.5, math.inf)), HEIGHT, RADIUS)
    assert found.sides[1] == pytest.approx(sides(LONG_X)[1], abs=0.05)
    assert np.isinf(np.array(found.sides)[[0, 2, 3]]).all()
    assert not np.array(found.sigmas)[[0, 2, 3]].any()


def test_without_balls_below_the_surface_no_end_is_known():
    assert find_table_extent(shots(LONG_X, NOWHERE), HEIGHT, RADIUS) is None


def test_one_ball_beside_the_table_is_enough():
    tracks = shots(LONG_X, NOWHERE, count=40)
    past = [t for t in shots(LONG_X, (0.6, math.inf), seed=1) if t.positions[-1, 2] < HEIGHT][:1]
    found = find_table_extent([*tracks, *past], HEIGHT, RADIUS)
    assert found.falls == 1
    assert found.sides[1] == pytest.approx(sides(LONG_X)[1], abs=0.3)


def test_a_fall_is_where_the_ball_was_a_quarter_of_the_depth_below_contact():
    """From 0.3 m above at 2 m/s along x; what is below by the whole depth did not touch the table."""
    t = np.arange(40) / 200.0
    falling = np.stack((2.0 * t, 0.5 - t, HEIGHT + 0.3 - 4.0 * t - 9.81 / 2 * t**2), axis=1)
    depth = 0.08
    when = (-4.0 + math.sqrt(16.0 + 2 * 9.81 * (0.3 + depth / 4))) / 9.81
    (place,) = _falls(t, falling, HEIGHT, depth)
    assert_allclose(place, [2.0 * when, 0.5 - when, HEIGHT - depth / 4], atol=1e-4)
    assert len(_falls(t, falling, HEIGHT - 1.0, depth)) == 0


def test_outliers_do_not_move_the_ends():
    tracks = shots(LONG_X, (0.5, math.inf))
    clean = find_table_extent(tracks, HEIGHT, RADIUS)
    rng = np.random.default_rng(3)
    hit = []
    for track in tracks:
        positions = track.positions.copy()
        positions[rng.random(len(positions)) < 0.02] += rng.normal(0.0, 0.3, 3)
        hit.append(Track(track.times, positions, name=track.name))
    assert_allclose(find_table_extent(hit, HEIGHT, RADIUS).sides, clean.sides, atol=0.03)


@pytest.mark.parametrize("shift", [-0.01, 0.01])
def test_a_height_that_is_a_little_wrong_makes_no_falls(shift):
    assert find_table_extent(shots(LONG_X, NOWHERE), HEIGHT + shift, RADIUS) is None


@pytest.mark.parametrize("height", [0.0, 0.5, 1.0])
def test_bounces_at_another_height_say_nothing(height):
    assert find_table_extent(shots(LONG_X, (0.5, 0.5)), height, RADIUS) is None


def test_a_table_of_another_size_is_not_forced_into_that_of_the_rules():
    square = (4.0, 4.0)
    assert find_table_extent(shots(square, (0.5, 0.5), count=150), HEIGHT, RADIUS) is None


def test_other_balls_have_no_table_of_this_size():
    assert find_table_extent(shots(LONG_X, (0.5, 0.5)), HEIGHT, TENNIS.radius) is None


def test_short_tracks_say_nothing():
    assert find_table_extent([], HEIGHT, RADIUS) is None
    assert find_table_extent([Track(np.arange(3) / 100, np.zeros((3, 3)))], 0.0, RADIUS) is None


def dataset(folder, tracks, extent=None):
    write_dataset(folder, DatasetInfo("shots", HEIGHT, TABLE_TENNIS, 120.0, SIGMA, table_extent=extent), tracks)
    return read_dataset(folder)


def test_a_dataset_states_its_table_or_shows_it(tmp_path):
    tracks = shots(LONG_X, (0.5, math.inf))
    shown = dataset(tmp_path / "shown", tracks)
    assert dataset_surfaces(shown).extent == find_table_extent(tracks, HEIGHT, RADIUS).sides
    assert "balls that fell past it" in table_note(shown)
    assert table_note(shown).startswith("the table ends at x = 1.7")
    assert "within x <= 1.7" in repr(bf.Smoother(nominal_model(TABLE_TENNIS), dataset_surfaces(shown)))
    stated = dataset(tmp_path / "stated", tracks, (-1.0, 1.7, 0.8, 2.4))
    assert dataset_surfaces(stated) == Surfaces(HEIGHT, HEIGHT - 0.76, (-1.0, 1.7, 0.8, 2.4), (0.01,) * 4)
    assert table_note(stated) is None


def test_a_ball_that_leaves_the_table_is_predicted_to_fall(tmp_path):
    """Predicted from its first 0.25 s, it no longer bounces in mid-air."""
    tracks = shots(LONG_X, (0.5, math.inf))
    past = next(t for t in tracks if t.positions[-1, 2] < HEIGHT - 0.2 and t.positions[-1, 0] > sides(LONG_X)[1] + 0.2)
    shown = dataset(tmp_path / "shown", tracks)
    errors = {}
    for name, surfaces in (("unlimited", HEIGHT), ("found", None)):
        (known,) = [found for found in bf.predict(shown, surfaces=surfaces).values() if found.name == past.name]
        errors[name] = np.linalg.norm(known.positions - known.measured, axis=1).max()
    assert errors["unlimited"] > 0.2
    assert errors["found"] < 0.06


@pytest.mark.skipif(not DATA.is_dir(), reason=f"no measured tracks at {DATA}; set BALLFG_DATA")
@pytest.mark.parametrize(
    ("name", "limited"),
    [
        ("aimy", ()),
        ("ballgun", ()),
        ("robot_rallies", (0, 1)),
        ("spindoe", (1, 2)),
    ],
)
def test_measured_sets(name, limited):
    """Where balls fell in the measured sets; the other sides stay open."""
    extent = dataset_surfaces(read_dataset(DATA / name)).extent
    finite = () if extent is None else tuple(np.flatnonzero(np.isfinite(extent)).tolist())
    assert finite == limited
