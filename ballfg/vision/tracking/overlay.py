"""Draws the overlay video: all views side by side with candidates, balls, trails and names.

The cameras are played back on one clock: each shows its frame that is nearest to the time. `ViewPainter` draws a view.
What a single camera saw has its distance written beside it, and its place on the table below it drawn as an ellipse, in
which the error of that distance shows.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Index
from ballfg.progress import Watch, unwatched
from ballfg.vision.arrays import Image
from ballfg.vision.association.gathering import nearest
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections
from ballfg.vision.detection.video import write_video
from ballfg.vision.tracking.pipeline import Tracking

VIEW_WIDTH: Final = 640  # px of one view: three side by side make 1920, the width of a screen
IN_A_ROW: Final = 3  # views side by side; more go below
PLAYED_AT: Final = 30.0  # Hz at which every frame is shown: slow motion for a camera of 120 Hz, smooth on any screen
HELD: Final = 0.1  # s that a frame stays on show: bridges dropped frames, and shows no ball that has long gone
Colour = tuple[int, int, int]

TRACKS: Final = ("#e69f00", "#56b4e9", "#f0e442", "#cc79a7", "#00c08b", "#ff7f50")  # after Okabe and Ito
TRAIL: Final = 0.4  # s of a ball's past that its trail shows: over a metre of flight, without filling the view
LINGER: Final = 0.3  # s that the trail stays after the ball's last point, so that the end of a track can be seen
RING: Final = 9.0  # px, radius of the ring round an associated ball on the scaled view: leaves the ball visible
BESIDE: Final = (12.0, -8.0)  # px from the ball to its name
CANDIDATE: Final = 4.5  # px, radius of the ring round a candidate
UNLIKELY, LIKELY = (130, 130, 130), (255, 255, 255)  # colours of candidates of score 0 and 1, mixed between
NINETY: Final = (-2.0 * np.log(0.1)) ** 0.5  # standard deviations of an ellipse that holds 90 % of a place on a plane
TURN: Final = np.linspace(0.0, 2.0 * np.pi, 33)  # rad, along such an ellipse
DIMMED: Final = 0.4  # share of the view's brightness that remains behind text
CAPTION: Final = 22  # px, height of the line of text at the top
_SHIFT: Final = 4  # binary digits after the point that OpenCV draws with: a 16th of a pixel


@dataclass(frozen=True, eq=False)
class Schedule:
    """The frames on show at each time."""

    times: Array  # (k,) s, true time of each moment, increasing
    frames: Index  # (k, c) number of the frame of each camera; -1 where it has none within `HELD`


def write_overlay(
    path: Path,
    tracking: Tracking,
    streams: Sequence[Iterator[tuple[float, Image]]],
    watch: Watch = unwatched,
    table: float | None = None,
) -> int:
    """Writes the overlay video (mp4).

    Args: path: a new file; its folder exists.  streams: the frames of each camera once more, from the first on.
        watch: sees the frames that are drawn.  table: m, height of its surface; None without one.
    Returns: the number of its frames.
    Raises: OSError: the video cannot be written.
    """
    painter = OverlayPainter(tracking, table)
    moments = schedule(tracking.detections, tracking.cameras)
    frames = watch(painter.paint_all(moments, streams), len(moments.times), "overlay frames drawn")
    write_video(path, frames, PLAYED_AT, painter.size, "Check the disk, or go without the overlay.")
    return len(moments.times)


class OverlayPainter:
    """Lays the views out and draws them. Attributes: size: width and height of the overlay, px."""

    def __init__(self, tracking: Tracking, table: float | None = None) -> None:
        self._views = [ViewPainter(tracking, i, VIEW_WIDTH, table) for i in range(len(tracking.cameras))]
        columns, height = min(IN_A_ROW, len(self._views)), max(view.size[1] for view in self._views)
        self._corners = [(i // columns * height, i % columns * VIEW_WIDTH) for i in range(len(self._views))]
        whole = self._corners[-1][0] + height
        self.size = (columns * VIEW_WIDTH, whole + whole % 2)  # the codec wants even sides

    def paint_all(self, moments: Schedule, streams: Sequence[Iterator[tuple[float, Image]]]) -> Iterator[Image]:
        """One picture a moment."""
        for time, frames, images in zip(moments.times, moments.frames, play(moments, streams), strict=True):
            page = np.zeros((self.size[1], self.size[0], 3), np.uint8)
            for view, (top, left), frame, image in zip(self._views, self._corners, frames, images, strict=True):
                painted = view.paint(image, int(frame), float(time))
                page[top : top + len(painted), left : left + VIEW_WIDTH] = painted
            yield page


def schedule(detections: Sequence[Detections], cameras: Sequence[Camera]) -> Schedule:
    """The times of a shown recording: the frames of the camera with most, and beyond them the others'."""
    clocks = [seen.frames - camera.time_offset for seen, camera in zip(detections, cameras, strict=True)]
    times = np.zeros(0)
    for clock in sorted(clocks, key=len, reverse=True):
        if len(times) == 0:
            times = clock
        elif len(clock):
            times = np.concatenate((clock[clock < times[0]], times, clock[clock > times[-1]]))
    return Schedule(times, np.column_stack([shown(clock, times) for clock in clocks]))


