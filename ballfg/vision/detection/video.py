"""Reads frames with their stamps, from a video file or a folder of images and its CSV file."""

import re
from abc import ABC, abstractmethod
from collections.abc import Generator, Iterator, Sequence
from os import PathLike
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.checks import check_path, listed, shown
from ballfg.files.damaged import check_pixels
from ballfg.parallel.parts import read_ahead
from ballfg.tracks import csv_files
from ballfg.tracks.checks import check_step
from ballfg.vision.arrays import Image
from ballfg.vision.image_file import ENDINGS, read_image

SHORT: Final = (3, 0.02)  # frames, and share, that may be missing at the end of what the container announces


class Video(ABC):
    """Frames of one camera, which can be read more than once.

    Args: stamps: (f,) s, of its frames; None: those of the container.

    Attributes:
        name: the file's or folder's, without ending.
        path: of it.
        size: width and height, px.
        count: frames; where stamps come from the container, what it announces.
    """

    def __init__(self, path: Path, size: tuple[int, int], count: int, stamps: Array | None) -> None:
        self.name, self.path = path.stem if path.is_file() else path.name, path
        self.size, self.count, self._stamps = size, count, stamps

    def frames(self) -> Iterator[tuple[float, Image]]:
        """Stamp (s) and image (h, w, 3), BGR, of each frame in turn.

        Raises: ValueError: stamps that do not increase, an image of another size, frames that are fewer or more than
            the stamps or, by over 2 %, fewer than announced.
        """
        last, number = -np.inf, -1
        for number, (stamp, image) in enumerate(read_ahead(self._decoded())):
            if self._stamps is not None:
                if number >= len(self._stamps):
                    raise ValueError(self._mismatch("more"))
                stamp = float(self._stamps[number])
            if not stamp > last:
                problem = f"stamps of {self.path} must increase; frame {number} has {stamp:.6f} s after {last:.6f} s"
                raise ValueError(f"{problem}. Give a CSV file with the stamps of the frames.")
            last = stamp
            yield stamp, image
        self._check_count(number + 1)

    def _check_count(self, read: int) -> None:
        if self._stamps is not None and read < len(self._stamps):
            raise ValueError(self._mismatch(f"only {read}"))
        if self._stamps is None and self.count - read > max(SHORT[0], SHORT[1] * self.count):
            problem = f"video {self.path} must be whole; it announces {self.count} frames and ends after {read}"
            raise ValueError(f"{problem}. Copy it again, or give a CSV file with stamps for those that are there.")

    def _mismatch(self, found: str) -> str:
        rows = 0 if self._stamps is None else len(self._stamps)
        return f"stamps must have one row a frame; {self.path} has {found} frames and the file {rows} rows. Correct it."

    @abstractmethod
    def sample(self, count: int) -> list[Image]:
        """Images spread over the recording. Returns: images (h, w, 3) uint8, at most `count`."""

    @abstractmethod
    def _decoded(self) -> Generator[tuple[float, Image], None, None]:
        """Each frame with the container's stamp."""


