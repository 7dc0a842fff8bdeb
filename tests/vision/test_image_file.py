"""Images: their headers decide whether they are decoded."""

import struct
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.vision import open_video
from ballfg.vision.image_file import ENDINGS, read_image
from tests.faults.bombs_of_others import avi


@pytest.mark.parametrize("ending", ENDINGS)
def test_every_ending_is_read(tmp_path: Path, ending: str) -> None:
    """The decoder's own pixels, in a size that no other axis has."""
    path = tmp_path / f"a{ending}"
    shape = (6, 10) if ending == ".pgm" else (6, 10, 3)
    image = np.random.default_rng(0).integers(0, 255, shape, dtype=np.uint8)
    assert cv2.imwrite(str(path), image)
    np.testing.assert_array_equal(read_image(path, cv2.IMREAD_COLOR), cv2.imread(str(path), cv2.IMREAD_COLOR))
    assert read_image(path, cv2.IMREAD_GRAYSCALE).shape == (6, 10)


def test_a_header_of_many_pixels_is_enough(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Nothing is decoded: OpenCV is not asked."""
    monkeypatch.setattr(cv2, "imdecode", None)
    path = tmp_path / "a.bmp"
    for side, words in ((8001, "at most 64 million pixels; it says 8001 x 8001"), (30_000, "Image size")):
        path.write_bytes(b"BM" + struct.pack("<IHHIIiiHHIIiiII", 54, 0, 0, 54, 40, side, side, 1, 24, 0, 0, 0, 0, 0, 0))
        with pytest.raises(ValueError, match=rf"a\.bmp .*{words}"):
            read_image(path, cv2.IMREAD_COLOR)


def test_a_video_whose_frames_are_larger_than_its_header_says(tmp_path: Path) -> None:
    frame = cv2.imencode(".jpg", np.zeros((9000, 9000), np.uint8))[1].tobytes()
    avi(tmp_path / "a.avi", [frame, frame], 48, 32)
    with pytest.raises(ValueError, match=r"a\.avi must have at most 64 million pixels; it says 9000 x 9000"):
        open_video(tmp_path / "a.avi")
