"""Draws the contact sheet: each track in every view and in space, for a quick check."""

from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import Final

import cv2
import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import EllipseCollection
from matplotlib.figure import Figure

from ballfg.arrays import Array, Index
from ballfg.checks import drawn
from ballfg.progress import counted
from ballfg.vision.arrays import Image
from ballfg.vision.tracking.overlay import Colour, bgr, by_score, hexadecimal, polyline, ring, uncover
from ballfg.vision.tracking.pipeline import Tracking

Extent = tuple[float, float, float, float]

MOST_TRACKS: Final = 12  # rows of the sheet; of more tracks as many, spread evenly, are shown
MOST_VIEWS: Final = 4  # cameras in a row: the first ones of the rig
EXPOSURES: Final = 9  # frames that are combined in a view
MOST_RINGS: Final = 500  # candidates that the sheet of a recording without a ball shows: the best ones
WIDTH, ASPECT = 480, 16 / 9  # px of a view, and its width over its height
AROUND: Final = 60.0  # px left free around the flight in the frame, so that one sees where it was
LEAST_WIDTH: Final = 320.0  # px of the frame that are shown at least: less is blurred by the enlargement
CLEAR: Final = 8.0  # px around a ball in which nothing is drawn over it
BLANK: Final = 60  # grey of a view that was not filmed
INCH, WIDER = 3.1, 1.2  # inches, width of a view; width of a plot in views
PROPORTION: Final = 1.45  # least width of a plot over its height
BESIDE: Final = 0.15  # m shown around the points
TABLE, BOUNCE = "#2a7f4f", "#cc3311"  # colours of the table and of bounces


class View:
    """One camera's picture, made of several of its frames: each pixel from the frame in which it is least usual.

    Args: frames: (n,) numbers to choose from.  pixels: (n, 2) px, what is seen in them.  size: px, of the image.
    """

    def __init__(self, frames: Index, pixels: Array, size: tuple[int, int]) -> None:
        picked = _spread(len(frames), EXPOSURES)
        self._frames = set(frames[picked].tolist())
        self._balls = pixels[picked] if len(pixels) else pixels
        self._box = _box(pixels, size) if len(pixels) else (0, 0, *size)
        self._images: list[Image] = []

    @property
    def last(self) -> int:
        """Number of the last frame that it needs; -1 without one."""
        return max(self._frames, default=-1)

    def see(self, number: int, image: Image) -> None:
        """Takes what it needs of a frame (h, w, 3), given by its number."""
        if number in self._frames:
            left, top, width, height = self._box
            self._images.append(_scaled(image[top : top + height, left : left + width]))

    def picture(self, marks: Array, colours: Sequence[Colour], trail: Array) -> Image:
        """(h, `WIDTH`, 3), with rings of these colours at marks (n, 2) px and a line along the trail (k, 2) px."""
        left, top, width, height = self._box
        view = _scaled(np.full((height, width, 3), BLANK, np.uint8))
        if self._images:  # of each pixel the image that differs most from the median
            stack = np.stack(self._images).astype(np.int16)
            far = np.abs(stack - np.median(stack, axis=0)).sum(axis=-1).argmax(axis=0)
            view = np.take_along_axis(stack, far[None, ..., None], axis=0)[0].astype(np.uint8)
        clean = view.copy()

        def place(pixels: Array) -> Array:
            return np.asarray((pixels - (left, top) + 0.5) * WIDTH / width - 0.5)

        polyline(view, place(trail), colours[0] if colours else (0, 0, 0))
        for mark, colour in zip(marks, colours, strict=True):
            ring(view, place(mark), 2.0, colour, 2)
        for ball in self._balls if self._images else ():
            uncover(view, clean, place(ball), CLEAR)
        return view


