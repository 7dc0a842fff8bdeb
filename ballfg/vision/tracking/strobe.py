"""Draws a flight in one picture: the ball from several frames of a camera, with its trail."""

from collections.abc import Iterable, Iterator, Sequence
from typing import Final, Protocol

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.arrays import Image
from ballfg.vision.tracking.pipeline import Tracking
from ballfg.vision.tracking.view_painter import bgr, by_score, polyline, ring, uncover, write

WIDTH: Final = 480  # px of the picture
HEIGHT: Final = 270  # px of the picture without the row of close-ups
ZOOMS: Final = 5  # close-ups below the picture
ZOOM: Final = WIDTH // ZOOMS  # px, side of a close-up
EXPOSURES: Final = 2 * ZOOMS - 1  # balls in the picture; every second one is a close-up too
AROUND: Final = 60.0  # px left free around the flight in the frame, so that one sees where it was
LEAST_WIDTH: Final = 320.0  # px of the frame that are shown at least: less is blurred by the enlargement
CUT: Final = 2.5  # radii of the ball, of the disc that is cut out: room for the streak of a moving ball
CLOSE: Final = 3.5  # radii of the ball, half the side of a close-up
LEAST_RADIUS: Final = 3.0  # px; the cut discs of a smaller, distant ball are those of this one
MOST_RINGS: Final = 500  # candidates that the picture of a recording without a ball shows: the best ones
BLANK: Final = 60  # grey of areas that were not filmed


class Picture(Protocol):
    """A picture that is composed while a camera's frames pass by."""

    @property
    def frames(self) -> set[int]:
        """Numbers of the frames that it needs."""

    def see(self, frame: int, image: Image) -> None:
        """Takes what it needs of a frame (h, w, 3), given by its number."""


class Strobe:
    """The picture of one ball in one camera, put together while the camera's frames pass by.

    Args: track, camera: their numbers.  ball_radius: m.

    Attributes: count: of the ball's sightings in this camera.
    """

    def __init__(self, tracking: Tracking, track: int, camera: int, ball_radius: float) -> None:
        seen = tracking.seen(tracking.balls[track], camera)
        self.count = len(seen.frames)
        self._colour = bgr(track)
        if not self.count:
            return
        model, ball = tracking.cameras[camera], tracking.balls[track]
        self._seen = seen.pixels
        self._trail = model.project(ball.points)
        picked = np.unique(np.linspace(0, self.count - 1, EXPOSURES).round().astype(int))
        self._frames, self._pixels = seen.frames[picked], seen.pixels[picked]
        times = tracking.detections[camera].frames[self._frames] - model.time_offset
        points = np.column_stack([np.interp(times, ball.times, ball.points[:, axis]) for axis in range(3)])
        self._radii = np.maximum(model.matrix[0, 0] * ball_radius / model.depth(points), LEAST_RADIUS)
        self._reach = np.ceil(CLOSE * self._radii).astype(int)  # px, from the middle of a patch to its edge
        self._box = _box(seen.pixels, model.size)
        self._base: Image | None = None
        self._patches: dict[int, Image] = {}

    @property
    def frames(self) -> set[int]:
        """Numbers of the frames that the picture needs."""
        return {int(frame) for frame in self._frames} if self.count else set()

    @property
    def filmed(self) -> bool:
        """True if a frame that it needs has passed by."""
        return self.count > 0 and bool(self._patches)

    def see(self, frame: int, image: Image) -> None:
        """Takes what it needs of a frame (h, w, 3)."""
        for i in np.flatnonzero(self._frames == frame):
            self._patches[int(i)] = _around(image, self._pixels[i], self._reach[i])
            if i == len(self._frames) // 2:
                left, top, width, height = self._box
                self._base = image[top : top + height, left : left + width].copy()

    def picture(self) -> Image:
        """(`HEIGHT` + `ZOOM`, `WIDTH`, 3): the flight, and the close-ups below it; grey where nothing was seen."""
        page = np.full((HEIGHT + ZOOM, WIDTH, 3), BLANK, np.uint8)
        if not self.count:
            write(page, "not seen", (WIDTH / 2 - 35, HEIGHT / 2), (255, 255, 255), 0.6)
            return page
        page[:HEIGHT] = self._flight()
        for place, i in enumerate(range(0, len(self._frames), 2)):
            if i in self._patches:
                page[HEIGHT + 2 :, place * ZOOM + 1 : (place + 1) * ZOOM - 1] = self._close_up(i)[2:, 1:-1]
        return page

    def _flight(self) -> Image:
        left, top, width, height = self._box
        clean = np.full((height, width, 3), BLANK, np.uint8) if self._base is None else self._base.copy()
        for i, patch in self._patches.items():
            _paste(clean, patch, self._pixels[i] - (left, top), CUT * self._radii[i])
        scale = WIDTH / width
        clean = np.asarray(cv2.resize(clean, (WIDTH, HEIGHT), interpolation=cv2.INTER_AREA), dtype=np.uint8)
        view = clean.copy()

        def scaled(pixels: Array) -> Array:
            return np.asarray((pixels - (left, top) + 0.5) * scale - 0.5)

        polyline(view, scaled(self._trail), self._colour, 1)
        for pixel in self._seen:
            ring(view, scaled(pixel), 1.5, self._colour, 2)
        if self._patches:
            for pixel, radius in zip(self._pixels, self._radii, strict=True):
                uncover(view, clean, scaled(pixel), CUT * radius * scale)
        return view

    def _close_up(self, i: int) -> Image:
        """A ball from near, with a circle as large as it should be where it was found."""
        patch, reach = self._patches[i], self._reach[i]
        close = np.asarray(cv2.resize(patch, (ZOOM, ZOOM), interpolation=cv2.INTER_CUBIC), dtype=np.uint8)
        scale = ZOOM / (2 * reach + 1)
        centre = (self._pixels[i] - self._pixels[i].round() + reach + 0.5) * scale - 0.5
        ring(close, centre, self._radii[i] * scale, self._colour)
        return close


