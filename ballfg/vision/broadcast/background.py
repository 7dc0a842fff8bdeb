"""Matches the background of each picture with that of the one before, and finds cuts, where nothing matches."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array
from ballfg.vision.arrays import Image

MOST: Final = 400  # points that are followed from one picture to the next
QUALITY, APART = 0.005, 12.0  # of corners: least share of the best one's strength; least distance, px
BACK: Final = 0.7  # px by which a point that is followed forth and back may miss itself
ALIKE: Final = 1.5  # px about a homography within which a point is background
FEWEST, SHARE = 25, 0.35
"""Background points, and their share of those that were followed, at least, of pictures that follow each other."""
KEPT: Final = 60  # background points of a pair that are kept, spread over the picture
WINDOW, LEVELS = (21, 21), 4  # px, and pyramid levels, of Lucas and Kanade's method: pans reach 40 px a picture


@dataclass(frozen=True, eq=False)
class Match:
    """Background points (n, 2) px in a picture and in the one before it, and the homography from `before` to `now`."""

    before: Array
    now: Array
    homography: Array


def linked(pair: tuple[Image | None, Image]) -> tuple[Image, Match | None]:
    """The second of two pictures with its match with the one before; None for a cut, or where none is before."""
    before, now = (
        None if image is None else np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.uint8) for image in pair
    )
    return pair[1], None if before is None or now is None else matched(before, now)


def matched(before: Image, now: Image) -> Match | None:
    """The background of two grey pictures (h, w); None if they show nothing in common."""
    corners = cv2.goodFeaturesToTrack(before, MOST, QUALITY, APART)
    if corners is None or len(corners) < FEWEST:
        return None
    start = corners.reshape(-1, 1, 2)
    end, found, _ = cv2.calcOpticalFlowPyrLK(before, now, start, start.copy(), winSize=WINDOW, maxLevel=LEVELS)
    again, back, _ = cv2.calcOpticalFlowPyrLK(now, before, end, end.copy(), winSize=WINDOW, maxLevel=LEVELS)
    steady = (np.linalg.norm(again - start, axis=2) < BACK) & (found > 0) & (back > 0)
    rows = np.flatnonzero(steady.reshape(-1))
    if len(rows) < max(FEWEST, SHARE * len(start)):
        return None
    first, second = start[rows, 0].astype(np.float64), end[rows, 0].astype(np.float64)
    cv2.setRNGSeed(0)
    homography, inside = cv2.findHomography(first, second, cv2.RANSAC, ALIKE, maxIters=2000, confidence=0.999)
    if homography is None or inside.sum() < max(FEWEST, SHARE * len(start)):
        return None
    kept = np.flatnonzero(inside.ravel())
    kept = kept[:: -(-len(kept) // KEPT)]  # corners come by strength, not by place: any subset is spread
    return Match(first[kept], second[kept], np.asarray(homography, dtype=np.float64))
