"""Draws the contact sheet: each track in every view and in space, for a quick check."""

from collections.abc import Sequence
from pathlib import Path
from typing import Final

import numpy as np
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from ballfg.arrays import Array
from ballfg.vision.tracking.pipeline import Tracking
from ballfg.vision.tracking.strobe import EXPOSURES, HEIGHT, WIDTH, ZOOM, AllCandidates, Picture, Strobe
from ballfg.vision.tracking.view_painter import hexadecimal

Extent = tuple[float, float, float, float]

MOST_TRACKS: Final = 12  # rows of the sheet; of more tracks as many, spread evenly, are shown
MOST_VIEWS: Final = 4  # cameras in a row: the first ones of the rig
INCH: Final = 3.1  # width of a view
WIDER: Final = 1.2  # width of a plot, in views
TITLE: Final = 0.3  # inches for a line of text and the space round it
PROPORTION: Final = 1.45  # width of a plot over its height, at least
DPI: Final = 100  # pixels an inch: a view then is drawn a third smaller than it was put together
AROUND: Final = 0.15  # m shown round the points
TABLE: Final = "#2a7f4f"
"""Colour of the table."""


class ContactSheet:
    """Collects pictures while the videos pass by (`strobe.tapped`), then writes the sheet.

    Args: ball_radius: m.  table_height: m, z of the table's surface.
        table: (x_low, x_high, y_low, y_high) m; None where it is not known.
    """

    def __init__(self, tracking: Tracking, ball_radius: float, table_height: float, table: Extent | None) -> None:
        self._tracking = tracking
        self._height, self._table = table_height, table
        count = len(tracking.balls)
        self._shown = np.unique(np.linspace(0, count - 1, min(count, MOST_TRACKS)).round().astype(int)).tolist()
        views = range(min(len(tracking.cameras), MOST_VIEWS))
        self._strobes: list[list[Strobe]] = [
            [Strobe(tracking, track, i, ball_radius) for i in views] for track in self._shown
        ]
        self._all: list[AllCandidates] = [] if count else [AllCandidates(tracking, i) for i in views]

    def pictures_of(self, camera: int) -> list[Picture]:
        """The pictures that need a camera's frames."""
        rows: list[Sequence[Picture]] = [*self._strobes, self._all]
        return [row[camera] for row in rows if camera < len(row)]

    def write(self, path: Path) -> None:
        """Writes the sheet as a PNG; views that were not filmed are grey."""
        figure = self._flights() if self._strobes else self._candidates()
        figure.savefig(path, format="png", dpi=DPI, metadata={"Software": None})

    def _flights(self) -> Figure:
        rows, views = len(self._strobes), len(self._strobes[0])
        widths = [1.0] * views + [WIDER] * 2
        row_height = INCH * (HEIGHT + ZOOM) / WIDTH + TITLE
        figure = Figure(figsize=(INCH * sum(widths), row_height * rows + 2 * TITLE), layout="constrained")
        panels = np.asarray(figure.subplots(rows, len(widths), squeeze=False, width_ratios=widths), dtype=object)
        for row, track, strobes in zip(panels, self._shown, self._strobes, strict=True):
            self._draw_row(row, track, strobes)
        for panel in panels[-1, -2:]:
            panel.set_xlabel("x, m", size=8)
        figure.suptitle(self._title(), size=10, wrap=True)
        return figure

    def _candidates(self) -> Figure:
        figure = Figure(figsize=(INCH * len(self._all), INCH * HEIGHT / WIDTH + 3 * TITLE), layout="constrained")
        panels = figure.subplots(1, len(self._all), squeeze=False)[0]
        for panel, picture, seen in zip(panels, self._all, self._tracking.detections, strict=False):
            panel.imshow(picture.picture()[..., ::-1], interpolation="lanczos")
            panel.set_axis_off()
            best = ", ".join(f"{score:.2f}" for score in seen.best_scores()) or "none"
            panel.set_title(f"{seen.camera}: best scores {best}", size=8)
        figure.suptitle("no ball: candidates of all frames on the middle one, the brighter the likelier", size=10)
        return figure

    def _title(self) -> str:
        shown, count = len(self._shown), len(self._tracking.balls)
        which = f"{count} track{'s' * (count != 1)}" if shown == count else f"{shown} of {count} tracks"
        views = "where each camera saw the ball"
        if any(strobe.filmed for row in self._strobes for strobe in row):
            views = (
                f"the ball cut from up to {EXPOSURES} frames of each camera with its trail; below, from near, "
                "in a circle of its expected size"
            )
        return f"{which}: {views}. Right: points ± 1 sigma from the side and from above."

    def _draw_row(self, row: Sequence[Axes], track: int, strobes: Sequence[Strobe]) -> None:
        ball, name = self._tracking.balls[track], self._tracking.names[track]
        for panel, strobe, camera in zip(row, strobes, self._tracking.cameras, strict=False):
            panel.imshow(strobe.picture()[..., ::-1], interpolation="lanczos")
            panel.set_axis_off()
            panel.set_title(f"{camera.name}: {strobe.count} sightings", size=8)
        row[0].set_title(f"track {name}     " + row[0].get_title(), size=8, color="black")
        sigmas = np.sqrt(np.diagonal(ball.covariances, axis1=1, axis2=2))
        self._draw_side(row[-2], ball.points, sigmas, track)
        self._draw_top(row[-1], ball.points, sigmas, track)
        row[-2].set_title(f"from the side: {ball.times[0]:.3f} to {ball.times[-1]:.3f} s", size=8)
        row[-1].set_title(f"from above: {len(ball.times)} points", size=8)

    def _draw_side(self, panel: Axes, points: Array, sigmas: Array, track: int) -> None:
        low, high = self._limits()
        ends = (low[0], high[0]) if self._table is None else self._table[:2]
        panel.plot(ends, (self._height, self._height), color=TABLE, linewidth=2.5, zorder=1)
        _draw_points(panel, points[:, (0, 2)], sigmas[:, (0, 2)], track)
        _frame(panel, (low[0], high[0]), (min(low[2], self._height - AROUND), high[2]), "z, m")

    def _draw_top(self, panel: Axes, points: Array, sigmas: Array, track: int) -> None:
        low, high = self._limits()
        if self._table is not None:
            x_low, x_high, y_low, y_high = self._table
            panel.fill((x_low, x_high, x_high, x_low), (y_low, y_low, y_high, y_high), color=TABLE, alpha=0.35, lw=0)
        _draw_points(panel, points[:, :2], sigmas[:, :2], track)
        _frame(panel, (low[0], high[0]), (low[1], high[1]), "y, m")

    def _limits(self) -> tuple[Array, Array]:
        """(3,) m each: the lowest and highest coordinates on show, the same in all rows."""
        points = np.concatenate([ball.points for ball in self._tracking.balls])
        low, high = points.min(axis=0) - AROUND, points.max(axis=0) + AROUND
        if self._table is not None:
            corners = np.array(self._table).reshape(2, 2).T
            low[:2], high[:2] = np.minimum(low[:2], corners[0] - AROUND), np.maximum(high[:2], corners[1] + AROUND)
        return low, high


def _draw_points(panel: Axes, places: Array, sigmas: Array, track: int) -> None:
    across, up = places.T
    colour = hexadecimal(track)
    panel.errorbar(across, up, sigmas[:, 1], sigmas[:, 0], fmt="none", ecolor="#777777", elinewidth=0.6, zorder=2)
    panel.plot(across, up, "o-", color=colour, markersize=2.6, linewidth=0.6, markeredgecolor="#333333", mew=0.3)


def _frame(panel: Axes, across: tuple[float, float], up: tuple[float, float], name: str) -> None:
    """Limits with one scale on both axes; the height on show grows until the plot is as high as a view."""
    middle, half = (up[0] + up[1]) / 2, max(up[1] - up[0], (across[1] - across[0]) / PROPORTION) / 2
    panel.set_xlim(*across)
    panel.set_ylim(middle - half, middle + half)
    panel.set_aspect("equal")
    panel.set_ylabel(name, size=8)
    panel.tick_params(labelsize=7)
    panel.grid(color="#dddddd", linewidth=0.5)
