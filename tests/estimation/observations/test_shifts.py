"""Cameras that move: against a camera that stands there, against a standing one, in files, and what is refused."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from ballfg.benchmarks.cameras.strokes import MODEL, SURFACES
from ballfg.estimation import Settings, Smoother, read_sighted, sighted_track
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.state import POSITION
from ballfg.tracks import Track
from ballfg.tracks.sightings import Sightings
from ballfg.vision.association.associate import associate
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Candidates, Detections, read_detections
from tests.diagnosis.one_view.filmed import CAMERA, strokes, write_folder
from tests.estimation.observations.sighted_rig import RIG

SMOOTHER = Smoother(MODEL, SURFACES, Settings.for_measured(MODEL))


def at(shift: np.ndarray) -> Camera:
    """The camera, calibrated where it stood."""
    return replace(CAMERA, tvec=CAMERA.tvec - CAMERA.rotation @ shift)


def seen_from(seen: Sightings, camera: Camera = CAMERA) -> Track:
    return sighted_track("a", seen, [camera], model=MODEL, surfaces=SURFACES)


def test_a_camera_that_moved_once_is_one_that_stands_there() -> None:
    (track,), shift = strokes(1, 4), np.array([0.3, -0.2, 0.1])
    seen = sightings_of(track).sightings
    there = SMOOTHER.estimate(seen_from(seen, at(shift)))
    moved = SMOOTHER.estimate(seen_from(replace(seen, shifts=np.tile(shift, (len(seen), 1)))))
    np.testing.assert_allclose(moved.states, there.states, atol=1e-6)
    np.testing.assert_allclose(moved.covariances, there.covariances, rtol=1e-4, atol=1e-9)
    assert moved.status == there.status


def test_a_flight_seen_from_a_moving_camera_is_the_same_as_from_a_standing_one() -> None:
    """Each pixel moves by what the moving camera sees differently, so that the noise is the same."""
    for number, track in enumerate(strokes(4, 5)):
        seen, still = sightings_of(track).sightings, SMOOTHER.estimate(track)
        shifts = np.cumsum(np.random.default_rng(number).normal(0.02, 0.02, (len(seen), 3)), axis=0)
        points = still.states[:, POSITION]
        there = np.array([at(shift).project(point) for shift, point in zip(shifts, points, strict=True)])
        moved = replace(seen, pixels=seen.pixels - CAMERA.project(points) + there, shifts=shifts)
        estimate = SMOOTHER.estimate(seen_from(moved))
        assert (np.abs(estimate.states - still.states) < 0.7 * still.sigmas).all()
        ignored = SMOOTHER.estimate(seen_from(replace(moved, shifts=None)))
        assert (np.abs(ignored.states - still.states) > 3.0 * still.sigmas).any()


def test_a_dataset_holds_where_the_camera_stood(tmp_path: Path) -> None:
    tracks = strokes(2, 6)
    folder = write_folder(tmp_path / "moved", tracks)
    lines = (folder / "detections.csv").read_text().splitlines()
    rows = [f"{line},{0.01 * k!r},0.0,-0.02" for k, line in enumerate(lines[1:])]
    text = "\n".join([lines[0] + ",shift_x,shift_y,shift_z", *rows])
    (folder / "detections.csv").write_text(text + "\n")
    data = read_sighted(folder)
    assert data.notes == []
    for first, one in zip((0, len(tracks[0])), data, strict=True):
        shifts = sightings_of(one).sightings.shifts
        assert shifts is not None
        np.testing.assert_allclose(shifts[:, 0], 0.01 * (first + np.arange(len(one))))
        np.testing.assert_allclose(shifts[:, 1:], [[0.0, -0.02]] * len(one))
    (folder / "detections.csv").write_text("\n".join([lines[0] + ",shift_x,shift_y,shift_z", *rows[: len(tracks[0])]]))
    ((seen,), notes) = read_detections(folder / "detections.csv", [CAMERA])
    assert notes == []
    assert seen.shift is not None
    np.testing.assert_allclose(seen.shift[:, 0], 0.01 * np.arange(len(seen)))


def test_what_cannot_be_is_refused() -> None:
    one = Detections.of_frames("left", [(0.02 * k, Candidates.at([[9.0, 9.0]], 0.5)) for k in range(4)])
    moved = replace(one, shifts=np.zeros((4, 3)))
    with pytest.raises(ValueError, match="'left' must stand where the calibration has it; its detections have shifts"):
        associate([moved, replace(one, camera="right")], RIG[:2])
    with pytest.raises(ValueError, match="shifts must be finite"):
        replace(one, shifts=np.full((4, 3), np.nan))
    seen = sightings_of(strokes(1, 4)[0]).sightings
    with pytest.raises(ValueError, match=r"shifts must be finite; shifts\[0\]=\[nan, nan, nan\]. Give 0 for none"):
        replace(seen, shifts=np.full((len(seen), 3), np.nan))
