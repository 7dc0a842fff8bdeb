"""Segments whole tracks as the smoother does."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from ballfg.dynamics import Surfaces
from ballfg.estimation.segmentation.batch import assembled
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.estimation.segmentation.segmenter import USUAL, Segmenter

TABLE_TENNIS = SegmentationPhysics()


def segment(
    times: np.ndarray,
    positions: np.ndarray,
    sigma: ArrayLike,
    *,
    surfaces: Surfaces,
    physics: SegmentationPhysics = TABLE_TENNIS,
) -> Segmentation:
    """The events at n stamps (s) and positions (n, 3) m; sigma: m, one, (3,) or (n, 3)."""
    found = Segmenter(surfaces, physics).push_all(times, positions, np.broadcast_to(sigma, positions.shape))
    return assembled((*found.final, *found.pending), times, positions, physics, USUAL)
