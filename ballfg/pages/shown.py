"""Chooses the shots of a page from the given files, checks these against each other, and places table and floor."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ballfg.arrays import MAD_TO_SIGMA, Array
from ballfg.checks import did_you_mean, shown
from ballfg.dynamics.surfaces import TABLE_ABOVE_FLOOR, TABLE_LENGTH, TABLE_WIDTH
from ballfg.pages.given import Given
from ballfg.pages.shot import SAME_STAMP, Coverage, ShownShot, coverage, marks
from ballfg.pages.sight import sight
from ballfg.pages.tables import ResultTable
from ballfg.tracks import TABLE_TENNIS, Track
from ballfg.tracks.info import TENNIS, DatasetInfo

MOST_SHOTS = 40  # Number of shots on a page without named ones: a list that is still readable
MOST_ROWS = 36_000
"""Largest number of samples, states and predictions on a page: about 3 MB beside the drawing library's 5 MB."""
NET_HEIGHT = 0.1525  # m, height above the table, and overhang at its sides (ITTF Laws 2.2)
SMALL_BALL = 0.5 * (TABLE_TENNIS.radius + TENNIS.radius)
"""m. Balls below this radius count as table-tennis balls: their table has the size of the rules, and a net."""
MARGIN = 0.2  # m by which a surface with unknown ends extends beyond the samples


@dataclass(frozen=True)
class Outline:
    """Heights and ends of table and floor."""

    height: float  # m, of the surface
    extent: tuple[float, float, float, float]  # (x_low, x_high, y_low, y_high) m
    net: bool  # True if a net stands across the longer side
    floor: float | None  # m, height of the floor; None if unknown
    words: str  # a sentence on the origin of the ends

    @property
    def surfaces(self) -> tuple[float, ...]:
        """m, heights of table and floor."""
        return (self.height,) if self.floor is None else (self.height, self.floor)


@dataclass(frozen=True, eq=False)
class Shown:
    """The contents of a page."""

    given: Given  # all given files
    shots: tuple[ShownShot, ...]  # the chosen ones, in the dataset's order
    count: int  # total number of shots
    table: Outline | None  # its place; None without a dataset or a surface
    coverage: Coverage | None
    """Of all predicted shots, not only the chosen ones; None without measured tracks or predictions."""
    noise: str  # a sentence on the standard deviation of the measured coordinates; empty if unknown
    notes: tuple[str, ...]  # sentences for the reader


def collect(given: Given, names: Sequence[str] = (), limited: bool = True) -> Shown:
    """Chooses shots and collects their contents.

    Args:
        names: of the shots; if empty, the first ones.
        limited: True to take at most 40 shots and 36,000 rows, for a page.
    Raises: ValueError: an unknown name, results of other tracks, or a shot too long for a page.
    """
    if given.dataset is not None and given.predictions is not None:  # predictions are of flights
        given = replace(given, predictions=given.predictions.joined(given.dataset.names))
    known = _names(given)
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known)
            raise ValueError(
                f"--track must name one of the {len(known)} shots; got {shown(name)}.{hint} Correct the name."
            )
    notes = list(_check_results(given))
    wanted = set(names) if names else set(known[:MOST_SHOTS] if limited else known)
    shots: list[ShownShot] = []
    for shot in _all_shots(given, wanted):
        if limited and sum(other.rows for other in shots) + shot.rows > MOST_ROWS:
            if not shots or names:
                raise ValueError(
                    f"a page holds {MOST_ROWS} samples, states and predictions; shot {shown(shot.name)} brings more. "
                    "Name fewer shots with --track, or write a recording with --rerun."
                )
            break
        shots.append(shot)
    held = coverage(_all_shots(given)) if given.dataset is not None and given.predictions is not None else None
    noise = ""
    if given.dataset is not None and given.states is not None:
        shots, noise = _with_noise(given, shots)
    table = None
    if given.dataset is not None and shots:
        table = outline(given.dataset.info, np.concatenate([shot.positions for shot in shots]))
        radius, surfaces = given.dataset.ball.radius, () if table is None else table.surfaces
        shots = [replace(s, marks=tuple(marks(s.state_times, s.states, surfaces, radius, s.flying))) for s in shots]
        notes += [] if table is None else [table.words]
    return Shown(given, tuple(shots), len(known), table, held, noise, tuple(notes))


def _names(given: Given) -> list[str]:
    """The names of all shots: those of the dataset, else those of the tables."""
    if given.dataset is not None:
        return given.dataset.names
    tables = [one for one in (given.states, given.predictions) if one is not None]
    return list(dict.fromkeys(name for one in tables for name in one.rows))


def _check_results(given: Given) -> Iterator[str]:
    """Notes on results for only a part of the shots. Raises: ValueError: results of tracks outside of the dataset."""
    dataset = given.dataset
    for table in (given.states, given.predictions):
        if table is None or dataset is None:
            continue
        there = set(dataset.names)
        for name in table.rows:
            if name not in there:
                raise ValueError(
                    f"{table.path} must belong to {dataset.path}; it has a trajectory {shown(name)}, which the dataset "
                    "does not have. Give the dataset that it was made from."
                )
        if len(table.rows) < len(there):
            yield f"{table.path.name} has rows for {len(table.rows)} of the {len(there)} shots."
    named = None if given.diagnosis is None else given.diagnosis.get("dataset")
    if dataset is not None and named is not None and named != dataset.info.name:
        yield f"The diagnosis is of {shown(named)}, the tracks are of {shown(dataset.info.name)}."


