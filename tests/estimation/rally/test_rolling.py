"""A rolling shutter of a camera that turns: candidates as a camera sees them that does not, and the time of each."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import COURT, looking
from ballfg.benchmarks.cameras.strokes import MODEL
from ballfg.estimation.rally.reconstruct import fixed_camera, on_fixed_camera, reconstruct
from ballfg.estimation.rally.video import surfaces_of
from ballfg.vision.broadcast.lines import moved
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.detection.detections import Candidates, Detections

CAMERA, STEP, READOUT = looking((0.5, -7.0, 3.0), (0.0, 0.0, 0.0), 1000.0), 0.04, 0.6
TURN = 0.012  # rad a picture


def at(moment: float):
    return moved(CAMERA, np.array([0.0, TURN * moment, 0.0, 0.0, 0.0, 0.0, 0.0]))


def late(pixel: np.ndarray) -> float:
    """Of the time between pictures, by which the row of a pixel (2,) is seen after the middle one."""
    return READOUT * float((pixel[1] + 0.5) / CAMERA.size[1] - 0.5)


def seen(number: int, place) -> np.ndarray:
    """(2,) px where a picture shows what is at place(t) m at a time t, s: as its row is read."""
    pixel = at(number).project(place(number * STEP))
    for _ in range(8):
        moment = number + late(pixel)
        pixel = at(moment).project(place(moment * STEP))
    return pixel


def shot_of(readout: float, count: int = 12) -> Shot:
    cameras = tuple(at(k) for k in range(count))
    return Shot(0, cameras, np.tile(1e-8 * np.eye(7), (count, 1, 1)), np.ones(count), readout=readout)


def test_what_stands_still_stands_still_for_the_camera_that_does_not_turn() -> None:
    places = np.array([[-1.0, 0.5, 0.0], [1.0, -0.5, 0.8], [0.0, 2.0, 2.0]])
    frames = [
        (STEP * k, Candidates.at([seen(k, lambda _, place=place: place) for place in places], 0.5)) for k in range(12)
    ]
    found = Detections.of_frames("main", frames)
    for readout, most in ((READOUT, 0.1), (0.0, np.inf)):
        shot = shot_of(readout)
        pinhole, _ = fixed_camera(shot, "main")
        pixels = on_fixed_camera(found, shot, pinhole, "main").pixels.reshape(12, 3, 2)
        off = np.abs(pixels - pinhole.project(places)).max()
        assert off < most
    assert off > 2.0  # px, of the camera whose rows are all seen at once


def test_the_camera_of_a_reconstruction_reads_each_row_in_its_time() -> None:
    def place(t: float) -> np.ndarray:
        return np.array([-1.0 + 6.0 * t, 0.1, 0.5 + 1.0 * t - 4.9 * t * t])

    frames = [(STEP * k, Candidates.at([seen(k, place)], 0.5)) for k in range(12)]
    found = reconstruct(Detections.of_frames("main", frames), shot_of(READOUT), MODEL, surfaces_of(COURT))
    assert found.camera.readout == pytest.approx(READOUT * STEP)
    times = found.camera.true_times(found.seen.times, found.seen.pixels)
    true = found.camera.project(np.array([place(float(t)) for t in times]))
    assert np.abs(found.seen.pixels - true).max() < 0.3
