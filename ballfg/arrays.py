"""Defines the types of arrays that all rooms share; docstrings state shapes and units."""

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Array: TypeAlias = NDArray[np.float64]  # Numbers
Index: TypeAlias = NDArray[np.int64]  # Indices and counts
Mask: TypeAlias = NDArray[np.bool_]  # Selects some of several things