def _all_shots(given: Given, wanted: set[str] | None = None) -> Iterator[ShownShot]:
    """Shots in the dataset's order, without marks and noise; the wanted ones, or all."""
    if given.dataset is not None:
        for track in given.dataset:
            if wanted is None or track.name in wanted:
                yield _shot(given, track.name, track)
        return
    for name in _names(given):
        if wanted is None or name in wanted:
            yield _shot(given, name, None)


def _shot(given: Given, name: str, track: Track | None) -> ShownShot:
    parts: dict[str, Any] = {}
    if track is not None:
        noise = np.full(track.positions.shape, np.nan) if track.sigmas is None else track.sigmas
        parts |= {"times": track.times, "positions": track.positions, "noise": noise}
        parts["sight"] = sight(track) if track.rough else None
    if (own := given.states) is not None:
        rows, which = _rows(own, name, track), own.rows.get(name, slice(0))
        parts |= {"state_times": rows[:, 0], "states": rows[:, 1:10], "state_sigmas": rows[:, 10:]}
        parts |= {"labels": own.labels[which], "correlations": own.correlations[which]}
    if (own := given.predictions) is not None:
        rows, which = _rows(own, name, track), own.rows.get(name, slice(0))
        parts |= {"predicted_times": rows[:, 0], "predicted": rows[:, 1:4], "predicted_sigmas": rows[:, 4:]}
        parts["flights"] = own.flights[which]
    return ShownShot(name, **parts).on_rays


def _rows(table: ResultTable, name: str, track: Track | None) -> Array:
    """Rows of a table. Raises: ValueError: stamps that the measured track does not have."""
    rows = table.of(name)
    if track is not None and len(rows):
        i = np.clip(np.searchsorted(track.times, rows[:, 0] - SAME_STAMP), 0, len(track) - 1)
        wrong = np.flatnonzero(np.abs(track.times[i] - rows[:, 0]) > SAME_STAMP)
        if len(wrong):
            raise ValueError(
                f"{table.path} must belong to the dataset: it has t = {rows[wrong[0], 0]:.9g} s of trajectory "
                f"{shown(name)}, where the dataset has no sample. Give the dataset that it was made from."
            )
    return rows


def _with_noise(given: Given, shots: list[ShownShot]) -> tuple[list[ShownShot], str]:
    """The shots with the standard deviations of their samples, and a sentence on their origin."""
    assert given.dataset is not None
    info = given.dataset.info
    if given.dataset.rough:
        if all(shot.sight is not None and shot.sight.one_view for shot in shots):
            return shots, (
                "One camera saw the ball: a sample is the point of its ray that is nearest to the estimate. Residuals "
                "are those across the ray, and their standard deviation is that of the pixel."
            )
        return (
            shots,
            "The samples were triangulated from what the cameras saw; estimates use the pixels themselves.",
        )
    if given.dataset.has_sigmas:
        return shots, "The standard deviations of the samples are those of the dataset's table."
    words = "The standard deviations of the samples are those of dataset.yaml"
    if info.noise is not None and info.noise.position is not None:
        sigma = np.array(info.noise.position)
    elif info.position_noise is not None:
        sigma = np.full(3, info.position_noise)
    else:
        residuals = np.concatenate([shot.residuals() for shot in shots])
        residuals = residuals[np.isfinite(residuals).all(axis=1)]
        if not len(residuals) or not (sigma := MAD_TO_SIGMA * np.median(np.abs(residuals), axis=0)).all():
            return shots, ""
        words = "The dataset states no noise: the standard deviations are those of the residuals of the shots shown"
    x, y, z = (1e3 * sigma).tolist()
    found = [replace(shot, noise=np.broadcast_to(sigma, shot.positions.shape)) for shot in shots]
    return found, f"{words}: {x:.2g} mm in x, {y:.2g} mm in y, {z:.2g} mm in z."


def outline(info: DatasetInfo, positions: Array) -> Outline | None:
    """The table of a dataset; None if it has no surface.

    Args: info: of the dataset.  positions: (n, 3) m, samples above the table, n >= 1.
    """
    if info.table_height is None:
        return None
    low, high = positions[:, :2].min(axis=0), positions[:, :2].max(axis=0)
    seen = (low[0] - MARGIN, high[0] + MARGIN, low[1] - MARGIN, high[1] + MARGIN)
    small = info.ball.radius < SMALL_BALL
    floor = info.table_height - TABLE_ABOVE_FLOOR if small else None
    ends: Iterable[float]
    if info.table_extent is not None:
        words = "The ends of the table are those of dataset.yaml."
        ends = (end if np.isfinite(end) else other for end, other in zip(info.table_extent, seen, strict=True))
    elif not small:
        words = "dataset.yaml does not state where the surface ends: it is drawn under all samples."
        ends = seen
    else:
        words = (
            "dataset.yaml does not state where the table's ends are: a table of the rules' size is drawn under the "
            "middle of the samples. Only its height is known."
        )
        x, y = 0.5 * (low + high)
        along_x = high[0] - low[0] >= high[1] - low[1]
        half_x, half_y = 0.5 * np.array((TABLE_LENGTH, TABLE_WIDTH) if along_x else (TABLE_WIDTH, TABLE_LENGTH))
        ends = (x - half_x, x + half_x, y - half_y, y + half_y)
    x0, x1, y0, y1 = map(float, ends)
    return Outline(info.table_height, (x0, x1, y0, y1), small and info.table_extent is not None, floor, words)
