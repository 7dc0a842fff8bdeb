"""Videos: stamps from containers and CSV files, folders of images, and what is refused."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.vision.detection.video import Video, open_video

SIZE = (64, 48)


def frame(number: int, size: tuple[int, int] = SIZE) -> np.ndarray:
    image = np.full((size[1], size[0], 3), 40, dtype=np.uint8)
    image[:, : number % size[0]] = 200
    return image


def film(path: Path, codec: str = "mp4v", rate: float = 120.0, count: int = 30) -> Path:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), rate, SIZE)
    for number in range(count):
        writer.write(frame(number))
    writer.release()
    return path


def stamps(path: Path, times: Sequence[object], header: str = "t") -> Path:
    path.write_text("\n".join([header, *map(str, times)]) + "\n", encoding="utf-8")
    return path


def pictures(folder: Path, count: int = 12) -> Path:
    folder.mkdir()
    for number in range(count):
        cv2.imwrite(str(folder / f"shot{number}.png"), frame(number))
    return folder


@pytest.mark.parametrize(("name", "codec"), [("left.mp4", "mp4v"), ("left.avi", "MJPG")])
def test_container_stamps_are_the_frames(tmp_path: Path, name: str, codec: str) -> None:
    video = open_video(film(tmp_path / name, codec))
    seen = list(video.frames())
    assert (video.name, video.size, video.count, len(seen)) == ("left", SIZE, 30, 30)
    np.testing.assert_allclose([stamp for stamp, _ in seen], np.arange(30) / 120, atol=1e-5)
    widths = [int((image[24, :, 0] > 120).sum()) for _, image in seen]
    assert np.abs(np.array(widths) - np.arange(30)).max() <= 1


def test_stamps_of_a_file_take_the_place_of_the_containers(tmp_path: Path) -> None:
    times = 100.0 + np.cumsum(np.random.default_rng(0).uniform(0.005, 0.02, 30))
    rows = [f"{number},{t!r},x" for number, t in enumerate(times.tolist())]
    video = open_video(film(tmp_path / "a.mp4"), stamps(tmp_path / "a.csv", rows, "frame,t,note"))
    assert [stamp for stamp, _ in video.frames()] == times.tolist()
    assert len(list(video.frames())) == 30  # a video can be read again


def test_folder_of_images_is_read_in_natural_order(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "right")
    (folder / "notes.txt").write_text("not an image", encoding="utf-8")
    video = open_video(folder, stamps(tmp_path / "s.csv", np.arange(12) / 60))
    seen = list(video.frames())
    assert (video.name, video.size, video.count) == ("right", SIZE, 12)
    for number, (stamp, image) in enumerate(seen):
        assert stamp == number / 60
        np.testing.assert_array_equal(image, frame(number))


def test_grey_images_come_as_colour(tmp_path: Path) -> None:
    (tmp_path / "grey").mkdir()
    for number in range(3):
        cv2.imwrite(str(tmp_path / "grey" / f"{number}.png"), frame(number)[..., 0])
    video = open_video(tmp_path / "grey", stamps(tmp_path / "s.csv", [0, 1, 2]))
    assert [image.shape for _, image in video.frames()] == [(48, 64, 3)] * 3


def test_sample_is_spread_over_the_recording(tmp_path: Path) -> None:
    video = open_video(film(tmp_path / "a.mp4"))
    widths = [int((image[24, :, 0] > 120).sum()) for image in video.sample(5)]
    assert np.abs(np.array(widths) - [0, 6, 12, 18, 24]).max() <= 1
    folder = open_video(pictures(tmp_path / "b"), stamps(tmp_path / "s.csv", np.arange(12)))
    np.testing.assert_array_equal(folder.sample(3)[2], frame(8))
    assert len(folder.sample(100)) == 12


def test_missing_and_unreadable_videos_are_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"video .*none\.mp4 does not exist"):
        open_video(tmp_path / "none.mp4")
    (tmp_path / "text.mp4").write_text("not a video", encoding="utf-8")
    with pytest.raises(ValueError, match=r"text\.mp4 must be a file that FFmpeg decodes"):
        open_video(tmp_path / "text.mp4")
    whole = film(tmp_path / "whole.mp4").read_bytes()
    (tmp_path / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match=r"cut\.mp4 must be a file that FFmpeg decodes; it is not, or it is cut off"):
        open_video(tmp_path / "cut.mp4")


def test_truncated_video_is_noticed_and_readable_with_stamps(tmp_path: Path) -> None:
    whole = film(tmp_path / "whole.avi", "MJPG", count=60).read_bytes()
    cut = tmp_path / "cut.avi"
    cut.write_bytes(whole[: len(whole) // 2])
    video = open_video(cut)
    with pytest.raises(ValueError, match=r"cut\.avi must be whole; it announces 60 frames and ends after \d+"):
        list(video.frames())
    count = 0
    with pytest.raises(ValueError, match="must be whole"):  # noqa: PT012
        for _ in video.frames():
            count += 1
    with_stamps = open_video(cut, stamps(tmp_path / "s.csv", np.arange(count)))
    assert len(list(with_stamps.frames())) == count


@pytest.mark.parametrize(
    ("rows", "header", "message"),
    [
        ([0, 1, 1, 2], "t", r"line 4: t must increase; frame 2 has 1\.0 s after 1\.0 s"),
        ([0, "x", 2], "t", r"line 3: t must be a finite number of seconds; got 'x'"),
        ([0, "nan", 2], "t", r"line 3: t must be a finite number"),
        (["0,0", "2,1"], "frame,t", r"line 3: frame must count from 0; got '2' for 1"),
        ([1, 2], "time", r"must have a column t \(s\); got time"),
        ([], "t", r"must have one row a frame; got none"),
    ],
)
def test_bad_files_of_stamps_are_refused(tmp_path: Path, rows: list[object], header: str, message: str) -> None:
    path = film(tmp_path / "a.mp4", count=3)
    with pytest.raises(ValueError, match=message):
        open_video(path, stamps(tmp_path / "s.csv", rows, header))


def test_missing_file_of_stamps_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match="file of stamps"):
        open_video(film(tmp_path / "a.mp4", count=3), tmp_path / "none.csv")


@pytest.mark.parametrize(("rows", "found"), [(29, "more"), (31, "only 30")])
def test_stamps_must_be_as_many_as_the_frames(tmp_path: Path, rows: int, found: str) -> None:
    video = open_video(film(tmp_path / "a.mp4"), stamps(tmp_path / "s.csv", range(rows)))
    with pytest.raises(ValueError, match=rf"a\.mp4 has {found} frames and the file {rows} rows"):
        list(video.frames())


def test_bad_folders_are_refused(tmp_path: Path) -> None:
    folder = pictures(tmp_path / "a")
    with pytest.raises(ValueError, match="stamps must be given for a folder"):
        open_video(folder)
    for rows, found in ((13, "only 12"), (11, "12")):
        with pytest.raises(ValueError, match=rf"has {found} frames and the file {rows} rows"):
            open_video(folder, stamps(tmp_path / "s.csv", range(rows)))
    (tmp_path / "empty").mkdir()
    with pytest.raises(ValueError, match="must hold images"):
        open_video(tmp_path / "empty", stamps(tmp_path / "s.csv", range(12)))
    cv2.imwrite(str(folder / "shot5.png"), frame(5, (32, 48)))
    with pytest.raises(ValueError, match=r"images of .* must have one size; shot5\.png has \(32, 48\)"):
        list(open_video(folder, stamps(tmp_path / "s.csv", range(12))).frames())
    (folder / "shot5.png").write_text("no", encoding="utf-8")
    with pytest.raises(ValueError, match=r"shot5\.png must be readable"):
        list(open_video(folder, stamps(tmp_path / "s.csv", range(12))).frames())


class Unreadable(Video):
    """A recording none of whose frames can be decoded."""

    def sample(self, count: int) -> list[np.ndarray]:
        return []

    def _decoded(self) -> Iterator[tuple[float, np.ndarray]]:
        yield from ()


def test_a_recording_without_a_readable_frame_has_none() -> None:
    with pytest.raises(ValueError, match="it announces 30 frames and ends after 0"):
        list(Unreadable(Path("a.mp4"), SIZE, 30, None).frames())
    with pytest.raises(ValueError, match="has only 0 frames and the file 3 rows"):
        list(Unreadable(Path("a.mp4"), SIZE, 30, np.arange(3.0)).frames())
