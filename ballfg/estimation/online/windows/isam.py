"""Sets up the iSAM2 of a window, and updates that keep its points."""

from collections.abc import Iterable, Sequence

import gtsam

from ballfg.arrays import Array
from ballfg.factors.bridge import COEFFICIENT_KEY

WILDFIRE = 1e-7
"""m, m/s, rad/s. Back-substitution stops where the solution changes by less."""


def eliminating_last(last: Sequence[int], every: Sequence[int]) -> gtsam.ISAM2UpdateParams:
    """An update of iSAM2 that moves no point and eliminates all variables anew, some of them last."""
    how, groups = gtsam.ISAM2UpdateParams(), gtsam.KeyGroupMap()
    how.extraReelimKeys = how.noRelinKeys = key_list(every)
    for key in last:
        groups.insert2(key, 2 if key == COEFFICIENT_KEY else 1)
    how.constrainedKeys = groups
    return how


def key_list(keys: Iterable[int]) -> gtsam.KeyList:
    """Keys as GTSAM takes them."""
    found = gtsam.KeyList()
    for key in keys:
        found.push_back(key)
    return found


def parameters(threshold: Array, coefficient_threshold: Array) -> gtsam.ISAM2Params:
    """QR, because a loose spin prior beside a tight process noise defeats Cholesky."""
    parameters = gtsam.ISAM2Params()
    parameters.setFactorization("QR")
    parameters.relinearizeSkip = 1
    parameters.findUnusedFactorSlots = True
    thresholds = gtsam.ISAM2ThresholdMap()
    thresholds.insert(("x", threshold))
    if len(coefficient_threshold):
        thresholds.insert(("c", coefficient_threshold))
    parameters.setRelinearizeThreshold(thresholds)
    solver = gtsam.ISAM2GaussNewtonParams()
    solver.setWildfireThreshold(WILDFIRE)
    parameters.setOptimizationParams(solver)
    return parameters
