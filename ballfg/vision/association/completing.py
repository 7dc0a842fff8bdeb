"""Adds unassigned candidates near a ball's predicted track, between its own candidates and at the ends."""

from collections.abc import Sequence
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.vision.association.gathering import Footage, Gathered, gather
from ballfg.vision.camera import Camera

_GATE: Final = 16.0  # largest squared distance from the prediction, whitened: 4 sigma
_WIDEST: Final = 20.0  # px, largest sigma of a prediction that is used
_AHEAD: Final = 2.5  # frames by which a track is continued past its ends in one round
_ROUNDS: Final = 4  # most rounds; each reaches a little farther at the ends
_STEP: Final = 1e-3  # m, step of the numerical derivative of the projection
_SYSTEMATIC: Final = 1.0  # px, added to a prediction's sigma for the calibration of the cameras that it comes from


def complete(footage: Footage, balls: Sequence[Gathered]) -> list[Gathered]:
    """The balls with the unassigned candidates that fit them; one that fits two balls stays unassigned."""
    done = list(balls)
    taken = [np.zeros(len(seen), dtype=bool) for seen in footage.detections]
    for ball in balls:
        for camera, rows in enumerate(ball.rows):
            taken[camera][rows] = True
    for _ in range(_ROUNDS):
        wanted = [_wanted(footage, ball, taken) for ball in done]
        for camera, free in enumerate(taken):
            claims = np.zeros(len(free), dtype=int)
            for want in wanted:
                claims[want[camera]] += 1
            for want in wanted:
                want[camera] = want[camera][claims[want[camera]] == 1]
                free[want[camera]] = True
        changed = [number for number, want in enumerate(wanted) if any(len(rows) for rows in want)]
        for number in changed:
            both = zip(done[number].rows, wanted[number], strict=True)
            done[number] = gather(footage, [np.union1d(old, new) for old, new in both])
        if not changed:
            break
    return done


def _wanted(footage: Footage, ball: Gathered, taken: Sequence[Mask]) -> list[Index]:
    """For each camera the unassigned candidates near the ball's predicted track."""
    wanted = []
    for number, camera in enumerate(footage.cameras):
        seen = footage.detections[number]
        frames = footage.frames(number)
        ahead = _AHEAD * float(np.median(np.diff(frames))) if len(frames) > 1 else 0.0
        near = (frames >= ball.track.times[0] - ahead) & (frames <= ball.track.times[-1] + ahead)
        near[seen.frame[ball.rows[number]]] = False
        free = np.flatnonzero(near[seen.frame] & ~taken[number])
        pixels, spread = _predicted(camera, ball, frames[seen.frame[free]])
        spread = spread + seen.covariances[free] + (footage.offset**2 + _SYSTEMATIC**2) * np.eye(2)
        sure = np.asarray(np.isfinite(pixels).all(axis=1))
        sure[sure] = np.trace(spread[sure], axis1=1, axis2=2) <= 2.0 * _WIDEST**2
        apart = seen.pixels[free[sure]] - pixels[sure]
        square = np.einsum("ni,ni->n", apart, np.linalg.solve(spread[sure], apart[..., None])[..., 0])
        fits = free[sure][square <= _GATE]
        frame, count = np.unique(seen.frame[fits], return_counts=True)
        wanted.append(fits[np.isin(seen.frame[fits], frame[count == 1])])
    return wanted


def _predicted(camera: Camera, ball: Gathered, times: Array) -> tuple[Array, Array]:
    """Predicted pixels (k, 2) of the ball at times (k,), and their covariances (k, 2, 2); NaN if unknown."""
    points, spread = ball.track.at(times)
    for late, outside in ((False, times < ball.track.times[0]), (True, times > ball.track.times[-1])):
        points[outside], spread[outside] = ball.track.beyond(times[outside], last=late)
    pixels = camera.project(points)
    steps = [(camera.project(points + step) - pixels) / _STEP for step in _STEP * np.eye(3)]
    slopes = np.stack(steps, axis=-1) if len(points) else np.zeros((0, 2, 3))
    return pixels, slopes @ spread @ np.swapaxes(slopes, 1, 2)
