"""Computes the coverage of predictions: the share of coordinates inside their 90 % intervals, by horizon."""

from collections.abc import Iterable
from dataclasses import dataclass
from statistics import NormalDist

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.pages.shot import SAME_STAMP, ShownShot

LEVEL = 0.9  # Nominal coverage of an interval
HALF_WIDTH = NormalDist().inv_cdf((1.0 + LEVEL) / 2.0)
"""Standard deviations on either side of a prediction for that coverage."""
BIN = 0.05  # s, width of the bins of the horizon


@dataclass(frozen=True)
class Coverage:
    """Shares by horizon, the time since the last sample before the first predicted one.

    Attributes:
        horizons: (b,) s, the middle of each bin that holds samples.
        shares: (b, 3) of the coordinates x, y, z inside their intervals, 0 to 1.
        samples: (b,) counts.  shots: (b,) counts.
    """

    horizons: Array
    shares: Array
    samples: Index
    shots: Index


def coverage(shots: Iterable[ShownShot]) -> Coverage:
    """The coverage of the predictions of many shots.

    Args: shots: with samples and predictions; samples outside of the predicted part are left out.
    """
    held: dict[int, Array] = {}
    samples: dict[int, int] = {}
    tracks: dict[int, int] = {}
    for shot in shots:
        errors = np.abs(shot.prediction_errors())
        known = np.isfinite(errors).all(axis=1)
        before = shot.times[shot.times < shot.predicted_times[0]] if len(shot.predicted_times) else shot.times
        if not known.any() or not len(before):
            continue
        inside = errors[known] <= HALF_WIDTH * shot.predicted_sigmas[known]
        bins = np.floor((shot.predicted_times[known] - before[-1] + SAME_STAMP) / BIN).astype(int)
        for b in np.unique(bins).tolist():
            held[b] = held.get(b, np.zeros(3)) + inside[bins == b].sum(axis=0)
            samples[b] = samples.get(b, 0) + int((bins == b).sum())
            tracks[b] = tracks.get(b, 0) + 1
    order = sorted(held)
    counts = np.array([samples[b] for b in order], dtype=np.int64)
    sums = np.array([held[b] for b in order]).reshape(-1, 3)
    middles = (np.array(order, dtype=np.float64) + 0.5) * BIN
    return Coverage(middles, sums / counts[:, None], counts, np.array([tracks[b] for b in order], dtype=np.int64))
