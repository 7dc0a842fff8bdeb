"""Gives streams of random numbers, one for each purpose and block of tracks, all from one seed.

Separate streams keep unchanged parts equal: with the same seed, a simulation with wind has the same launches and
measurement noise as one without.
"""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

JITTER_LIMIT = 3.0  # Sigmas at which jitter is cut off: at the largest sigma, 0.15 frames, stamps stay 0.1 frames apart


class Purpose(IntEnum):
    """Purposes of streams. The numbers are part of a seed's meaning: never renumber."""

    SETTINGS = 0
    LAUNCH = 1
    PROCESS = 2
    CONTACT = 3
    POSITION = 4
    DROPOUT = 5
    JITTER = 6
    OUTLIER = 7
    LABEL = 8
    MEMORY = 9
    SCENE_START = 100
    SCENE_DROPOUT = 101
    SCENE_JITTER = 102
    SCENE_NOISE = 103
    SCENE_TEXTURE = 104
    SCENE_PHASE = 105


def generator(seed: int, purpose: Purpose, number: int = 0) -> np.random.Generator:
    """The generator of one stream; `number` counts blocks of tracks, passes through the settings, or cameras."""
    return np.random.default_rng([seed, int(purpose), number])


def cut_normal(rng: np.random.Generator, shape: int | tuple[int, ...]) -> NDArray[np.float64]:
    """Standard normals of some shape, limited to `JITTER_LIMIT`."""
    return np.clip(rng.standard_normal(shape), -JITTER_LIMIT, JITTER_LIMIT)
