"""Ridges of a court's lines: in the middle between unlike grounds, and none where another line is in the way."""

import cv2
import numpy as np
import pytest

from ballfg.vision.broadcast.lines import CROSSING, brightness, ridges
from tests.vision.broadcast.scene import COURT, looking, picture

CAMERA = looking((0.5, -7.0, 3.0), (0.0, 0.0, 0.0), 1000.0)


@pytest.fixture(scope="module")
def seen():
    """Ridges of pictures with the half resolution of colour that videos have, at the true camera."""
    packed = [picture(CAMERA, np.random.default_rng(seed)) for seed in range(8)]
    flat = [cv2.cvtColor(image, cv2.COLOR_BGR2YUV_I420) for image in packed]
    return [ridges(brightness(cv2.cvtColor(one, cv2.COLOR_YUV2BGR_I420)), CAMERA, COURT, 3.0) for one in flat]


def test_a_line_lies_in_the_middle_whatever_the_ground_on_both_sides(seen):
    """The table's edges have the blue table on one side and the dark floor on the other."""
    for line in range(4):
        off = np.concatenate([one.offset[one.line == line] for one in seen])
        assert abs(np.median(off)) < 0.07
        assert np.percentile(np.abs(off), 90) < 0.5


def test_no_ridge_is_sought_where_another_line_is_in_the_way(seen):
    """The middle line has none where it meets the edges, nor below the upper edge of the net."""
    ends = CAMERA.project(COURT.lines)
    for number, (first, second) in enumerate(ends):
        others = np.concatenate([one.points[one.line != number] for one in seen])
        pixels, along = CAMERA.project(others), second - first
        share = np.clip((pixels - first) @ along / (along @ along), 0.0, 1.0)
        assert np.linalg.norm(pixels - first - share[:, None] * along, axis=1).min() > CROSSING - 1e-9
    middle = np.concatenate([one.points[one.line == 4, 0] for one in seen])
    assert 0 < len(middle) < 8 * 24
