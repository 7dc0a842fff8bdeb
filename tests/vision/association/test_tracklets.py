"""Pieces of one camera's view: pure, complete, and ended where it is not clear how to go on."""

import numpy as np
import pytest

from ballfg.vision.association.tracklets import find_tracklets
from ballfg.vision.detection.detections import Detections
from tests.vision.filming import World, arm, film, rig, shots

RATE = 60.0


def detections(pixels: list[np.ndarray], scores: list[np.ndarray] | None = None) -> Detections:
    """One camera; for each frame its candidates (k, 2)."""
    count = sum(len(seen) for seen in pixels)
    return Detections(
        "left",
        np.arange(len(pixels)) / RATE,
        np.repeat(np.arange(len(pixels)), [len(seen) for seen in pixels]),
        np.concatenate(pixels),
        np.tile(0.04 * np.eye(2), (count, 1, 1)),
        np.ones(count) if scores is None else np.concatenate(scores),
        np.full((count, 2, 2), np.nan),
    )


def flight(times: np.ndarray, start: tuple[float, float], velocity: tuple[float, float]) -> np.ndarray:
    return np.array(start) + np.outer(times, velocity) + np.outer(times**2, [0.0, 1600.0])


@pytest.mark.parametrize("rate", [60.0, 240.0])
def test_pieces_cover_the_balls_and_are_pure(rate: float) -> None:
    rng = np.random.default_rng(1)
    world = World(shots(3, rng), 3.2, rates=(rate,) * 3)
    for camera, seen in zip(rig(), film(rig(), world), strict=True):
        owner = np.full(len(seen), -1)
        for number, points in enumerate([shot.at(seen.times) for shot in world.shots] + [arm(seen.times)]):
            owner[np.linalg.norm(camera.project(points) - seen.pixels, axis=1) < 2.0] = number
        pieces = find_tracklets(seen, 1000.0)
        kept = np.concatenate(pieces)
        assert len(np.unique(kept)) == len(kept)
        covered = np.isin(np.arange(len(seen)), kept)
        assert covered[owner >= 0].mean() > 0.98
        strangers = sum(int((owner[piece] != np.bincount(owner[piece] + 1).argmax() - 1).sum()) for piece in pieces)
        assert strangers <= 0.01 * len(kept)
        assert all((np.diff(seen.frame[piece]) > 0).all() for piece in pieces)


def test_a_bounce_starts_a_new_piece() -> None:
    times = np.arange(20) / RATE
    before, after = (
        flight(times[:10], (200.0, 100.0), (900.0, 600.0)),
        flight(times[:10], (355.0, 245.0), (900.0, -900.0)),
    )
    pieces = find_tracklets(detections([place[None] for place in np.concatenate((before, after))]), 1000.0)
    assert [len(piece) for piece in pieces] == [10, 10]


def test_missed_frames_are_bridged() -> None:
    places = flight(np.arange(20) / RATE, (200.0, 100.0), (900.0, 100.0))
    pixels = [place[None] for place in places]
    for k in (7, 8, 9, 14):
        pixels[k] = np.zeros((0, 2))
    assert [len(piece) for piece in find_tracklets(detections(pixels), 1000.0)] == [16]


def test_crossing_balls_do_not_swap() -> None:
    """Two balls meet in the image at frame 10, and are one candidate there."""
    times = (np.arange(21) - 10) / RATE
    one, other = flight(times, (600.0, 300.0), (900.0, 100.0)), flight(times, (600.0, 300.0), (-900.0, 140.0))
    pixels = [np.stack(pair) for pair in zip(one, other, strict=True)]
    pixels[10] = one[10:11]
    for piece in find_tracklets(detections(pixels), 1000.0):
        velocity = np.diff(np.concatenate(pixels)[piece][:, 0])
        assert (velocity > 0).all() or (velocity < 0).all()


def test_a_piece_ends_where_two_answers_are_equally_good() -> None:
    places = flight(np.arange(12) / RATE, (200.0, 100.0), (900.0, 100.0))
    pixels = [place[None] for place in places]
    pixels[8] = places[8] + np.array([[0.0, 0.8], [0.0, -0.8]])
    pieces = find_tracklets(detections(pixels), 1000.0)
    assert pieces[0].tolist() == list(range(8))
    assert all(len(piece) <= 5 for piece in pieces[1:])


def test_the_score_decides_between_close_answers() -> None:
    places = flight(np.arange(12) / RATE, (200.0, 100.0), (900.0, 100.0))
    pixels, scores = [place[None] for place in places], [np.ones(1)] * 12
    pixels[8] = places[8] + np.array([[0.0, 1.5], [0.0, 0.0]])
    scores[8] = np.array([0.0, 1.0])
    pieces = find_tracklets(detections(pixels, scores), 1000.0)
    assert pieces[0].tolist() == [*range(8), 9, 10, 11, 12]


def test_what_stands_still_is_left_out() -> None:
    still = [np.array([[500.0, 300.0]]) + 0.2 * np.random.default_rng(k).standard_normal((1, 2)) for k in range(30)]
    assert find_tracklets(detections(still), 1000.0) == []


def test_nothing_seen() -> None:
    assert find_tracklets(detections([np.zeros((0, 2))] * 10), 1000.0) == []
