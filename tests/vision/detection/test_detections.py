"""Candidates and detections: checks, joining, selecting."""

from __future__ import annotations

import numpy as np
import pytest

from ballfg.vision.detection.detections import Candidates, Detections


def three() -> Detections:
    first = Candidates.at([[1.0, 2.0], [3.0, 4.0]], 0.5, [0.2, 0.9])
    return Detections.of_frames("left", [(0.0, first), (0.1, Candidates.none()), (0.3, Candidates.at([5.0, 6.0], 0.5))])


def test_frames_are_joined() -> None:
    seen = three()
    assert seen.frame.tolist() == [0, 0, 2]
    assert seen.times.tolist() == [0.0, 0.0, 0.3]
    assert seen.pixels.tolist() == [[1, 2], [3, 4], [5, 6]]
    assert seen.in_frame(0).scores.tolist() == [0.2, 0.9]
    assert (len(seen), len(seen.in_frame(1)), len(seen.in_frame(2))) == (3, 0, 1)
    assert np.isnan(seen.streaks).all()
    np.testing.assert_array_equal(seen.covariances, np.tile(0.25 * np.eye(2), (3, 1, 1)))
    np.testing.assert_array_equal(seen.radii, np.tile([0.0, 1.0], (3, 1)))  # not known


def test_best_scores_come_first() -> None:
    assert three().best_scores(2).tolist() == [1.0, 0.9]
    assert Detections.of_frames("left", [(0.0, Candidates.none())]).best_scores().tolist() == []


def test_selected_candidates_keep_all_frames() -> None:
    seen = three()
    good = seen.select(seen.scores > 0.5)
    assert (good.frame.tolist(), good.frames.tolist()) == ([0, 2], [0.0, 0.1, 0.3])


def test_arrays_cannot_be_changed() -> None:
    with pytest.raises(ValueError, match="read-only"):
        three().pixels[0] = 0.0


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"pixels": [[1.0, np.nan]]}, "pixels must be finite; those of candidate 0"),
        ({"pixels": [[1.0, 2.0, 3.0]]}, r"pixels must have shape \(1, 2\); got \(1, 3\)"),
        ({"covariances": [[[1.0, 0.5], [0.2, 1.0]]]}, "covariances must be symmetric"),
        ({"covariances": [[[1.0, 2.0], [2.0, 1.0]]]}, "covariances must be symmetric and positive definite"),
        ({"scores": [1.5]}, r"scores must lie in \[0, 1\]"),
        ({"radii": [[3.0, 0.0]]}, "radii must be a radius and a sigma above zero; those of candidate 0"),
        ({"radii": [[np.nan, 1.0]]}, "radii must be finite"),
        ({"frame": [1]}, "frame must be numbers from 0 to 0 in order"),
        ({"frame": [0, 0]}, r"frame must have shape \(1,\)"),
        ({"frames": [0.0, 0.0]}, r"frames must be strictly increasing; frames\[1\]=0.0 after 0.0"),
        ({"frames": [np.inf]}, "frames must be finite"),
    ],
)
def test_bad_fields_are_refused(changes: dict[str, object], message: str) -> None:
    fields: dict[str, object] = {
        "camera": "left",
        "frames": [0.0],
        "frame": [0],
        "pixels": [[1.0, 2.0]],
        "covariances": [np.eye(2)],
        "scores": [0.5],
        "streaks": np.full((1, 2, 2), np.nan),
    }
    with pytest.raises(ValueError, match=message):
        Detections(**(fields | changes))
    with pytest.raises(TypeError, match="camera must be a name"):
        Detections(**(fields | {"camera": 3}))
