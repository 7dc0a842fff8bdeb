"""Splits the tracks into two halves of unlike shots, of which each judges what the other one taught.

An effect that is there gains on other shots what it promises; what stands for missing physics at these shots does not.
"""

from typing import Final

import numpy as np
from scipy.cluster.vq import kmeans2

from ballfg.arrays import Array, Mask
from ballfg.diagnosis.fit.problem import Fit
from ballfg.state import SPIN, VELOCITY

LEAST_SHARE: Final = 0.25  # Of the tracks in the smaller half: a few shots teach too little about the others
LENGTH: Final = 0.5
"""s of flight at the usual speed, the distance between places of launch that counts as much as that speed does."""

ALIKE: Final = 1e-9  # Shots that differ by less are equal: any halves will do


def unlike_halves(fit: Fit) -> Mask:
    """(t,) which half each track belongs to, in order: those of similar first states to the same one.

    Two means of the launches, in units of their usual speed and spin, give the direction along which the tracks are
    split between them.
    """
    away = _launches(fit)
    place = away @ np.linalg.svd(away, full_matrices=False)[2][0]
    if np.ptp(place) > ALIKE:
        lower, upper = np.split(np.argsort(place, kind="stable"), [len(place) // 2])  # equal places: neither is empty
        begun = np.stack([away[upper].mean(axis=0), away[lower].mean(axis=0)])
        means, _ = kmeans2(away, begun, minit="matrix", missing="raise")
        place = (away - means.mean(axis=0)) @ (means[0] - means[1])
    count, halves = len(place), np.full(len(place), False)
    least = round(LEAST_SHARE * count)
    halves[np.argsort(place, kind="stable")[int(np.clip((place <= 0.0).sum(), least, count - least)) :]] = True
    return halves


def _launches(fit: Fit) -> Array:
    """(t, 9) the first state of each track less the mean, in units of the usual speed and spin.

    Tracks whose coefficients differ as declared, such as those of another room, have a mean of their own: both halves
    hold some of them.
    """
    stretches = fit.problem.stretches
    _, first = np.unique(stretches.track, return_index=True)
    states = fit.unknowns.starts[first]
    speed, spin = (float(np.sqrt((states[:, part] ** 2).sum(axis=1).mean())) or 1.0 for part in (VELOCITY, SPIN))
    scaled = states / np.repeat([LENGTH * speed, speed, spin], 3)
    declared = [deviation.along(stretches)[first] for deviation in fit.problem.deviations.values()]
    _, kinds = np.unique(np.stack([np.ones(len(first)), *declared], axis=1), axis=0, return_inverse=True)
    for kind in np.unique(kinds):
        scaled[kinds == kind] -= scaled[kinds == kind].mean(axis=0)
    return scaled