class AllCandidates:
    """The middle frame of a camera with the candidates of all its frames, for a recording without a ball."""

    def __init__(self, tracking: Tracking, camera: int) -> None:
        self._detections = tracking.detections[camera]
        self._size = tracking.cameras[camera].size
        self._base: Image | None = None

    @property
    def frames(self) -> set[int]:
        """Numbers of the frames that the picture needs."""
        return {len(self._detections.frames) // 2}

    def see(self, frame: int, image: Image) -> None:
        """Takes a frame (h, w, 3), given by its number."""
        self._base = image.copy()

    def picture(self) -> Image:
        """(h, `WIDTH`, 3)."""
        scale = WIDTH / self._size[0]
        page = np.full((round(self._size[1] * scale), WIDTH, 3), BLANK, np.uint8)
        if self._base is not None:
            page[:] = cv2.resize(self._base, page.shape[1::-1], interpolation=cv2.INTER_AREA)
        best = np.argsort(-self._detections.scores, kind="stable")[:MOST_RINGS]
        for i in best[::-1]:
            ring(page, (self._detections.pixels[i] + 0.5) * scale - 0.5, 3.0, by_score(self._detections.scores[i]))
        return page


def tapped(stream: Iterable[tuple[float, Image]], pictures: Sequence[Picture]) -> Iterator[tuple[float, Image]]:
    """Passes the frames of a camera through; the pictures of that camera copy the parts that they need."""
    wanted: dict[int, list[Picture]] = {}
    for picture in pictures:
        for frame in picture.frames:
            wanted.setdefault(frame, []).append(picture)
    for number, (time, image) in enumerate(stream):
        for picture in wanted.get(number, ()):
            picture.see(number, image)
        yield time, image


def _box(pixels: Array, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, width and height, px, of the part of the frame that holds all pixels, in the picture's proportions."""
    low, high = pixels.min(axis=0) - AROUND, pixels.max(axis=0) + AROUND
    aspect = WIDTH / HEIGHT
    width = max(high[0] - low[0], (high[1] - low[1]) * aspect, LEAST_WIDTH)
    width = min(width, size[0], size[1] * aspect)
    sides = np.array([width, width / aspect])
    corner = np.clip((low + high) / 2 - sides / 2, 0.0, np.array(size) - sides)
    left, top = (int(x) for x in corner)
    return left, top, int(sides[0]), int(sides[1])


def _around(image: Image, pixel: Array, reach: int) -> Image:
    """(2 reach + 1, 2 reach + 1, 3) round the nearest whole pixel; what lies outside the image repeats its edge."""
    u, v = (int(x) for x in pixel.round())
    rows = np.arange(v - reach, v + reach + 1).clip(0, image.shape[0] - 1)
    columns = np.arange(u - reach, u + reach + 1).clip(0, image.shape[1] - 1)
    return np.ascontiguousarray(image[np.ix_(rows, columns)])


def _paste(onto: Image, patch: Image, centre: Array, radius: float) -> None:
    """Copies the disc of a radius (px) from the middle of a patch to a place (2,), as far as it is inside."""
    reach = len(patch) // 2
    u, v = (int(x) for x in centre.round())
    rows, columns = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    inside = (rows**2 + columns**2 <= radius**2) & (rows + v >= 0) & (rows + v < onto.shape[0])
    inside &= (columns + u >= 0) & (columns + u < onto.shape[1])
    onto[(rows + v)[inside], (columns + u)[inside]] = patch[inside]
