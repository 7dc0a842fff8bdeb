"""Where points appear in an image, and parts of images."""

from __future__ import annotations

from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.vision.camera import Camera

Array = NDArray[np.float64]
Rect = tuple[int, int, int, int]
"""Left, top, right, bottom in pixels; right and bottom are the first that are out."""

LENS_TOLERANCE: Final = 1e-6
"""Of x/z and y/z after a way through the lens and back, about a thousandth of a pixel."""


def pixels_of(camera: Camera, points: Array) -> Array:
    """(..., 2) pixels of points (..., 3) m; NaN for those that the lens cannot show.

    A polynomial of distortion turns back far outside of the image: a point well beside the camera would land in the
    picture. So what a pixel shows is looked up again, and must be the point that was projected to it.
    """
    pixels = camera.project(points)
    local = points @ camera.rotation.T + camera.tvec
    shown = np.flatnonzero(np.isfinite(pixels).all(axis=-1))
    flat, local = pixels.reshape(-1, 2), local.reshape(-1, 3)[shown]
    plane = local[:, :2] / local[:, 2:]
    wrong = (np.abs(camera.normalized(flat[shown]) - plane) > LENS_TOLERANCE * (1 + np.abs(plane))).any(axis=-1)
    flat[shown[wrong]] = np.nan
    return flat.reshape(pixels.shape)


def inside(camera: Camera, pixels: Array, reach: Array | float = 0.0) -> NDArray[np.bool_]:
    """(...) whether discs of radius `reach` (...) px about pixels (..., 2) lie in the image; False for NaN."""
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
    """A part of the image with a margin in px, as far as the image goes."""
    left, top, right, bottom = rect
    width, height = camera.size
    return max(left - by, 0), max(top - by, 0), min(right + by, width), min(bottom + by, height)
