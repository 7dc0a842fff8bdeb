"""Defines the types of arrays that all rooms share, and their median and form; docstrings state shapes and units."""

from typing import TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]  # Numbers
Index: TypeAlias = NDArray[np.int64]  # Indices and counts
Mask: TypeAlias = NDArray[np.bool_]  # Selects some of several things

N = TypeVar("N", bound=np.generic)
MAD_TO_SIGMA = 1.4826  # Standard deviation of a normal variable divided by the median of its absolute value


def plain(array: NDArray[N]) -> NDArray[N]:
    """An array for machine code: contiguous and writable."""
    return array if array.flags.c_contiguous and array.flags.writeable else np.array(array, order="C")


def median(values: Array) -> Array:
    """Median along the first axis of one or more finite numbers: numpy's own takes ten times as long for a few."""
    ordered, count = np.sort(values, axis=0), len(values)
    return np.asarray(0.5 * (ordered[(count - 1) // 2] + ordered[count // 2]))
