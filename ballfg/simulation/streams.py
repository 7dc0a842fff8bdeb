"""Streams of random numbers: one for each purpose and each block of tracks, all from one seed.

Separate streams keep what is not changed the same: with the same seed, a simulation with wind has the launches and the
measurement noise of the one without.
"""

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

JITTER_LIMIT = 3.0
"""Sigmas at which jitter is cut off: at the largest sigma allowed, 0.15 frames, stamps stay 0.1 frames apart."""


class Purpose(IntEnum):
    """What a stream is for. The numbers are part of what a seed means: never renumber."""

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
    """Standard normals of some shape; those beyond `JITTER_LIMIT` are set to it."""
    return np.clip(rng.standard_normal(shape), -JITTER_LIMIT, JITTER_LIMIT)