class ContactSheet:
    """Collects pictures while the videos pass by, then writes the sheet.

    Args: table_height: m, z of the table's surface; None without one.  table: (x_low, x_high, y_low, y_high) m; None
        if it is not known.
    """

    def __init__(self, tracking: Tracking, table_height: float | None, table: Extent | None) -> None:
        self._height = np.nan if table_height is None else table_height  # NaN draws nothing
        self._tracking, self._table = tracking, table
        self._shown = _spread(len(tracking.balls), MOST_TRACKS).tolist()
        self._views: list[list[View]] = []
        cameras = tracking.cameras[:MOST_VIEWS]
        for track in self._shown:
            seen = [tracking.seen(tracking.balls[track], camera) for camera in range(len(cameras))]
            self._views.append([View(*one, model.size) for one, model in zip(seen, cameras, strict=True)])
        if not self._shown:
            counts = [len(found.frames) for found in tracking.detections]
            sizes = [model.size for model in cameras]
            self._views.append([View(np.arange(n), np.zeros((0, 2)), s) for n, s in zip(counts, sizes, strict=False)])

    def passing(self, camera: int, stream: Iterable[tuple[float, Image]]) -> Iterator[tuple[float, Image]]:
        """Passes the frames of a camera on, and keeps of them what the sheet needs."""
        for number, (time, image) in enumerate(stream):
            for row in self._views:
                if camera < len(row):
                    row[camera].see(number, image)
            yield time, image

    def last(self, camera: int) -> int:
        """Number of the last frame of a camera that the sheet needs; -1 without one."""
        return max((row[camera].last for row in self._views if camera < len(row)), default=-1)

    def write(self, path: Path) -> None:
        """Writes the sheet as a PNG; views that were not filmed are grey."""
        figure = self.flights() if self._shown else self._candidates()
        figure.savefig(path, format="png", dpi=100, metadata={"Software": None})

    def flights(self) -> Figure:
        """The sheet of a recording with balls."""
        rows, views, count = len(self._shown), len(self._views[0]), len(self._tracking.balls)
        widths = [1.0] * views + [WIDER] * 2
        size = (INCH * sum(widths), (INCH / ASPECT + 0.9) * rows + 0.6)
        figure = Figure(figsize=size, layout="constrained")
        panels = np.asarray(figure.subplots(rows, len(widths), squeeze=False, width_ratios=widths), dtype=object)
        for row, track, pictures in zip(panels, self._shown, self._views, strict=True):
            for camera, (panel, view) in enumerate(zip(row, pictures, strict=False)):
                ball, model = self._tracking.balls[track], self._tracking.cameras[camera]
                marks = self._tracking.seen(ball, camera)[1]
                _show(panel, view.picture(marks, [bgr(track)] * len(marks), model.project(ball.points)))
                panel.set_title(f"{drawn(model.name)}: {len(marks)} sightings", size=8)
            row[0].set_title(f"track {drawn(self._tracking.names[track])}     " + row[0].get_title(), size=8)
            self._draw_space(row[-2:], track)
        for panel in panels[-1, -2:]:
            panel.set_xlabel("x, m", size=8)
        which = counted(count, "track") if rows == count else f"{rows} of {count} tracks"
        figure.suptitle(
            f"{which}: the ball in up to {EXPOSURES} frames of each camera, with the points' trail and the sightings. "
            "Right: points with ellipses of 1 sigma from the side and from above; crosses: bounces.",
            size=10,
            wrap=True,
        )
        return figure

    def _draw_space(self, panels: Sequence[Axes], track: int) -> None:
        """The points with their standard deviations from the side and from above; one scale in all rows."""
        ball, every = self._tracking.balls[track], np.concatenate([ball.points for ball in self._tracking.balls])
        low, high = every.min(axis=0) - BESIDE, every.max(axis=0) + BESIDE
        low[2] = np.fmin(low[2], self._height - BESIDE)
        table = self._table or (low[0], high[0], np.nan, np.nan)
        if self._table is not None:
            low[:2] = np.minimum(low[:2], np.array(table[::2]) - BESIDE)
            high[:2] = np.maximum(high[:2], np.array(table[1::2]) + BESIDE)
        panels[0].plot(table[:2], [self._height] * 2, color=TABLE, linewidth=2.5, zorder=1)
        panels[1].fill(np.array(table)[[0, 1, 1, 0]], np.array(table)[[2, 2, 3, 3]], color=TABLE, alpha=0.35, lw=0)
        panels[0].set_title(f"from the side: {ball.times[0]:.3f} to {ball.times[-1]:.3f} s", size=8)
        bounces = self._tracking.bounces.get(self._tracking.names[track], np.zeros((0, 6)))
        where = "; ".join(f"({x:.2f} ± {sx:.2f}, {y:.2f} ± {sy:.2f}) m" for x, y, _, sx, sy, _ in bounces.tolist())
        panels[1].set_title(f"from above: {f'bounce at {where}' if where else f'{len(ball.times)} points'}", size=8)
        for panel, up in zip(panels, (2, 1), strict=True):
            view = [0, up]
            _ellipses(panel, ball.points[:, view], ball.covariances[:, view][:, :, view])
            panel.plot(*ball.points[:, view].T, "o-", color=hexadecimal(track), markersize=2.6, linewidth=0.6)
            panel.plot(*bounces[:, view].T, "x", color=BOUNCE, markersize=7, markeredgewidth=1.6, zorder=4)
            middle, half = (low[up] + high[up]) / 2, max(high[up] - low[up], (high[0] - low[0]) / PROPORTION) / 2
            panel.set(xlim=(low[0], high[0]), ylim=(middle - half, middle + half), aspect="equal")
            panel.set_ylabel(f"{'xyz'[up]}, m", size=8)
            panel.tick_params(labelsize=7)
            panel.grid(color="#dddddd", linewidth=0.5)

    def _candidates(self) -> Figure:
        """The sheet of a recording without a ball: the best candidates of all frames, the brighter the likelier."""
        (views,) = self._views
        figure = Figure(figsize=(INCH * len(views), INCH / ASPECT + 0.9), layout="constrained")
        for panel, view, seen in zip(
            figure.subplots(1, len(views), squeeze=False)[0], views, self._tracking.detections, strict=False
        ):
            best = np.argsort(-seen.scores, kind="stable")[:MOST_RINGS][::-1]
            _show(panel, view.picture(seen.pixels[best], [by_score(s) for s in seen.scores[best]], np.zeros((0, 2))))
            scores = ", ".join(f"{score:.2f}" for score in seen.best_scores()) or "none"
            panel.set_title(f"{drawn(seen.camera)}: best scores {scores}", size=8)
        figure.suptitle("no ball: candidates of all frames, the brighter the likelier", size=10)
        return figure


