"""What a user gives for a video of a moving camera belongs to its pictures, or is refused."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.dynamics import nominal_model
from ballfg.estimation.rally.video import track_moving_camera
from ballfg.vision.broadcast.court import read_corners, read_court
from ballfg.vision.broadcast.motion import Shot
from ballfg.vision.broadcast.pictures import Kept, read_candidates, without_doubled
from ballfg.vision.broadcast.pinhole import Pinhole
from ballfg.vision.detection.video import open_video
from tests.vision.broadcast.test_doubled import flight, written

CAMERA = Pinhole(np.eye(3), np.zeros(3), 1000.0, (1280, 720))


def of_all(kept: Kept) -> Shot:
    count = len(kept.numbers)
    return Shot(0, (CAMERA,) * count, np.zeros((count, 7, 7)), np.ones(count))


def test_candidates_of_a_doubled_video_belong_to_the_pictures_that_they_were_found_in(tmp_path: Path) -> None:
    """24 Hz as 30 Hz: even stamps are up to 25 ms before those of the file, more than half a picture."""
    images = flight(24)
    film = [image for k, image in enumerate(images) for _ in range(2 if k % 4 == 3 else 1)]
    truth = [k for k in range(24) for _ in range(2 if k % 4 == 3 else 1)]
    video = open_video(written(tmp_path / "a.mp4", film, 30.0))
    kept = without_doubled(video.frames, video.count)
    assert kept.doubled == 6
    times = np.array([stamp for stamp, _ in kept.frames()])
    assert np.abs(times - kept.stamps[kept.numbers]).max() > 0.02
    rows = "".join(f"{stamp:.4f},{10 * k},5\n" for (stamp, _), k in zip(video.frames(), truth, strict=True))
    (tmp_path / "own.csv").write_text("t,u,v\n" + rows)
    found = read_candidates(tmp_path / "own.csv", of_all(kept), times, kept)
    np.testing.assert_array_equal(found.frame, np.arange(24))
    np.testing.assert_array_equal(found.pixels[:, 0], 10.0 * np.arange(24))


@pytest.mark.parametrize(("unit", "row"), [(25.0, 3), (1e3, 2)])
def test_stamps_in_another_unit_are_refused(unit: float, row: int, tmp_path: Path) -> None:
    """In pictures or ms; the third picture of 1 s is at 0.08 s."""
    stamps = np.arange(25) / 25.0
    kept = Kept(lambda: iter(()), np.arange(25), stamps)
    path = tmp_path / "own.csv"
    path.write_text("t,u,v\n" + "".join(f"{unit * t},1,2\n" for t in stamps))
    with pytest.raises(ValueError, match=rf"row {row}: t must be the stamp of a picture of the video, 0 to 0.96 s"):
        read_candidates(path, of_all(kept), stamps, kept)
    path.write_text("t,u,v\n" + "".join(f"{t},1,2\n" for t in stamps))
    assert read_candidates(path, of_all(kept), stamps, kept).frame.tolist() == list(range(25))


def test_corners_of_no_picture_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "corners.csv"
    path.write_text("frame,u,v\n" + "".join(f"4.5,{u},{v}\n" for u, v in ((1, 1), (9, 1), (9, 9), (1, 9))))
    with pytest.raises(ValueError, match=r"line 2: frame must be a picture's number, from 0 on; got 4.5"):
        read_corners(path)
    writer = cv2.VideoWriter(str(tmp_path / "a.mp4"), cv2.VideoWriter.fourcc(*"mp4v"), 25.0, (160, 96))
    for grey in range(5):
        writer.write(np.full((96, 160, 3), 40 * grey, np.uint8))
    writer.release()
    video = open_video(tmp_path / "a.mp4")
    path.write_text(path.read_text().replace("4.5", "5"))
    with pytest.raises(ValueError, match=r"corners must be of pictures 0 to 4 of the video; got picture 5"):
        track_moving_camera(
            video.frames, read_court("table-tennis"), nominal_model(), count=video.count, corners=read_corners(path)
        )
