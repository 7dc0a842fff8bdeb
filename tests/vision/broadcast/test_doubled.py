"""Doubled pictures, variable frame rates and rotation flags, against the pictures that were written."""

from __future__ import annotations

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import looking, picture
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.pictures import without_doubled
from ballfg.vision.detection.video import open_video

CAMERA = looking((0.5, -8.0, 3.5), (0.0, 0.0, 0.0), 1000.0)


def flight(count: int) -> list[Image]:
    """Pictures of a ball that flies through them, and of a light that moves slowly."""
    rng = np.random.default_rng(2)
    balls = [np.array([[-1.0 + 0.1 * k, 0.0, 0.3], [-0.95 + 0.1 * k, 0.0, 0.3]]) for k in range(count)]
    return [picture(CAMERA, rng, [ball]) for ball in balls]


def written(path: Path, images: list[Image], rate: float) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, (images[0].shape[1], images[0].shape[0]))
    for image in images:
        writer.write(image)
    writer.release()
    return path


def test_pictures_doubled_by_a_conversion_are_left_out_and_the_others_are_even(tmp_path: Path) -> None:
    images = flight(25)
    doubled = [image for k, image in enumerate(images) for _ in range(2 if k % 5 == 4 else 1)]  # 25 Hz as 30 Hz
    video = open_video(written(tmp_path / "a.mp4", doubled, 30.0))
    kept = without_doubled(video.frames, video.count)
    assert kept.doubled == 5
    assert kept.numbers.tolist() == [k for k in range(30) if k % 6 != 5]
    stamps, shown = zip(*kept.frames(), strict=True)
    assert len(shown) == 25
    np.testing.assert_allclose(np.diff(stamps), 1.0 / 25.0, atol=0.0015)
    for image, true in zip(shown, images, strict=True):
        assert np.abs(image.astype(float) - true).mean() < 6.0


def test_single_doubled_pictures_leave_the_stamps_of_the_others(tmp_path: Path) -> None:
    images = flight(20)
    video = open_video(written(tmp_path / "a.mp4", [*images[:8], images[7], *images[8:]], 25.0))
    kept = without_doubled(video.frames, video.count)
    assert kept.numbers.tolist() == [k for k in range(21) if k != 8]
    assert [stamp for stamp, _ in kept.frames()] == pytest.approx([k / 25.0 for k in range(21) if k != 8])


@pytest.mark.parametrize("name", ["flight", "black"])
def test_nothing_is_left_out_where_nothing_is_doubled(name: str, tmp_path: Path) -> None:
    images = flight(12) if name == "flight" else [np.zeros((90, 160, 3), np.uint8)] * 12
    video = open_video(written(tmp_path / "a.mp4", images, 25.0))
    kept = without_doubled(video.frames, video.count)
    assert (kept.doubled, len(kept.numbers)) == (0, 12)


def test_the_rotation_flag_of_a_phone_is_followed(tmp_path: Path) -> None:
    image = np.zeros((96, 160, 3), np.uint8)
    image[:40, :60] = 255
    path = written(tmp_path / "a.mp4", [image] * 3, 25.0)
    content = bytearray(path.read_bytes())
    matrix = content.index(b"tkhd") + 4 + 40  # of a track header of version 0 (ISO 14496-12)
    quarter = [0, 1 << 16, 0, -(1 << 16), 0, 0, 96 << 16, 0, 1 << 30]
    content[matrix : matrix + 36] = struct.pack(">9i", *quarter)
    path.write_bytes(content)
    video = open_video(path)
    assert video.size == (96, 160)
    (_, shown) = next(iter(video.frames()))
    assert np.abs(shown.astype(float) - np.rot90(image, -1)).mean() < 6.0
