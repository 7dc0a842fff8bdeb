"""Defines the types of arrays that all rooms share, their median, form and table; docstrings state shapes and units."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

if TYPE_CHECKING:
    from pandas import DataFrame

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


def frame_of(columns: Mapping[str, NDArray[Any]]) -> DataFrame:
    """A pandas table of columns (n,). Raises: ImportError: without pandas."""
    try:
        from pandas import DataFrame
    except ImportError as error:
        raise ImportError(f"to_frame needs the package pandas; got {error}. Install it: pip install pandas.") from None
    return DataFrame(columns)
