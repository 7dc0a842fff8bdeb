"""The detector on drawn films: where it finds the ball, how sure it is, what it marks down, what it costs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from ballfg.vision.detection.background import Background
from ballfg.vision.detection.detections import UNKNOWN_RADIUS
from ballfg.vision.detection.detector import BallDetector, DetectorSettings, learned, radius_of
from ballfg.vision.detection.streak import Look, StreakFit
from tests.vision.drawn import Film, Shot


def run(shots: list[Shot], settings: DetectorSettings | None = None) -> dict[str, np.ndarray]:
    """Errors, NEES, scores of the balls found; best score of anything else; number missed."""
    images = [shot.image for shot in shots]
    detector = BallDetector(images[:: max(1, len(images) // 15)], settings)
    errors, nees, scores, ends, radii, other = [], [], [], [], [], [0.0]
    for shot in shots:
        found = detector(shot.image)
        far = np.hypot(*(found.pixels - shot.centre).T)
        near = int(np.argmin(far)) if len(far) else -1
        other += [float(s) for i, s in enumerate(found.scores) if i != near or far[i] > 3.0]
        if near < 0 or far[near] > 3.0:
            continue
        errors.append(found.pixels[near] - shot.centre)
        nees.append(errors[-1] @ np.linalg.solve(found.covariances[near], errors[-1]))
        scores.append(found.scores[near])
        ends.append(_end_errors(found.streaks[near], shot))
        radii.append(found.radii[near])
    keys = ("errors", "nees", "scores", "ends", "radii", "other")
    return dict(zip(keys, map(np.array, (errors, nees, scores, ends, radii, other)), strict=True))


def _end_errors(streak: np.ndarray, shot: Shot) -> np.ndarray:
    true = np.stack((shot.centre - shot.half, shot.centre + shot.half))
    errors = np.stack((streak - true, streak[::-1] - true))
    return (
        errors[np.argmin(np.square(errors).sum(axis=(1, 2)))] if np.isfinite(streak).all() else np.full((2, 2), np.nan)
    )


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.nanmean(np.square(errors))))


def recoded(shots: list[Shot], path: Path, codec: str) -> list[Shot]:
    writer = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*codec), 120, shots[0].image.shape[1::-1])
    for shot in shots:
        writer.write(shot.image)
    writer.release()
    capture = cv2.VideoCapture(str(path))
    return [Shot(capture.read()[1], shot.centre, shot.half) for shot in shots]


@pytest.mark.parametrize(("streak", "bound"), [(0.0, 0.05), (8.0, 0.08), (25.0, 0.15)])
def test_ball_is_found_where_it_is(streak: float, bound: float) -> None:
    result = run(list(Film().shots(40, streak)))
    assert len(result["errors"]) >= 38
    assert rms(result["errors"]) < bound
    assert np.abs(result["errors"].mean(axis=0)).max() < 0.05
    assert np.median(result["scores"]) > 0.9
    assert result["nees"].mean() < 4.0
    assert np.median(result["radii"][:, 0]) == pytest.approx(6.5, rel=0.02)
    if streak:
        assert rms(result["ends"]) < 0.5
        assert np.isfinite(result["ends"]).all()
    else:
        assert np.isnan(result["ends"]).all()


@pytest.mark.parametrize(("name", "codec"), [("a.mp4", "mp4v"), ("a.avi", "MJPG")])
def test_compression_costs_little(tmp_path: Path, name: str, codec: str) -> None:
    result = run(recoded(list(Film().shots(40, 8.0)), tmp_path / name, codec))
    assert len(result["errors"]) >= 38
    assert rms(result["errors"]) < 0.15
    assert result["nees"].mean() < 6.0


def test_grey_video_is_as_good() -> None:
    shots = list(Film().shots(40, 8.0))
    for shot in shots:
        shot.image = cv2.cvtColor(cv2.cvtColor(shot.image, cv2.COLOR_BGR2GRAY), cv2.COLOR_GRAY2BGR)
    result = run(shots)
    assert len(result["errors"]) >= 38
    assert rms(result["errors"]) < 0.1


def test_no_ball_gives_no_good_candidate() -> None:
    result = run(list(Film(ball=False).shots(40)), DetectorSettings(colour="white"))
    assert len(result["errors"]) == 0
    assert result["other"].max() < 0.5


@pytest.mark.parametrize(("colour", "other"), [("white", "orange"), ("orange", "white")])
def test_colour_tells_balls_apart(colour: str, other: str) -> None:
    pixel = {"white": (225, 230, 230), "orange": (40, 140, 240)}[colour]
    shots = list(Film(colour=pixel).shots(30, 4.0))
    assert np.median(run(shots, DetectorSettings(colour=colour))["scores"]) > 0.9
    assert np.median(run(shots, DetectorSettings(colour=other))["scores"]) < 0.2


def test_size_is_marked() -> None:
    shots = list(Film().shots(30, 4.0))
    assert np.median(run(shots, DetectorSettings(diameter=(10.0, 16.0)))["scores"]) > 0.9
    assert np.median(run(shots, DetectorSettings(diameter=(20.0, 40.0)))["scores"]) < 0.2


def test_two_balls_are_two_candidates() -> None:
    shots = list(Film().shots(30, 6.0))
    detector = BallDetector([shot.image for shot in shots[:15]])
    one, two = detector(shots[20].image), detector(np.maximum(shots[20].image, shots[25].image))
    assert (one.scores > 0.8).sum() == 1
    assert (two.scores > 0.8).sum() == 2


def test_background_keeps_no_trace_of_what_passed() -> None:
    film = Film(noise=2.0)
    background = Background([shot.image for shot in film.shots(15)])
    right = np.s_[:, 80:]
    assert np.abs(background.full[right] - film.room[right]).mean() < 1.5
    np.testing.assert_allclose(np.sqrt(np.diagonal(background.noise)), 2.0, rtol=0.15)
    assert background.blotches < 1.3


def test_same_frames_give_the_same_candidates() -> None:
    shots = list(Film().shots(20))
    first, second = run(shots), run(shots)
    np.testing.assert_array_equal(first["errors"], second["errors"])


def test_bad_arguments_are_refused() -> None:
    with pytest.raises(ValueError, match="images must be at least three"):
        BallDetector([])
    with pytest.raises(ValueError, match="images must have one shape"):
        BallDetector([np.zeros((40, 40, 3), np.uint8), np.zeros((40, 44, 3), np.uint8), np.zeros((40, 40), np.uint8)])
    with pytest.raises(ValueError, match="image must have the background's shape"):
        BallDetector([np.full((40, 40, 3), 9, np.uint8)] * 3)(np.zeros((44, 40, 3), np.uint8))
    for wrong in ({"diameter": (9.0, 3.0)}, {"longest_streak": -1.0}, {"colour": "blue"}, {"most": 0}):
        with pytest.raises(ValueError, match=f"{next(iter(wrong))} must be"):
            DetectorSettings(**wrong)


def test_what_was_learned_of_a_ball_s_look_stays_open_to_change() -> None:
    """Of a hundred sharp balls alike: their edge and shading, sure to 0.15 px and 0.08 of the brightness at best."""
    look, seen = Look.unknown(), np.array([1.4, 0.2, -0.1])
    fit = StreakFit(np.concatenate((np.zeros(6), seen)), np.eye(9), 1e5 * np.eye(3), 0.0, 50.0, 1.0, True)
    for _ in range(100):
        look = learned(look, fit, 1.0)
    np.testing.assert_allclose(look.mean, seen, atol=0.01)
    np.testing.assert_allclose(np.diagonal(look.information) ** -0.5, (0.15, 0.08, 0.08), rtol=1e-9)
    once = learned(Look.unknown(), replace(fit, tells=np.eye(3)), 1.0)
    np.testing.assert_allclose(once.information, Look.unknown().information + np.eye(3))  # as little as one ball tells


def test_a_radius_is_stated_of_what_has_a_balls_shape() -> None:
    fit = StreakFit(np.arange(9.0), 0.04 * np.eye(9), np.eye(3), 0.0, 50.0, 1.0, True)
    assert radius_of(fit, 0.06) == pytest.approx((4.0, 0.2))
    assert radius_of(fit, 0.05) == UNKNOWN_RADIUS
    for variance in (np.nan, -0.04, np.inf):  # of a fit that fell together
        assert radius_of(replace(fit, covariance=np.full((9, 9), variance)), 0.9) == UNKNOWN_RADIUS
