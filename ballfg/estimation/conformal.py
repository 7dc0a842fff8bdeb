"""Computes split-conformal intervals: factors on predicted sigmas from the errors on calibration tracks.

Source: Lee, Barber, Willett, "Distribution-free inference with hierarchical data", 2023, arXiv:2306.06342;
docs/predict.md.
"""

from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from itertools import pairwise
from math import isclose
from pathlib import Path
from typing import TYPE_CHECKING, Final

import numpy as np
import yaml

from ballfg.arrays import Array, Index
from ballfg.checks import check_keys, check_path, one_line, short_text, shown
from ballfg.dynamics.surfaces import Surfaces
from ballfg.files.strict_yaml import mapping, read_mapping
from ballfg.files.whole_file import write_text
from ballfg.tracks.stamps import elapsed

if TYPE_CHECKING:
    from ballfg.estimation.observations.sighted_dataset import SightedDataset
    from ballfg.estimation.track_prediction import TrackPrediction
    from ballfg.tracks import Dataset

LEVEL: Final = 0.9  # Probability of the intervals
HALF_WIDTH: Final = 1.6448536269514722  # Sigmas on either side of a normal distribution's mean that hold `LEVEL`
FEWEST: Final = 9  # Calibration tracks below which no finite interval has the guarantee: LEVEL (n + 1) <= n
BIN: Final = 0.05  # s, width of the bins of the horizon. On the measured tracks a bin holds 3 to 9 samples of a track
EDGE: Final = 1e-5  # Share of a bin by which a stamp may exceed the bin's end: stamps are rounded
ROUNDING: Final = 1e-9  # Tolerance on sums of weights, so that exactly `FEWEST` tracks are enough
TABLE_TOLERANCE: Final = 1e-3
"""m, by which the tables of the calibration tracks and the predicted ones may differ in height."""
FILE_SECTION: Final = "conformal"


