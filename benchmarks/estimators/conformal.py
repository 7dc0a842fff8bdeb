"""Computes the coverage of conformal intervals on measured tracks, by calibration on random halves."""

from collections.abc import Sequence

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.metrics import Figure, inside
from ballfg.estimation import ConformalScales
from ballfg.estimation.conformal import FEWEST, LEVEL
from ballfg.estimation.track_prediction import TrackPrediction

SPLITS = 200
"""Random splits. The mean of their coverages is then good to 0.3 %; that of a single split has a spread of 3 %."""


def split_coverages(
    predictions: Sequence[TrackPrediction], observe: float, rng: np.random.Generator, splits: int = SPLITS
) -> Array:
    """(splits,) share of measured coordinates of one half in the 90 % intervals that the other half calibrates.

    Args: predictions: of tracks that last longer than the observed part.  observe: s.  rng: draws the halves.
    """
    shares = []
    for _ in range(splits):
        order = rng.permutation(len(predictions))
        half = len(order) // 2
        scales = ConformalScales.of((predictions[i] for i in order[:half]), "half", observe)
        scaled = [scales.scaled(predictions[i]) for i in order[half:]]
        held = [inside(one.measured - one.positions, one.sigmas, LEVEL) for one in scaled]
        shares.append(np.concatenate(held).mean())
    return np.array(shares)


def conformal_coverage(predictions: Sequence[TrackPrediction], observe: float, seed: int) -> Figure | None:
    """Mean coverage over random splits, and the range of 95 % of them; None where half of the tracks are too few."""
    if len(predictions) // 2 < FEWEST:
        return None
    shares = split_coverages(predictions, observe, np.random.default_rng([seed, 6]))
    low, high = np.quantile(shares, [0.025, 0.975])
    return Figure(float(shares.mean()), float(low), float(high))