def _ellipses(panel: Axes, points: Array, covariances: Array) -> None:
    """Draws ellipses of one standard deviation, of covariances (n, 2, 2) m^2, about points (n, 2) m."""
    variances, axes = np.linalg.eigh(covariances)
    short, long = (2.0 * np.sqrt(np.maximum(variances, 0.0))).T
    angles = np.degrees(np.arctan2(axes[:, 1, 1], axes[:, 0, 1]))
    drawn = EllipseCollection(
        long, short, angles, units="xy", offsets=points, offset_transform=panel.transData, facecolor="none"
    )
    drawn.set(edgecolor="#777777", linewidth=0.6)
    panel.add_collection(drawn)


def _spread(count: int, most: int) -> Index:
    """At most so many of the numbers below `count`, evenly spread."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).round().astype(np.int64))


def _show(panel: Axes, picture: Image) -> None:
    panel.imshow(picture[..., ::-1], interpolation="lanczos")
    panel.set_axis_off()


def _scaled(image: Image) -> Image:
    size = (WIDTH, round(image.shape[0] * WIDTH / image.shape[1]))
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)


def _box(pixels: Array, size: tuple[int, int]) -> tuple[int, int, int, int]:
    """Left, top, width and height, px, of the part of the frame that holds all pixels, in a view's proportions."""
    low, high = pixels.min(axis=0) - AROUND, pixels.max(axis=0) + AROUND
    width = max(high[0] - low[0], (high[1] - low[1]) * ASPECT, LEAST_WIDTH)
    width = min(width, size[0], size[1] * ASPECT)
    sides = np.array([width, width / ASPECT])
    left, top = np.clip((low + high) / 2 - sides / 2, 0.0, np.array(size) - sides).astype(int)
    return int(left), int(top), int(sides[0]), int(sides[1])