class VideoFile(Video):
    """Frames of a file that OpenCV's FFmpeg decodes. See `open_video`."""

    def __init__(self, path: Path, stamps: Array | None) -> None:
        capture = _capture(path)
        there, image = capture.read()
        if not there:
            raise ValueError(f"video {path} must have at least one frame that can be decoded; got none. Convert it.")
        count = max(int(capture.get(cv2.CAP_PROP_FRAME_COUNT)), 1)
        capture.release()
        super().__init__(path, (image.shape[1], image.shape[0]), count if stamps is None else len(stamps), stamps)

    def sample(self, count: int) -> list[Image]:
        """At most `count` images spread over the recording; those at its start where the file cannot be wound."""
        capture = _capture(self.path)
        images: list[Image] = []
        for turn in range(min(count, self.count)):
            capture.set(cv2.CAP_PROP_POS_FRAMES, turn * self.count // min(count, self.count))
            there, image = capture.read()
            if there:
                images.append(np.asarray(image, dtype=np.uint8))
        capture.release()
        return images

    def _decoded(self) -> Generator[tuple[float, Image], None, None]:
        capture = _capture(self.path)
        try:
            while (read := capture.read())[0]:
                yield 1e-3 * capture.get(cv2.CAP_PROP_POS_MSEC), np.asarray(read[1], dtype=np.uint8)
        finally:
            capture.release()


class ImageFolder(Video):
    """Frames of a folder of images, in the natural order of their names (2 before 10). See `open_video`."""

    def __init__(self, path: Path, stamps: Array) -> None:
        self._files = sorted((file for file in path.iterdir() if file.suffix.lower() in ENDINGS), key=_natural)
        if not self._files:
            raise ValueError(f"folder {path} must hold images ({', '.join(ENDINGS)}); got none. Check the path.")
        image = read_image(self._files[0], cv2.IMREAD_COLOR)
        super().__init__(path, (image.shape[1], image.shape[0]), len(self._files), stamps)
        self._check_count(len(self._files))
        if len(self._files) > len(stamps):
            raise ValueError(self._mismatch(f"{len(self._files)}"))

    def sample(self, count: int) -> list[Image]:
        """At most `count` images spread over the recording."""
        few = min(count, self.count)
        return [self._image(self._files[turn * self.count // few]) for turn in range(few)]

    def _decoded(self) -> Generator[tuple[float, Image], None, None]:
        return ((np.nan, self._image(file)) for file in self._files)

    def _image(self, file: Path) -> Image:
        image = read_image(file, cv2.IMREAD_COLOR)
        size = (image.shape[1], image.shape[0])
        if size != self.size:
            what = f"images of {self.path} must have one size"
            raise ValueError(f"{what}; {file.name} has {size}, the first {self.size}.")
        return image


def open_video(path: str | PathLike[str], stamps: str | PathLike[str] | None = None) -> Video:
    """Opens a video file or a folder of images.

    Args:
        path: a file that FFmpeg decodes, or a folder.
        stamps: a CSV file with a column `t` (s), one row a frame, optionally a column `frame` that counts from 0.
            Without it the container's stamps count: mp4 and avi keep them, webm rounds to ms. A folder needs it.
    Raises: FileNotFoundError: nothing is there. ValueError: it cannot be decoded, is empty, or the stamps do not fit.
    """
    place = check_path("video", path)
    if not place.exists():
        raise FileNotFoundError(f"video {place} does not exist. Check the path.")
    times = None if stamps is None else read_stamps(check_path("stamps", stamps))
    if place.is_file():
        return VideoFile(place, times)
    if times is None:
        raise ValueError(f"stamps must be given for a folder of images; got none for {place}. Pass a CSV file.")
    return ImageFolder(place, times)


def read_stamps(path: Path) -> Array:
    """(f,) s of column `t` of a CSV file; `frame` counts from 0. Raises: FileNotFoundError. ValueError: a bad row."""
    if not path.is_file():
        raise FileNotFoundError(f"file of stamps {path} does not exist. Check the path.")
    names = [name.strip() for name in csv_files.read_header(path)]
    if "t" not in names:
        raise ValueError(f"{path} must have a column t (s); got {listed(names)}. Name it in line 1.")
    stamps: list[float] = []
    for line, cells in csv_files.records(path):
        where = f"{path}, line {line}"
        row = dict(zip(names, (cell.strip() for cell in cells), strict=False))
        if "frame" in names and row.get("frame") != str(len(stamps)):
            raise ValueError(
                f"{where}: frame must count from 0; got {shown(row.get('frame'))} for {len(stamps)}. Sort the rows."
            )
        if not csv_files.is_number(row.get("t", "")):
            raise ValueError(f"{where}: t must be a finite number of seconds; got {shown(row.get('t'))}. Correct it.")
        stamps.append(float(row["t"]))
        if len(stamps) > 1 and not stamps[-1] > stamps[-2]:
            problem = f"{where}: t must increase; frame {len(stamps) - 1} has {stamps[-1]!r} s after {stamps[-2]!r} s"
            raise ValueError(f"{problem}. Sort the rows or correct the stamps.")
    if not stamps:
        raise ValueError(f"{path} must have one row a frame; got none.")
    check_step(str(path), np.array(stamps))
    return np.array(stamps)


def write_video(path: Path, frames: Iterator[Image], rate: float, size: tuple[int, int], instead: str) -> None:
    """Writes frames (h, w, 3) as MPEG-4 part 2, which every build of OpenCV writes and reads.

    Args: path: a new file.  rate: Hz.  size: width and height, px.  instead: what to do where OpenCV cannot write it.
    Raises: OSError: the video cannot be written.
    """
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), rate, size)
    if not writer.isOpened():
        raise OSError(f"{path}: OpenCV cannot write this video. {instead}")
    try:
        for frame in frames:
            writer.write(frame)
    finally:
        writer.release()


def _capture(path: Path) -> cv2.VideoCapture:
    """Opens a video for decoding on one thread, since each camera has a core. Opening reads headers alone."""
    capture = cv2.VideoCapture(str(path), cv2.CAP_FFMPEG, [cv2.CAP_PROP_N_THREADS, 1])
    if not capture.isOpened():
        raise ValueError(f"video {path} must be a file that FFmpeg decodes; it is not, or it is cut off. Convert it.")
    width, height = (int(capture.get(side)) for side in (cv2.CAP_PROP_FRAME_WIDTH, cv2.CAP_PROP_FRAME_HEIGHT))
    if width and height:  # else there is no frame to decode
        check_pixels(path, width, height)
    return capture


def _natural(file: Path) -> tuple[Sequence[tuple[int, str]], str]:
    parts = re.split(r"(\d+)", file.stem)
    return [(int(part), "") if part.isdigit() else (-1, part) for part in parts], file.name
