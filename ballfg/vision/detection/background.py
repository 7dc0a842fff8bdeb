"""Learns a camera's background, follows slow changes and flickering light, and finds regions that differ from it.

The regions of a frame are connected changes of plausible size in the small picture; they get a closer look.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import MAD_TO_SIGMA, Array, Mask
from ballfg.vision.arrays import Array32, Image

SHRINK: Final = 4  # pixels of the image per pixel of the small picture for the search
GRID: Final = (16, 9)  # blocks, across and down, for the brightness of the light; their median is no moving thing
BRIGHT: Final = (8.0, 245.0)  # grey levels of the blocks that count: darker ones are noise, brighter ones are clipped
STRIPS: Final = 32  # a frame refreshes one strip of the background: all of it would cost more than the search
WEIGHT: Final = 0.08  # of a frame in its strip; a still object fades in over STRIPS / WEIGHT = 400 frames
COVERED_WEIGHT: Final = 0.008  # where something was found: a ball leaves 0.5 of 60 grey levels
SIGMAS: Final = 5.0  # noise sigmas of the small picture, at that place, that a change must exceed to be looked at
LEAST_CHANGE: Final = 5.0  # grey levels that it must exceed besides: errors of compression and rounding
ROUNDING: Final = 1.0 / 12.0  # grey levels^2, variance of rounding; a noise-free video's covariance stays regular
FEWEST: Final = 3  # images that a background is learned from at least
MARGIN: Final = 6  # px of background around a region: the mask misses up to a small pixel of the rim
LEAST_MASS: Final = 12.0  # Grey levels x small pixels: a ball of 4 px and 15 grey levels. Less is noise or lost to it.


class Background:
    """Background, its noise, and the brightness of the light in the present frame.

    Args: images: at least three, of one size (h, w, 3), in which nothing but the background is in the same place in
        half of them. Fifteen are plenty.

    Attributes:
        full: (h, w, 3) float32, grey levels at the mean light.
        small: (h/4, w/4, 3) float32, the same, shrunk.
        threshold: (h/4, w/4) uint8 grey levels: what differs by more is not noise.
        noise: (3, 3) grey levels^2, covariance of a pixel's channels.
        blotches: px, at least one, across which noise is shared: compression and interpolated colours make blotches. A
            fit to an edge, a line of pixels, has that many times the variance that noise of single pixels would give.
        gains: (3,) light of the present frame over the mean light, by channel; set by `follow`.

    Raises: ValueError: too few images, or of several sizes.
    """

    def __init__(self, images: Sequence[Image]) -> None:
        if (few := len(images)) < FEWEST:
            raise ValueError(f"images must be at least three to learn a background; got {few}. Pass more frames.")
        shapes = {image.shape for image in images}
        if len(shapes) > 1 or len(images[0].shape) != 3 or images[0].shape[2] != 3:
            raise ValueError(f"images must have one shape (h, w, 3); got {sorted(shapes)}. Pass frames of one camera.")
        grids = np.stack([_grid(shrunk(image)) for image in images])
        self._grid = np.maximum(np.median(grids, axis=0), 1.0)
        gains = [_gains(grid, self._grid) for grid in grids]
        level = [_lit(image, 1.0 / gain, cv2.CV_8U) for image, gain in zip(images, gains, strict=True)]
        middle = _median(level)
        self.noise = _noise(level, middle)
        self.full = _mean_near(level, middle, 3.0 * float(np.sqrt(self.noise.max())))
        self.small = np.asarray(shrunk(self.full), dtype=np.float32)
        self.blotches = _blotches(level, self.full, self.noise)
        # larger at noise, at edges under compression, and at moving leaves
        spread = _median([cv2.absdiff(shrunk(image), self.small.astype(np.uint8)) for image in level])
        restless = cv2.dilate(spread.max(axis=2), np.ones((3, 3), dtype=np.uint8))
        sigma = np.hypot(MAD_TO_SIGMA * restless, np.sqrt(self.noise.max()) / SHRINK)
        self.threshold = np.minimum(LEAST_CHANGE + SIGMAS * sigma, 255.0).astype(np.uint8)
        self.gains: Array = np.ones(3)
        self._strip = 0

    @property
    def shape(self) -> tuple[int, int]:
        """Height and width, px."""
        return (self.full.shape[0], self.full.shape[1])

    def follow(self, small: Image) -> Image:
        """The change (h/4, w/4) uint8 grey levels in a frame's small picture, of the channel that differs most."""
        self.gains = _gains(_grid(small), self._grid)
        expected = _lit(self.small, self.gains, cv2.CV_8U)
        blue, green, red = cv2.split(cv2.absdiff(small, expected))
        return np.asarray(cv2.max(cv2.max(blue, green), red), dtype=np.uint8)

    def patch(self, rows: slice, columns: slice) -> Array32:
        """(rows, columns, 3) background of the present frame, grey levels."""
        return np.asarray(self.full[rows, columns] * self.gains.astype(np.float32), dtype=np.float32)

    def absorb(self, image: Image, small: Image, found: Image) -> None:
        """Takes light and clouds of a frame into the background; found: (h/4, w/4) uint8, 255 where covered."""
        height, width = self.shape
        rows = slice(self._strip * height // STRIPS, (self._strip + 1) * height // STRIPS)
        self._strip = (self._strip + 1) % STRIPS
        if rows.stop == rows.start:
            return
        covered = cv2.dilate(found, np.ones((3, 3), dtype=np.uint8))
        top, bottom = rows.start * found.shape[0] // height, -(-rows.stop * found.shape[0] // height)
        here = cv2.resize(covered[top:bottom], (width, rows.stop - rows.start), interpolation=cv2.INTER_NEAREST)
        level, behind = _lit(image[rows], 1.0 / self.gains, cv2.CV_32F), self.full[rows]
        cv2.accumulateWeighted(level, behind, WEIGHT, cv2.bitwise_not(here))
        cv2.accumulateWeighted(level, behind, COVERED_WEIGHT, here)
        self.small[top:bottom] = shrunk(self.full[top * SHRINK : bottom * SHRINK])[: bottom - top]


def shrunk(image: Image | Array32) -> NDArray:
    """An image (h, w, 3) at a quarter of its size (means of 4 x 4 pixels); a rest of fewer than 4 pixels is cut off."""
    height, width = (side // SHRINK * SHRINK for side in image.shape[:2])
    if min(height, width) == 0:
        raise ValueError(f"an image must have at least {SHRINK} x {SHRINK} pixels; got {image.shape}.")
    half = cv2.resize(image[:height, :width], (width // 2, height // 2), interpolation=cv2.INTER_AREA)
    return cv2.resize(half, (width // SHRINK, height // SHRINK), interpolation=cv2.INTER_AREA)


def _lit(image: NDArray, gains: Array, depth: int) -> NDArray:
    """An image (h, w, 3) in a light that is brighter by gains (3,), in OpenCV's depth."""
    return cv2.multiply(image, np.append(gains, 0.0), dtype=depth)


def _grid(small: NDArray) -> Array32:
    """(9, 16, 3) means of blocks."""
    return np.asarray(cv2.resize(small, GRID, interpolation=cv2.INTER_AREA), dtype=np.float32)


def _gains(grid: Array32, reference: Array32) -> Array:
    """(3,) median over blocks of the ratio to the reference; one where no block is bright enough."""
    known = ((reference > BRIGHT[0]) & (reference < BRIGHT[1])).all(axis=2)
    if not known.any():
        return np.ones(3)
    ratios = grid[known] / reference[known]
    middle = len(ratios) // 2
    return np.maximum(np.partition(ratios, middle, axis=0)[middle], 1.0 / BRIGHT[0]).astype(np.float64)


def _median(images: Sequence[NDArray]) -> Image:
    """Pixelwise median (the upper one of two) by a sorting network: neighbours change places until all are in order."""
    ranks = [np.asarray(image) for image in images]
    for turn in range(len(ranks)):
        for i in range(turn % 2, len(ranks) - 1, 2):
            ranks[i], ranks[i + 1] = cv2.min(ranks[i], ranks[i + 1]), cv2.max(ranks[i], ranks[i + 1])
    return np.asarray(ranks[len(ranks) // 2], dtype=np.uint8)


def _mean_near(images: Sequence[NDArray], middle: Image, near: float) -> Array32:
    """(h, w, 3) mean of what lies within `near` of the median: its noise is a quarter of the median's rounding."""
    total, count = np.zeros(middle.shape, dtype=np.float32), np.zeros(middle.shape, dtype=np.float32)
    for image in images:
        close = (cv2.absdiff(image, middle) <= max(near, 1.0)).astype(np.float32)
        count += close
        total += close * image
    return np.asarray(np.where(count > 0, total / np.maximum(count, 1.0), middle), dtype=np.float32)


def _noise(images: Sequence[NDArray], middle: Image) -> Array:
    """(3, 3) covariance of the channels about the median, from pixels where nothing passed."""
    stride = max(1, middle.shape[0] * middle.shape[1] // 20000)
    flat = middle.reshape(-1, 3)[::stride].astype(np.float64)
    rest = np.concatenate([image.reshape(-1, 3)[::stride] - flat for image in images])
    far = np.abs(rest).max(axis=1)
    calm = rest[far <= 3.0 * (np.median(far) + 1.0)]
    return np.asarray(np.cov(calm.T, bias=True) * len(images) / (len(images) - 1) + ROUNDING * np.eye(3))


def _blotches(images: Sequence[NDArray], mean: Array32, noise: Array) -> float:
    """Root of the area that shares its noise: the variance in means of 4 x 4 pixels, times 16, over that of a pixel."""
    rest = np.concatenate([shrunk(image - mean).reshape(-1, 3) for image in images[:: max(1, len(images) // 4)]])
    far = np.abs(rest).max(axis=1)
    calm = rest[far <= 3.0 * np.median(far) + ROUNDING]
    return max(1.0, float(np.sqrt((calm**2).mean(axis=0).sum() * SHRINK**2 / np.trace(noise))))


@dataclass(frozen=True, eq=False)
class Region:
    """A connected change."""

    rows: slice  # of the image, with a margin
    columns: slice
    free: Mask | None  # (rows, columns) True for pixels of this region or the background; None if all are
    mass: float  # grey levels x small pixels, the change summed

    def free_of(self, values: NDArray[np.float32]) -> NDArray[np.float32]:
        """(m, ...) the values (rows, columns, ...) of free pixels."""
        return values.reshape(-1, *values.shape[2:]) if self.free is None else values[self.free]

    def places(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """(m,) px, x and y of the free pixels."""
        x = np.arange(self.columns.start, self.columns.stop, dtype=np.float32)
        y = np.arange(self.rows.start, self.rows.stop, dtype=np.float32)
        shape = (len(y), len(x))
        return self.free_of(np.broadcast_to(x, shape)), self.free_of(np.broadcast_to(y[:, None], shape))


def find_regions(background: Background, image: Image, widest: float, longest: float, most: int) -> list[Region]:
    """Regions of a frame (h, w, 3), at most so many, the heaviest first; widest ball and longest streak in px."""
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