@dataclass(frozen=True, eq=False)
class ConformalScales:
    """Factors on predicted sigmas, after which mean +- 1.645 sigma are conformal 90 % intervals.

    Bin i of the horizon ends 0.05 (i + 1) s after the last observed stamp. Take a new track that is exchangeable with
    the calibration tracks and one of its samples in a bin at random. Along each axis the interval holds the measured
    coordinate with a probability of at least 90 %, and for n calibration tracks at most 90 % + 2 / (n + 1) if no two
    scores are equal. Samples of a track may depend on each other in any way.

    Attributes:
        source: name of the calibration dataset.
        observe: s, the observed part of each track.
        method: name of the estimator.
        tracks: (b,) number of calibration tracks with samples in each bin.
        scales: (b, 3) dimensionless, along x, y, z; infinite where there are fewer than 9 tracks.
        own: (b, 3) dimensionless, share of the calibration samples in the model's own 90 % intervals, each track with
            the same weight; NaN in a bin without samples.
        held: (b, 3) dimensionless, share in the conformal intervals when each track is compared with the scales of the
            others; NaN where there are fewer than 10 tracks.
        statuses: number of calibration tracks by the sentence of their status. Tracks whose estimation did not converge
            count like all others.
    """

    source: str
    observe: float
    method: str
    tracks: Index
    scales: Array
    own: Array
    held: Array
    statuses: Mapping[str, int] = field(default_factory=dict)

    @classmethod
    def of(
        cls, predictions: "Iterable[TrackPrediction]", source: str, observe: float, method: str = "smoother"
    ) -> "ConformalScales":
        """The scales from predictions of the calibration tracks.

        Args:
            predictions: made in the same way as those to scale; model and settings must not come from these tracks.
            source: name of the calibration dataset.
            observe: s, the observed part of each track.
            method: name of the estimator.
        Raises: ValueError: if fewer than 9 tracks go on after the observed part.
        """
        statuses, longer = Counter[str](), list[tuple[Index, Array]]()
        for prediction in predictions:
            statuses[prediction.status.value] += 1
            if len(prediction.times):
                with np.errstate(invalid="ignore", divide="ignore"):
                    scores = np.abs(prediction.measured - prediction.positions) / prediction.sigmas
                # a prediction that is not finite counts as a miss
                longer.append((_bins(prediction), np.where(np.isfinite(scores), scores, np.inf)))
        found = list(_by_bin(longer))
        most = max((one.count for one in found), default=0)
        if most < FEWEST:
            raise ValueError(
                f"conformal must hold at least {FEWEST} tracks with samples after their first {observe:g} s: a finite "
                f"{100 * LEVEL:.0f} % interval needs as many; got {most} in {shown(source)}. Give a larger dataset."
            )
        while found[-1].count < FEWEST:
            found.pop()
        return cls(
            source=source,
            observe=observe,
            method=method,
            tracks=np.array([one.count for one in found]),
            scales=np.array([one.quantile() / HALF_WIDTH for one in found]),
            own=np.array([one.share(HALF_WIDTH) for one in found]),
            held=np.array([one.left_out_share() for one in found]),
            statuses=dict(statuses),
        )

    @property
    def own_coverage(self) -> float:
        """Share of the calibration samples in the model's own 90 % intervals, over the bins of `coverage`."""
        return self._overall(self.own)

    @property
    def coverage(self) -> float:
        """Share in the conformal 90 % intervals, each track left out once; NaN if no bin has 10 tracks."""
        return self._overall(self.held)

    def _overall(self, shares: Array) -> float:
        told = self.tracks > FEWEST
        return float(np.average(shares[told].mean(axis=1), weights=self.tracks[told])) if told.any() else float("nan")

    def scaled(self, prediction: "TrackPrediction") -> "TrackPrediction":
        """The prediction with conformal sigmas, infinite beyond the last bin with enough calibration tracks."""
        bins = _bins(prediction)
        scales = np.concatenate((self.scales, np.full((1, 3), np.inf)))[np.minimum(bins, len(self.scales))]
        return replace(prediction, sigmas=prediction.sigmas * scales, conformal=self)

    def save(self, path: str | Path) -> None:
        """Writes a YAML file that `load_conformal` reads.

        Args: path: of the file.
        Raises:
            FileNotFoundError: the folder of the path does not exist.
            ValueError: the path is a folder.
        """
        content = {key: getattr(self, key) for key in _FIELDS}
        content |= {key: content[key].tolist() for key in _ARRAYS}
        content |= {"level": LEVEL, "bin": BIN, "statuses": dict(self.statuses)}
        write_text(Path(path), yaml.safe_dump({FILE_SECTION: content}, sort_keys=False, default_flow_style=None))

    def check_fits(self, observe: float, method: str) -> None:
        """Refuses scales that were made from another observed part or by another estimator.

        Args: observe: s, the observed part of the tracks to predict.  method: name of the estimator that predicts them.
        Raises: ValueError: if one of them differs.
        """
        if not isclose(observe, self.observe) or method != self.method:
            raise ValueError(
                f"conformal must be calibrated as the tracks are predicted: with {observe:g} s observed, by {method}; "
                f"the scales from {shown(self.source)} have {self.observe:g} s by {self.method}. Calibrate again."
            )


_ARRAYS: Final = ("tracks", "scales", "own", "held")
_FIELDS: Final = ("source", "observe", "method", "statuses", *_ARRAYS)


def load_conformal(path: str | Path) -> ConformalScales:
    """Scales from a file that `ConformalScales.save` wrote.

    Args: path: of the YAML file.
    Raises:
        FileNotFoundError: no such file.
        ValueError: another content; the message names file and field.
    """
    path = check_path("path", path)
    content = mapping(f"{path}: section '{FILE_SECTION}'", read_mapping(path).get(FILE_SECTION))
    known = (*_FIELDS, "level", "bin")
    check_keys(str(path), content, known, known)
    if (content["level"], content["bin"]) != (LEVEL, BIN):
        got = f"{shown(content['level'])} and {shown(content['bin'])}"
        raise ValueError(f"{path}: level and bin must be {LEVEL:g} and {BIN:g} s; got {got}. Calibrate again.")
    try:
        tracks = np.array(content["tracks"], dtype=np.int64)
        tables = {key: np.array(content[key], dtype=np.float64) for key in _ARRAYS[1:]}
        observe = float(content["observe"])
        statuses = {str(text): int(number) for text, number in content["statuses"].items()}
    except (TypeError, ValueError, AttributeError, OverflowError) as error:
        got = short_text(one_line(error))
        raise ValueError(f"{path}: must be as it was written; {got}. Calibrate again.") from error
    for key, table in tables.items():
        if tracks.ndim != 1 or table.shape != (len(tracks), 3):
            rule = f"must have three numbers for each of the {tracks.size} bins"
            raise ValueError(f"{path}: {key} {rule}; got {table.shape}. Calibrate again.")
    if not (tables["scales"] > 0.0).all():
        raise ValueError(f"{path}: scales must be positive; got {tables['scales'].min():g}. Calibrate again.")
    return ConformalScales(str(content["source"]), observe, str(content["method"]), tracks, **tables, statuses=statuses)


