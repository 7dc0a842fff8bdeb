"""Planted rallies: true strokes as a camera that stands or moves sees them, with bars of motion blur, among clutter."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from ballfg.arrays import Array
from ballfg.benchmarks.cameras.films import EXPOSURE, Truth, truth
from ballfg.benchmarks.cameras.hall import COURT
from ballfg.benchmarks.cameras.strokes import MODEL
from ballfg.estimation.rally.arcs import arcs
from ballfg.estimation.rally.field import Field
from ballfg.estimation.rally.reconstruct import fixed_camera
from ballfg.estimation.rally.strokes import Grower, Stroke
from ballfg.estimation.rally.video import surfaces_of
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.state import POSITION, VZ
from ballfg.vision.broadcast.motion import Motion, Shot
from ballfg.vision.detection.detections import Candidates, Detections

RATE, NOISE = 25.0, 0.4  # Hz, px
SURFACES = surfaces_of(COURT)
POSE_SIGMAS = (2e-4, 2e-4, 2e-4, 0.01, 0.01, 0.01, 1e-3)  # rad, m, and of the logarithm of the focal length


def planted(
    view: str, seed: int, *, false: int = 8, missing: float = 0.0, length: float = 2.6, travel: float = 0.0
) -> tuple[Truth, Motion, Detections]:
    """The truth, its camera (as the first one of the view looks), and the candidates of its first `length` s.

    Args: false: candidates a picture, anywhere.  missing: share of pictures without the ball.
        travel: m, of the camera along the table meanwhile; 0: it stands.
    """
    of, rng = truth(view, RATE, seed), np.random.default_rng([seed, 3])
    count, camera = int(length * RATE), of.cameras[0]
    places = camera.place + np.outer(np.linspace(-0.5, 0.5, count), [travel, 0.0, 0.0])
    cameras = [replace(camera, place=place) for place in places]
    half, frames = 0.5 * EXPOSURE / RATE, list[tuple[float, Candidates]]()
    for number in range(count):
        t = number / RATE
        pixels, streaks = rng.uniform((0.0, 0.0), camera.size, (false, 2)), np.full((false, 2, 2), np.nan)
        states, scores = [of.at(t + shift) for shift in (-half, 0.0, half)], rng.uniform(0.0, 0.5, false)
        if all(state is not None for state in states) and rng.random() >= missing:
            seen = cameras[number].project(np.array([state[POSITION] for state in states if state is not None]))
            seen += rng.normal(0.0, NOISE, seen.shape)
            pixels, streaks = np.append(pixels, seen[1:2], axis=0), np.append(streaks, seen[None, ::2], axis=0)
            scores = np.append(scores, 0.6)
        covariances = np.tile(0.36 * np.eye(2), (len(pixels), 1, 1))
        frames.append((t, Candidates(pixels, covariances, scores, streaks)))
    covariance = np.tile(np.diag(np.square(POSE_SIGMAS)), (count, 1, 1))
    shot = Shot(0, tuple(cameras), covariance, np.ones(count), 0.1 if travel else 0.0)
    times = np.arange(count) / RATE
    return of, Motion((shot,), times, ()), Detections.of_frames("main", frames)


def grower_of(found: Detections, shot: Shot) -> tuple[Grower, list[Array]]:
    """What strokes are grown in, and the arcs."""
    pinhole, camera = fixed_camera(shot, "main")
    seeds, field, _ = arcs(Field.of(found, pinhole.focal / float(np.linalg.norm(pinhole.place))))
    return Grower.of(field, found.times, camera, physics_of(MODEL), SURFACES), list(seeds)


def true_stroke(of: Truth, number: int, grower: Grower, shot: Shot) -> tuple[Stroke, float]:
    """The stroke through the candidates that are the ball, with its bounce at the true time, s; and that time."""
    one, rows = of.strokes[number], list[int]()
    for frame, t in enumerate(grower.field.stamps):
        state, here = of.at(float(t)), grower.field.rows(frame)
        if state is None or not len(here) or not one.begin < t <= one.end:
            continue
        off = np.linalg.norm(grower.field.pixels[here] - shot.cameras[0].project(state[POSITION]), axis=1)
        if off.min() < 4.0:
            rows.append(int(here[np.argmin(off)]))
    moments = np.arange(one.begin + 0.002, one.end, 0.001)
    rise = np.diff([state[VZ] for state in map(of.at, moments.tolist()) if state is not None])
    bounce = float(moments[int(np.argmax(rise))])
    return grower.flown(np.array(rows), (bounce,)), bounce
