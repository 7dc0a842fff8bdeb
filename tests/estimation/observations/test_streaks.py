"""Streaks: their ends as sightings, which way they point, files that hold them, and what they add."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.estimation import Settings, Smoother, read_sighted, sighted_track
from ballfg.estimation.observations.rig import with_ends
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.tracks.sightings import Sightings
from ballfg.vision.camera_file import write_cameras
from ballfg.vision.detection.detections import read_detections
from tests.diagnosis.one_view.filmed import CAMERA, strokes, write_folder
from tests.estimation.observations.sighted_rig import RIG, TABLE, world

OPEN = 0.01  # s


def moving(streaks: np.ndarray, cameras: tuple[str, ...] = ("left",)) -> Sightings:
    """A ball that goes right by 20 px a frame of 20 ms, turns back after the third, with these streaks."""
    pixels = np.array([[100.0, 50.0], [120.0, 50.0], [140.0, 50.0], [120.0, 50.0]])
    own = (np.zeros(4, dtype=np.int64), 0.02 * np.arange(4.0), pixels, np.tile(np.diag([1.0, 4.0]), (4, 1, 1)))
    return Sightings(cameras, *own, radii=np.array([[3.0, 0.1]] * 4), streaks=streaks)


def test_both_ends_take_the_place_of_the_middle_in_order_of_time() -> None:
    exposed = (replace(RIG[0], exposure=OPEN),)
    found = with_ends(moving(np.array([[10.0, 0.0], [-10.0, 2.0], [10.0, 0.0], [0.0, 0.0]])), exposed)
    assert found.times.tolist() == pytest.approx([-0.005, 0.005, 0.015, 0.025, 0.04, 0.06])  # at the turn the middle
    assert found.pixels.tolist() == [[95, 50], [105, 50], [115, 51], [125, 49], [140, 50], [120, 50]]
    assert [matrix[0, 0] for matrix in found.covariances] == [2.0, 2.0, 2.0, 2.0, 1.0, 1.0]
    assert found.radii is not None
    assert found.radii.shape == (6, 2)
    assert found.streaks is None


def test_without_an_exposure_or_a_streak_nothing_changes() -> None:
    seen = moving(np.full((4, 2), 9.0))
    for given, cameras in ((seen, (RIG[0],)), (replace(seen, streaks=None), (replace(RIG[0], exposure=OPEN),))):
        found = with_ends(given, cameras)
        np.testing.assert_array_equal(found.times, seen.times)
        np.testing.assert_array_equal(found.pixels, seen.pixels)


def test_what_cannot_be_is_refused() -> None:
    with pytest.raises(ValueError, match=r"exposure must be shorter than the 0.02 s between two sightings; got 0.03 s"):
        with_ends(moving(np.full((4, 2), 9.0)), (replace(RIG[0], exposure=0.03),))
    with pytest.raises(ValueError, match=r"streaks must be finite; streaks\[1\]=\[nan, 1.0\]. Give 0 for unknown"):
        moving(np.array([[1.0, 1.0], [np.nan, 1.0], [1.0, 1.0], [1.0, 1.0]]))


def test_a_dataset_with_streaks_is_read_and_its_depth_is_better_known(tmp_path: Path) -> None:
    tracks = strokes(3, 8)
    folder = write_folder(tmp_path / "plain", tracks)
    ball = world()
    surfaces = replace(ball.surfaces, extent=(-1.37, 1.37, -0.7625, 0.7625))
    plain = read_sighted(folder)
    lines = (folder / "detections.csv").read_text().splitlines()
    rows = [line.split(",") for line in lines[1:]]
    column = {name: number for number, name in enumerate(lines[0].split(","))}
    smoother = Smoother(ball.model, surfaces, Settings.for_measured(ball.model))
    states = {one.name: smoother.estimate(one) for one in plain}
    for row in rows:
        one, t = states[row[column["trajectory"]]], float(row[column["t"]])
        at = int(np.argmin(np.abs(one.times - t)))
        ends = one.states[at, :3] + 0.5 * OPEN * np.array([[-1.0], [1.0]]) * one.states[at, 3:6]
        first, last = CAMERA.project(ends)
        row += [repr(float(last[0] - first[0])), repr(float(last[1] - first[1]))]
    text = "\n".join([lines[0] + ",streak_u,streak_v", *(",".join(row) for row in rows)])
    (folder / "detections.csv").write_text(text + "\n")
    write_cameras(folder / "cameras.yaml", [replace(CAMERA, exposure=OPEN)])
    exposed = read_sighted(folder)
    assert exposed.notes == plain.notes
    for one in exposed:
        assert len(sightings_of(one)) > 1.8 * len(sightings_of(plain[one.name]))
        better = smoother.estimate(one)
        assert better.sigmas[:, :3].mean() < states[one.name].sigmas[:, :3].mean()
    ((seen,), _) = read_detections(folder / "detections.csv", [CAMERA])
    way = seen.streaks[:, 1] - seen.streaks[:, 0]
    given = np.array([[float(row[-2]), float(row[-1])] for row in rows])
    assert np.isfinite(way).all()
    np.testing.assert_allclose(np.sort(way[:, 0]), np.sort(given[:, 0]), atol=1e-9)
    np.testing.assert_allclose(seen.streaks.mean(axis=1), seen.pixels, atol=1e-9)


def test_the_track_of_the_ends_is_that_of_two_sightings_a_frame() -> None:
    (track,) = strokes(1, 9)
    seen = sightings_of(track).sightings
    way = np.gradient(seen.pixels, seen.times, axis=0) * OPEN
    times = (seen.times[:, None] + 0.5 * OPEN * np.array([-1.0, 1.0])).ravel()
    pixels = (seen.pixels[:, None] + 0.5 * way[:, None] * np.array([[-1.0], [1.0]])).reshape(-1, 2)
    exposed, rng = replace(CAMERA, exposure=OPEN), np.random.default_rng(0)
    made = with_ends(replace(seen, streaks=way * rng.choice([-1.0, 1.0], (len(way), 1))), [exposed])
    ends = ~np.isin(made.times.round(9), seen.times.round(9))
    assert ends.sum() >= 2 * (len(seen) - 2)  # but for the bounce
    rows = np.abs(np.subtract.outer(made.times[ends], times)).argmin(axis=1)
    np.testing.assert_allclose(made.pixels[ends], pixels[rows], atol=1e-9)
    one = sighted_track("a", made, [exposed], surfaces=replace(world().surfaces, table_height=TABLE))
    np.testing.assert_allclose(one.times, made.times, atol=1e-12)
