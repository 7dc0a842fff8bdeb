"""Ridges of lines: in the middle between unlike grounds, none where another line is in the way; their factor."""

import cv2
import gtsam
import numpy as np
import pytest

from ballfg.benchmarks.cameras.hall import COURT, looking, picture
from ballfg.vision.broadcast import graph
from ballfg.vision.broadcast.lines import CROSSING, brightness, ridges

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


def test_derivatives_of_the_factor_are_those_of_differences(seen):
    """Of a picture's ridges by turn, place, focal length, lens and the shift of each line."""
    like, lines = looking((0.5, -7.02, 3.0), (0.02, 0.0, 0.0), 1003.0), seen[0]
    factor = graph._court_factor(0, like, lines)
    turn, place, zoom, lens, shift = keys = factor.keys()
    values = gtsam.Values()
    values.insert(turn, gtsam.Rot3(like.turn.T))
    values.insert(place, gtsam.Point3(like.place))
    values.insert(zoom, np.array([np.log(like.focal)]))
    values.insert(lens, np.array([-0.02]))
    values.insert(shift, np.linspace(-0.3, 0.3, len(COURT.lines)))
    found = factor.linearize(values).jacobian()[0]
    widths, column = (3, 3, 1, 1, len(COURT.lines)), 0
    for key, width in zip(keys, widths, strict=True):
        for number in range(width):
            ends = []
            for way in (1e-6, -1e-6):
                step = gtsam.VectorValues()
                for other, count in zip(keys, widths, strict=True):
                    step.insert(other, way * np.eye(count)[number] if other == key else np.zeros(count))
                ends.append(factor.unwhitenedError(values.retract(step)))
            np.testing.assert_allclose(found[:, column], (ends[0] - ends[1]) / 2e-6, atol=1e-4, rtol=1e-5)
            column += 1
