"""The types of arrays that all rooms share; shapes and units stand in the docstrings."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]
"""Numbers."""
Index: TypeAlias = NDArray[np.int64]
"""Indices and counts."""
Mask: TypeAlias = NDArray[np.bool_]
"""Which of several things are meant."""
