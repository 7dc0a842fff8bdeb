"""Strokes from one camera: rallies cut at their hits, states against the truth, and clutter that is none."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
import torch

from ballfg.dynamics.motion.rollout import rollout
from ballfg.estimation import Status
from ballfg.estimation.one_camera import Strokes, track_one_camera
from ballfg.vision.detection.detections import Candidates, Detections
from tests.estimation.observations.sighted_rig import TABLE, World, looking, world

RATE, NOISE = 50.0, 0.5
SIDE = looking("side", (-0.2, -4.0, 2.2))
HITS = (0.0, 0.62, 1.22, 1.84)
"""s, at which the ball is hit; the last one ends the rally."""


@pytest.fixture(scope="module")
def ball() -> World:
    made = world()
    return made._replace(surfaces=replace(made.surfaces, extent=(-1.37, 1.37, -0.76, 0.76)))


def rally(ball: World) -> tuple[np.ndarray, np.ndarray]:
    """Times (n,) s and states (n, 9) of three strokes to and fro, each with a bounce."""
    state, times, states = np.array([-1.3, -0.2, TABLE + 0.25, 4.5, 0.2, 0.6, 0.0, 60.0, 0.0]), [], []
    for number, (start, end) in enumerate(pairwise(HITS)):
        stamps = np.arange(np.ceil(start * RATE), np.ceil(end * RATE)) / RATE
        since = torch.from_numpy(np.append(np.append(0.0, stamps - start), end - start))
        with torch.no_grad():
            path = rollout(ball.model, torch.from_numpy(state[None]), since, ball.surfaces)[0].numpy()
        times.append(stamps)
        states.append(path[1:-1])
        to = 1.0 if number % 2 else -1.0
        state = np.concatenate((path[-1, :3], [4.6 * to, 0.15, 1.2, 0.0, 50.0 * to, 0.0]))
    return np.concatenate(times), np.concatenate(states)


def seen(times: np.ndarray, states: np.ndarray, seed: int, hidden: float = 0.05) -> Detections:
    """The ball in most frames, two wrong candidates in each, and a light that glides through the picture."""
    rng, frames = np.random.default_rng(seed), []
    first = round(times[0] * RATE)
    pixels = SIDE.project(states[:, :3]) + NOISE * rng.standard_normal((len(times), 2))
    for frame in range(first + len(times) + 20):
        found, scores = [*rng.uniform((0, 0), SIDE.size, (2, 2))], [0.35, 0.4]
        found.append(np.array([100.0 + 3.0 * frame, 600.0]) + NOISE * rng.standard_normal(2))
        scores.append(0.5)
        if first <= frame < first + len(times) and rng.uniform() > hidden:
            found.append(pixels[frame - first])
            scores.append(0.9)
        frames.append((100.0 + frame / RATE, Candidates.at(np.array(found), NOISE, scores)))
    return Detections.of_frames("side", frames)


def judged(strokes: Strokes, times: np.ndarray, states: np.ndarray) -> list[float]:
    """m, the root mean square error of each stroke."""
    errors = []
    for estimate in strokes.estimates:
        rows = np.searchsorted(times, estimate.times - 100.0 - 1e-6)
        errors.append(float(np.sqrt(((estimate.states[:, :3] - states[rows, :3]) ** 2).sum(axis=1).mean())))
    return errors


def test_a_rally_is_cut_at_its_hits(ball: World) -> None:
    times, states = rally(ball)
    strokes = track_one_camera(seen(times, states, 3), SIDE, ball.model, ball.surfaces)
    assert strokes.tracking.names == ["000", "001", "002"]
    assert [estimate.name for estimate in strokes.estimates] == strokes.tracking.names
    for estimate, begin, end in zip(strokes.estimates, HITS, HITS[1:], strict=False):
        assert estimate.times[0] - 100.0 == pytest.approx(begin, abs=0.1)
        assert estimate.times[-1] - 100.0 == pytest.approx(end, abs=0.1)
        assert len(estimate.contacts) in (1, 2)
    assert max(judged(strokes, times, states)) < 0.08
    assert strokes.doubts == []
    first, *others = strokes.estimates
    unsure = replace(strokes, estimates=(replace(first, status=Status.NOT_CONVERGED), *others))
    assert unsure.doubts == [f"track 000: {Status.NOT_CONVERGED.value}"]
    ball_one = strokes.tracking.balls[0]
    np.testing.assert_array_equal(ball_one.points, strokes.estimates[0].states[:, :3])
    assert strokes.tracking.seen(ball_one, 0).frames[0] == pytest.approx(HITS[0] * RATE, abs=5)


def test_what_does_not_fall_is_no_ball(ball: World) -> None:
    times, states = rally(ball)
    empty = seen(times, states, 4, hidden=1.1)
    assert track_one_camera(empty, SIDE, ball.model, ball.surfaces).estimates == ()


def test_of_a_time_shift_nothing_changes(ball: World) -> None:
    times, states = rally(ball)
    found = seen(times, states, 5)
    moved = replace(found, frames=found.frames + 3.0)
    late = replace(SIDE, time_offset=0.5)
    one, other, third = (
        track_one_camera(*given, ball.model, ball.surfaces) for given in ((found, SIDE), (moved, SIDE), (found, late))
    )
    assert len(one.estimates) == len(other.estimates) == len(third.estimates) == 3
    for a, b, c in zip(one.estimates, other.estimates, third.estimates, strict=True):
        np.testing.assert_allclose(b.times, a.times + 3.0, atol=1e-9)
        np.testing.assert_allclose(c.times, a.times - 0.5, atol=1e-9)
        np.testing.assert_allclose(b.states, a.states, rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(c.states, a.states, rtol=1e-4, atol=1e-3)
