"""Defines the types of arrays that all rooms share, their median, form, fits and table; they state shapes and units."""

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


LEAST_SCATTER = 1e-9  # m, of positions about a quadratic


def quadratics(times: Array, positions: Array) -> tuple[Array, Array]:
    """(w, 3, 3) coefficients of quadratics, highest power first, and (w,) m^2 variances about them.

    Args: times: (w, m) s; the coefficients are those about the middle of each window.  positions: (w, m, 3) m.
    """
    basis = np.stack([(times - times.mean(axis=1, keepdims=True)) ** power for power in (2, 1, 0)], axis=-1)
    basis /= (scale := np.abs(basis).max(axis=1, keepdims=True))
    found = np.linalg.solve(basis.swapaxes(-1, -2) @ basis, basis.swapaxes(-1, -2) @ positions)
    left = positions - basis @ found
    variance = (left**2).sum(axis=(1, 2)) / (3.0 * (times.shape[1] - 3))
    return found / scale.swapaxes(-1, -2), np.maximum(variance, LEAST_SCATTER**2)


def frame_of(columns: Mapping[str, NDArray[Any]]) -> DataFrame:
    """A pandas table of columns (n,). Raises: ImportError: without pandas."""
    try:
        from pandas import DataFrame
    except ImportError as error:
        raise ImportError(f"to_frame needs the package pandas; got {error}. Install it: pip install pandas.") from None
    return DataFrame(columns)
