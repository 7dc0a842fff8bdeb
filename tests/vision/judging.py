"""Holds balls that were found against the shots that were filmed."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from ballfg.vision.association.gathering import SeenBall
from ballfg.vision.association.paths import MAX_GAP
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections
from tests.vision.filming import World

FALSE = 0.05
"""m, distance from every ball at which a point is a false one."""


@dataclass(frozen=True)
class Verdict:
    complete: float
    """Share of the stamps, of the camera that saw most of a ball, at which two saw it that have a point."""
    false: int
    mixed: int
    """Tracks that hold points of two balls."""
    balls: list[int]
    """For each shot the number of its tracks."""
    rmse: float
    nees: float
    """Mean over points, 3 if the covariances are honest."""


def judge(balls: Sequence[SeenBall], world: World, cameras: Sequence[Camera], films: Sequence[Detections]) -> Verdict:
    errors, squares, owners = [], [], []
    for ball in balls:
        apart = np.stack([ball.points - shot.at(ball.times) for shot in world.shots])
        distance = np.nan_to_num(np.linalg.norm(apart, axis=2), nan=9.0)
        owner = np.where(distance.min(axis=0) < FALSE, distance.argmin(axis=0), -1)
        owners.append(owner)
        error = apart[owner, np.arange(len(ball))][owner >= 0]
        errors.append((error**2).sum(axis=1))
        inverse = np.linalg.inv(ball.covariances[owner >= 0])
        squares.append(np.einsum("ni,nij,nj->n", error, inverse, error))
    wanted = found = 0
    for number in range(len(world.shots)):
        times = [ball.times[owner == number] for ball, owner in zip(balls, owners, strict=True)]
        made = np.concatenate([*times, [-np.inf]])
        due = _due(number, world, cameras, films)
        wanted += len(due)
        found += int((np.abs(due[:, None] - made).min(axis=1) < 0.6 / max(world.rates)).sum())
    return Verdict(
        found / wanted,
        sum(int((owner < 0).sum()) for owner in owners),
        sum(len(set(owner[owner >= 0].tolist())) > 1 for owner in owners),
        [sum(int((owner == number).any()) for owner in owners) for number in range(len(world.shots))],
        float(np.sqrt(np.concatenate(errors).mean())),
        float(np.concatenate(squares).mean()),
    )


def _due(number: int, world: World, cameras: Sequence[Camera], films: Sequence[Detections]) -> np.ndarray:
    """Stamps of the camera that saw most, at which another saw the ball too or did so shortly before and after."""
    seen = []
    for camera, film in zip(cameras, films, strict=True):
        times = camera.true_times(film.times, film.pixels)
        near = np.linalg.norm(camera.project(world.shots[number].at(times)) - film.pixels, axis=1) < 6 * world.noise
        seen.append(np.unique(times[near]))
    stamps = max(seen, key=len)
    views = np.zeros(len(stamps), dtype=int)
    for times in seen:
        at = np.searchsorted(times, stamps)
        same = np.abs(times[np.clip(at, 0, len(times) - 1)] - stamps) < 1e-6
        inside = (at > 0) & (at < len(times))
        gap = times[np.clip(at, 1, len(times) - 1)] - times[np.clip(at, 1, len(times) - 1) - 1]
        views += same | (inside & (gap <= MAX_GAP) & (len(set(world.phases)) > 1))
    return stamps[views >= 2]
