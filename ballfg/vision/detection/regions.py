"""Finds regions of a frame for a closer look: connected changes of plausible size in the small picture."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Mask
from ballfg.vision.arrays import Image
from ballfg.vision.detection.background import SHRINK, Background, shrunk

MARGIN: Final = 6  # px of background around a region: the mask misses up to a small pixel of the rim
LEAST_MASS: Final = 12.0  # Grey levels x small pixels: a ball of 4 px and 15 grey levels. Less is noise or lost to it.


@dataclass(frozen=True, eq=False)
class Region:
    """A connected change.

    Attributes:
        rows, columns: of the image, with a margin.
        free: (rows, columns) True for pixels of this region or the background, not of another; None if all are.
        mass: grey levels x small pixels, the change summed.
    """

    rows: slice
    columns: slice
    free: Mask | None
    mass: float

    def free_of(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(m, ...) the values (rows, columns, ...) of free pixels."""
        if self.free is None:
            return values.reshape(-1, *values.shape[2:])
        return values[self.free]

    def places(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(m,) px, x and y of the free pixels."""
        x = np.arange(self.columns.start, self.columns.stop, dtype=np.float32)
        y = np.arange(self.rows.start, self.rows.stop, dtype=np.float32)
        shape = (len(y), len(x))
        return self.free_of(np.broadcast_to(x, shape)), self.free_of(np.broadcast_to(y[:, None], shape))


def find_regions(background: Background, image: Image, widest: float, longest: float, most: int) -> list[Region]:
    """Regions of one frame, the heaviest first; the background follows the frame.

    Args: image: (h, w, 3).  widest, longest: px, of a ball and of its streak.  most: how many at most.
    """
    small = shrunk(image)
    change = background.follow(small)
    found = cv2.compare(change, background.threshold, cv2.CMP_GT)
    joined = np.asarray(cv2.morphologyEx(found, cv2.MORPH_CLOSE, np.ones((3, 3), dtype=np.uint8)), dtype=np.uint8)
    background.absorb(image, small, joined)
    regions = []
    for contour in cv2.findContours(joined, cv2.RETR_EXTERNAL, cv2.CHAIN_APPROX_NONE)[0]:
        _, sides, _ = cv2.minAreaRect(contour)  # from middle to middle of the outermost pixels: a pixel short
        if min(sides) * SHRINK <= widest and max(sides) * SHRINK <= widest + longest:
            regions.append(_region(joined, change, cv2.boundingRect(contour), contour[0, 0], background.shape))
    heavy = [region for region in regions if region.mass >= LEAST_MASS]
    return sorted(heavy, key=lambda region: -region.mass)[:most]


def _region(joined: Image, change: Image, box: Sequence[int], seed: NDArray, shape: tuple[int, int]) -> Region:
    """The region in a box (left, top, width, height) of the small picture that holds the pixel `seed`."""
    left, top, width, height = box
    rows = slice(max(top * SHRINK - MARGIN, 0), min((top + height) * SHRINK + MARGIN, shape[0]))
    columns = slice(max(left * SHRINK - MARGIN, 0), min((left + width) * SHRINK + MARGIN, shape[1]))
    y = np.minimum(np.arange(rows.start, rows.stop) // SHRINK, joined.shape[0] - 1)
    x = np.minimum(np.arange(columns.start, columns.stop) // SHRINK, joined.shape[1] - 1)
    near = np.s_[y[0] : y[-1] + 1, x[0] : x[-1] + 1]
    count, labels = cv2.connectedComponents(joined[near], connectivity=8)
    own = labels == labels[seed[1] - y[0], seed[0] - x[0]]
    mass = float(change[near][own].sum())
    if count <= 2:
        return Region(rows, columns, None, mass)
    others = cv2.dilate(((joined[near] > 0) & ~own).astype(np.uint8), np.ones((3, 3), dtype=np.uint8)) > 0
    free = ~(others & ~own)[np.ix_(y - y[0], x - x[0])]
    return Region(rows, columns, free, mass)