def shown(clock: Array, times: Array) -> Index:
    """(k,) index into `clock` (f,), increasing, of the stamp nearest to each of `times` (k,); -1 beyond `HELD`."""
    if len(clock) == 0:
        return np.full(len(times), -1, dtype=np.int64)
    index = nearest(clock, times)
    return np.where(np.abs(clock[index] - times) <= HELD, index, -1).astype(np.int64)


def play(moments: Schedule, streams: Sequence[Iterator[tuple[float, Image]]]) -> Iterator[list[Image | None]]:
    """Each moment's images, None without one; the streams begin with the cameras' first frames and run once."""
    at = [-1] * len(streams)
    images: list[Image | None] = [None] * len(streams)
    for frames in moments.frames:
        for i, wanted in enumerate(frames):
            while at[i] < wanted:
                _, images[i] = next(streams[i])
                at[i] += 1
        yield [image if frame >= 0 else None for image, frame in zip(images, frames, strict=True)]


class ViewPainter:
    """Draws the frames of one camera, by its number, at a width in px; the height follows."""

    def __init__(self, tracking: Tracking, camera: int, width: int, table: float | None = None) -> None:
        self._camera, self._detections = tracking.cameras[camera], tracking.detections[camera]
        self._names, self._balls = tracking.names, tracking.balls
        self._scale = width / self._camera.size[0]
        self.size = (width, max(1, round(self._camera.size[1] * self._scale)))
        self._trails = [self._camera.project(ball.points) for ball in tracking.balls]
        self._alone, self._table = len(tracking.cameras) == 1, table
        self._used: dict[int, list[tuple[int, Array]]] = {}
        for track, ball in enumerate(tracking.balls):
            for frame, pixel in zip(*tracking.seen(ball, camera), strict=True):
                self._used.setdefault(int(frame), []).append((track, pixel))

    def paint(self, image: Image | None, frame: int, time: float) -> Image:
        """The view (h, w, 3) at a true time, s, of an image (h, w, 3), None without one, and its frame's number."""
        if image is None:
            view = np.zeros((self.size[1], self.size[0], 3), np.uint8)
            caption(view, f"{self._camera.name}   no frame")
            return view
        view = np.asarray(cv2.resize(image, self.size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
        used = self._used.get(frame, ())
        clean = view.copy()
        for track, (ball, pixels) in enumerate(zip(self._balls, self._trails, strict=True)):
            if ball.times[0] <= time <= ball.times[-1] + LINGER:
                recent = (ball.times > time - TRAIL) & (ball.times <= time)
                polyline(view, self._scaled(pixels[recent]), bgr(track))
        candidates = self._detections.in_frame(frame)
        for pixel, score in zip(candidates.pixels, candidates.scores, strict=True):
            if not any(np.array_equal(pixel, ball) for _, ball in used):
                ring(view, self._scaled(pixel), CANDIDATE, by_score(score))
        for track, _ in used if self._alone else ():
            self._draw_below(view, track, time)
        for track, pixel in used:
            uncover(view, clean, self._scaled(pixel), RING)
            ring(view, self._scaled(pixel), RING, bgr(track), 2)
            words = f"{self._names[track]}{self._depth(track, time) if self._alone else ''}"
            write(view, words, self._scaled(pixel) + np.array(BESIDE), bgr(track))
        caption(view, f"{self._camera.name}   frame {frame}   stamp {self._detections.frames[frame]:.4f} s")
        return view

    def _depth(self, track: int, time: float) -> str:
        """How far away from the camera a ball is at a time, s, with the standard deviation: no picture shows it."""
        point, covariance = self._at(track, time)
        away = point - self._camera.centre
        far = float(np.linalg.norm(away))
        sigma = float(np.sqrt(away @ covariance @ away)) / far
        return f"  {far:.2f} +- {sigma:.2f} m"

    def _draw_below(self, view: Image, track: int, time: float) -> None:
        """Draws the place on the table below a ball as an ellipse that holds 90 %, and a line to it."""
        if self._table is None:
            return
        point, covariance = self._at(track, time)
        foot = np.append(point[:2], self._table)
        around = NINETY * np.linalg.cholesky(covariance[:2, :2]) @ np.stack((np.cos(TURN), np.sin(TURN)))
        for places in (np.stack((point, foot)), foot + np.column_stack((around.T, np.zeros(len(TURN))))):
            polyline(view, self._scaled(self._camera.project(places)), bgr(track))

    def _at(self, track: int, time: float) -> tuple[Array, Array]:
        """Place (3,) m of a ball at a time, s, and its covariance (3, 3) m^2."""
        ball = self._balls[track]
        row = int(nearest(ball.times, np.array([time]))[0])
        return ball.points[row], ball.covariances[row]

    def _scaled(self, pixels: Array) -> Array:
        """Places on the drawn view of places in the image: both count from the centre of the top left pixel."""
        return np.asarray((pixels + 0.5) * self._scale - 0.5)


def hexadecimal(track: int) -> str:
    """The colour of a track by its number, as #rrggbb."""
    return TRACKS[track % len(TRACKS)]


def bgr(track: int) -> Colour:
    """The same as blue, green, red, each 0 .. 255."""
    red, green, blue = bytes.fromhex(hexadecimal(track)[1:])
    return blue, green, red


def by_score(score: float) -> Colour:
    """The colour of a candidate."""
    blue, green, red = (round(low + score * (high - low)) for low, high in zip(UNLIKELY, LIKELY, strict=True))
    return blue, green, red


def ring(view: Image, centre: Array, radius: float, colour: Colour, thickness: int = 1) -> None:
    """A circle at a place (2,) px between pixels; none far outside the view."""
    if (np.abs(centre) < 4 * max(view.shape)).all():
        u, v = (round(float(x) * 2**_SHIFT) for x in centre)
        cv2.circle(view, (u, v), round(radius * 2**_SHIFT), colour, thickness, cv2.LINE_AA, _SHIFT)


def uncover(view: Image, clean: Image, centre: Array, radius: float) -> None:
    """Restores, inside a circle, the content before drawing."""
    disc = np.zeros(view.shape[:2], np.uint8)
    ring(disc, centre, radius, (255, 255, 255), cv2.FILLED)
    cv2.copyTo(clean, disc, view)


def polyline(view: Image, places: Array, colour: Colour) -> None:
    """Lines through places (n, 2) px; broken where they are NaN or far outside the view."""
    fine = (np.abs(np.nan_to_num(places, nan=np.inf)) < 4 * max(view.shape)).all(axis=1)
    for piece in np.split(np.arange(len(places)), np.flatnonzero(~fine)):
        inside = piece[fine[piece]]
        if len(inside) > 1:
            points = np.round(places[inside] * 2**_SHIFT).astype(np.int32)
            cv2.polylines(view, [points], False, colour, 1, cv2.LINE_AA, _SHIFT)


def write(view: Image, text: str, at: Sequence[float] | Array, colour: Colour) -> None:
    """Text at its lower left corner, on a dark plate; a letter that the font may lack is a question mark."""
    plain = text.encode("ascii", "replace").decode()
    left, bottom = (round(float(x)) for x in at)
    (width, height), below = cv2.getTextSize(plain, cv2.FONT_HERSHEY_SIMPLEX, 0.45, 1)
    plate = view[max(0, bottom - height - 2) : max(0, bottom + below), max(0, left - 2) : max(0, left + width + 2)]
    plate[:] = (plate * DIMMED).astype(np.uint8)
    cv2.putText(view, plain, (left, bottom), cv2.FONT_HERSHEY_SIMPLEX, 0.45, colour, 1, cv2.LINE_AA)


def caption(view: Image, text: str) -> None:
    """A line of text at the top."""
    view[:CAPTION] = (view[:CAPTION] * DIMMED).astype(np.uint8)
    write(view, text, (8.0, 15.0), (255, 255, 255))