def check_calibration_tracks(calibration: "Dataset | SightedDataset", dataset: "Dataset | SightedDataset") -> None:
    """Refuses calibration tracks that are not exchangeable with the tracks to predict.

    Args: calibration: the calibration dataset.  dataset: the one to predict.
    Raises: ValueError: if they are the same folder, or their balls or the heights of their tables differ.
    """
    if calibration.path.resolve() == dataset.path.resolve():
        raise ValueError(
            f"conformal must hold other tracks than those that are predicted; got {calibration.path} for both. "
            "Write one part of the tracks to a folder of its own."
        )
    rule = ""
    if calibration.ball != dataset.ball:
        rule = f"of the same ball, {dataset.ball}; got {calibration.ball}"
    elif not isclose(calibration.table, dataset.table, rel_tol=0.0, abs_tol=TABLE_TOLERANCE):
        own, other = (Surfaces.table_tennis(one.table) for one in (dataset, calibration))
        rule = f"with the same surface, {own}; got {other}"
    if rule:
        remedy = "Give calibration tracks of the same kind."
        raise ValueError(f"conformal must hold tracks {rule} in {calibration.path}. {remedy}")


@dataclass(frozen=True)
class _Bin:
    """The scores (m, 3) of all calibration tracks in a bin of the horizon, and (m,) the number of the track of each."""

    scores: Array
    track: Index

    @property
    def count(self) -> int:
        """Number of tracks."""
        return int(self.track[-1]) + 1 if len(self.track) else 0

    @property
    def weights(self) -> Array:
        """(m,) weight of each sample: one divided by the number of its track's samples."""
        return np.asarray(1.0 / np.bincount(self.track)[self.track])

    def quantile(self) -> Array:
        """(3,) conformal quantile along each axis."""
        orders = np.argsort(self.scores, axis=0).T
        columns = zip(self.scores.T, orders, strict=True)
        return np.array([_quantile(column[order], self.weights[order], self.count) for column, order in columns])

    def share(self, limit: float) -> Array:
        """(3,) share of the scores within a limit, each track with the same weight; NaN without any."""
        samples = np.bincount(self.track)
        held = [np.bincount(self.track, column <= limit) for column in self.scores.T]
        return np.mean(held / samples, axis=1) if self.count else np.full(3, np.nan)

    def left_out_share(self) -> Array:
        """(3,) share of the scores within the quantile of the other tracks; NaN where too few tracks are left."""
        if self.count <= FEWEST:
            return np.full(3, np.nan)
        held = np.zeros(3)
        for axis, column in enumerate(self.scores.T):
            order = np.argsort(column)
            scores, weights, track = column[order], self.weights[order], self.track[order]
            for number in range(self.count):
                own = track == number
                limit = _quantile(scores, np.where(own, 0.0, weights), self.count - 1)
                held[axis] += (scores[own] <= limit).mean()
        return held / self.count


def _quantile(scores: Array, weights: Array, count: int) -> float:
    """The smallest of (m,) sorted scores up to which their weights reach LEVEL (count + 1).

    The weights of a track sum to 1. The new track's own weight, also 1, lies at infinity: it may be the worst of all.
    """
    reached = np.cumsum(weights) >= LEVEL * (count + 1) - ROUNDING
    return float(scores[reached.argmax()]) if reached.any() else np.inf


def _by_bin(tracks: list[tuple[Index, Array]]) -> Iterator[_Bin]:
    """The scores of each bin up to the last one that has any, from the bins (k,) and scores (k, 3) of each track."""
    if not tracks:
        return
    bins = np.concatenate([one for one, _ in tracks])
    scores = np.concatenate([one for _, one in tracks])
    track = np.repeat(np.arange(len(tracks)), [len(one) for one, _ in tracks])
    order = np.argsort(bins, kind="stable")
    ends = np.searchsorted(bins[order], np.arange(bins.max() + 2))
    for start, end in pairwise(ends):
        here = order[start:end]
        yield _Bin(scores[here], np.unique(track[here], return_inverse=True)[1])


def _bins(prediction: "TrackPrediction") -> Index:
    """(k,) bin of the horizon of each stamp; a stamp at the end of a bin belongs to it."""
    ahead = elapsed(prediction.times, float(prediction.estimate.times[-1])) / BIN
    return np.maximum(np.ceil(ahead - EDGE).astype(np.int64) - 1, 0)
