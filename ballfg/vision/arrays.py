"""Defines the array types of camera code; shapes and units stand where they are used."""

import numpy as np
from numpy.typing import NDArray

Array32 = NDArray[np.float32]
Image = NDArray[np.uint8]  # (h, w, 3) blue, green, red, or (h, w) grey
