"""Locates points in an image, and parts of images."""

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.vision.camera import Camera

Rect = tuple[int, int, int, int]  # Left, top, right, bottom in pixels; right and bottom are the first ones outside


def inside(camera: Camera, pixels: Array, reach: Array | float = 0.0) -> NDArray[np.bool_]:
    """(...) True for discs of radius `reach` (...) px about pixels (..., 2) inside the image; False for NaN."""
    reach = np.asarray(reach)[..., None]
    return np.asarray(((pixels - reach >= -0.5) & (pixels + reach < np.array(camera.size) - 0.5)).all(axis=-1))


def clipped(camera: Camera, pixels: Array, margin: float) -> Rect | None:
    """The part of the image around pixels (n, 2), with a margin in px; None if it is empty."""
    low = np.maximum(np.floor(pixels.min(axis=0) - margin), 0)
    high = np.minimum(np.ceil(pixels.max(axis=0) + margin) + 1, camera.size)
    if not (low < high).all():
        return None
    return int(low[0]), int(low[1]), int(high[0]), int(high[1])


def grown(camera: Camera, rect: Rect, by: int) -> Rect:
    """A part of the image with a margin in px, clipped at the image's border."""
    left, top, right, bottom = rect
    width, height = camera.size
    return max(left - by, 0), max(top - by, 0), min(right + by, width), min(bottom + by, height)
