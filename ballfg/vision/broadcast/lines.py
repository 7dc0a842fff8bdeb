"""Measures how far the lines of a court lie from where a camera should see them, and corrects the camera by it.

A painted line is brighter than the ground on both sides. Along the normal of a line as a camera should see it, the
place of the ridge is measured at points of the line (Harris and Stennett, "RAPID", 1990): one number for each, since
nothing shows a shift along a line.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Index, Mask
from ballfg.vision.arrays import Array32, Image
from ballfg.vision.broadcast.court import Court
from ballfg.vision.broadcast.pinhole import Pinhole

SAMPLES: Final = 24  # along a line of the court
STEP: Final = 0.5  # px between values along a normal
FLANK, BESIDE = 4.0, 2.5  # px from the middle of a line, and from the edge of a wide one, to the ground beside it
CROSSING: Final = 2.0  # of the flank, from another line within which it is in the way
RIDGE: Final = 6.0  # grey levels by which a line is brighter than the ground, at least
LEANING, SHARP = 0.1305, 2.4
"""Of the step between the grounds, by which the halfway places of a line that is far narrower than its blur differ from
where they should be (Phi(sqrt(2 log 2)) - 3/4); the power of the share of the width that is not blur with which this
vanishes, as of a bar blurred by a Gaussian to a tenth."""
SIGMA: Final = 0.7
"""px, standard deviation of a ridge about the camera of one picture alone: more than that of its place."""
ROBUST: Final = 2.0  # scale of Cauchy's loss on a ridge or on the background, in standard deviations
FOCAL_SIGMA: Final = 0.5  # of the logarithm of a focal length in one picture, about the first value
REACHES: Final = (8.0, 5.0, 3.0, 3.0)  # px, in which ridges are looked for, turn by turn
CLOSE: Final = 1.5  # px within which a ridge fits
EVERY: Final = np.arange(7)  # numbers of turn, place and log focal length of a camera


@dataclass(frozen=True, eq=False)
class Ridges:
    """Places (n, 3) m on lines of the court, and where their ridges were seen: `offset` px along `normal` (n, 2).

    `line` (n,) is the number of each one's line, `asked` (l,) the number of places of each line within the picture.
    """

    points: Array
    offset: Array
    normal: Array
    line: Index
    asked: Index

    @property
    def fit(self) -> float:
        """Share of the places in the picture with a ridge at most `CLOSE` away, the mean of the lines."""
        seen = self.asked > 0
        return float(self._close[seen].mean()) if seen.sum() >= 3 else 0.0

    @property
    def whole_fit(self) -> float:
        """The same where lines of which no place may be seen do not fit: they may lie anywhere."""
        return float(self._close.mean())

    @property
    def _close(self) -> Array:
        """(l,) share of each line's places."""
        close = np.bincount(self.line[np.abs(self.offset) < CLOSE], minlength=len(self.asked))
        return np.asarray(close / np.maximum(self.asked, 1))


def brightness(image: Image) -> Array32:
    """(h, w) of a picture (h, w, 3). Its colours have half the resolution, and bleed from the ground into a line."""
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2GRAY), dtype=np.float32)


def ridges(image: Array32, camera: Pinhole, court: Court, reach: float) -> Ridges:
    """The ridges of a picture's `brightness` within `reach` px of the lines of a court as a camera should see them."""
    points, pixels, normal, length = sampled(camera, court)
    normals = np.broadcast_to(normal[:, None], pixels.shape)
    half = 0.5 * court.across[:, None]
    width = np.abs(((camera.project(points + half) - camera.project(points - half)) * normals).sum(axis=2))
    limit = np.array(camera.size) - 1.0
    inside = ((pixels > FLANK) & (pixels < limit - FLANK)).all(axis=2) & (length > 2 * SAMPLES)[:, None]
    flank = max(FLANK, STEP * np.ceil((0.5 * width[inside].max(initial=0.0) + BESIDE) / STEP))
    inside &= ~_crossed(pixels, camera.project(court.lines), CROSSING * flank)
    line = np.broadcast_to(np.arange(len(court.lines))[:, None], inside.shape)[inside]
    offset, good = _brightest(image, pixels[inside], normals[inside], reach, width[inside], flank)
    asked = inside.sum(axis=1)
    return Ridges(points[inside][good], offset[good], normals[inside][good], line[good], asked)


def sampled(camera: Pinhole, court: Court) -> tuple[Array, Array, Array, Array]:
    """Places (l, k, 3) m along a court's lines, their pixels (l, k, 2); the lines' normals (l, 2), lengths (l,) px."""
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    points = court.lines[:, None, 0] + share[:, None] * (court.lines[:, None, 1] - court.lines[:, None, 0])
    pixels = camera.project(points)
    along = pixels[:, -1] - pixels[:, 0]
    length = np.linalg.norm(along, axis=1)
    return points, pixels, np.stack((-along[:, 1], along[:, 0]), axis=1) / length[:, None], length


def _crossed(pixels: Array, ends: Array, near: float) -> Mask:
    """(l, k) whether another line (l, 2, 2) px is so `near`, px, to places (l, k, 2) px on lines that it hides them."""
    along = ends[:, 1] - ends[:, 0]
    away = pixels[:, :, None] - ends[:, 0]
    share = np.clip((away * along).sum(axis=-1) / (along**2).sum(axis=-1), 0.0, 1.0)
    close = np.linalg.norm(away - share[..., None] * along, axis=-1) < near
    close[np.arange(len(ends)), :, np.arange(len(ends))] = False
    return np.asarray(close.any(axis=-1))


def _brightest(
    image: Array32, pixels: Array, normal: Array, reach: float, width: Array, flank: float = FLANK
) -> tuple[Array, Mask]:
    """(n,) px, the middle of the strongest ridge along each normal, and whether there is one (n,).

    The middle lies between the places on both sides where the brightness is halfway down to the ground there: the
    brightest place itself lies towards the brighter ground. Where blur is as wide as the line, of `width` (n,) px, the
    places lie there too, by what is known of the ridge: the step between the grounds, and how steep it is.
    """
    steps = np.arange(-reach - flank, reach + flank + STEP / 2, STEP)
    if not len(pixels):
        return np.zeros(0), np.zeros(0, dtype=bool)
    at = (pixels[:, None] + steps[:, None] * normal[:, None]).astype(np.float32)
    values = cv2.remap(image, at[..., 0], at[..., 1], cv2.INTER_LINEAR).reshape(len(pixels), len(steps))
    beside, rows = round(flank / STEP), np.arange(len(pixels))
    rise = values[:, beside:-beside] - np.maximum(values[:, : -2 * beside], values[:, 2 * beside :])
    top = np.argmax(rise, axis=1)
    good = (rise[rows, top] > RIDGE) & (top > 0) & (top < rise.shape[1] - 1)
    near = values[rows[:, None], top[:, None] + np.arange(2 * beside + 1)]
    after, steep = _halfway(near[:, beside:])
    before, steeper = _halfway(near[:, beside::-1])
    share = np.minimum(width / np.maximum(STEP * (after + before), STEP), 1.0)
    step = (near[:, -1] - near[:, 0]) / np.maximum(0.5 * (steep + steeper), 1.0)
    shift = STEP * (0.5 * (after - before) - LEANING * (1.0 - share**SHARP) * step)
    return -reach + STEP * top + np.where(good, shift, 0.0), good


def _halfway(falling: Array) -> tuple[Array, Array]:
    """Where values (n, k) are last halfway from the first to the last, and how much they fall in a step there.

    Returns: (n,) numbers of steps, with their fractions. (n,).
    """
    level = 0.5 * (falling[:, 0] + falling[:, -1])
    above = falling[:, :-1] >= level[:, None]
    last = above.shape[1] - 1 - np.argmax(above[:, ::-1], axis=1)
    rows = np.arange(len(falling))
    here, after = falling[rows, last], falling[rows, last + 1]
    return last + np.clip((here - level) / np.maximum(here - after, 1e-6), 0.0, 1.0), here - after


def slopes(camera: Pinhole, points: Array) -> tuple[Array, Array]:
    """Pixels (n, 2) of points (n, 3) m, and derivatives (n, 2, 7) by turn, place and log focal length.

    A turn w changes the camera's rotation to the world into R exp(w).
    """
    at = (points - camera.place) @ camera.turn.T
    x, y, z = at.T
    none, plane = np.zeros_like(z), at[:, :2] / z[:, None]
    straight = (1.0 + camera.bend * (plane**2).sum(axis=1))[:, None]
    by_plane = straight[:, None] * np.eye(2) + 2.0 * camera.bend * plane[:, :, None] * plane[:, None, :]
    by_at = np.stack((none + 1.0, none, -x / z, none, none + 1.0, -y / z), axis=1).reshape(-1, 2, 3) / z[:, None, None]
    cross = np.stack((none, -z, y, z, none, -x, -y, x, none), axis=1).reshape(-1, 3, 3)
    grown, by_at = camera.focal * straight * plane, camera.focal * by_plane @ by_at
    return grown + camera.middle, np.concatenate((by_at @ cross, -by_at @ camera.turn, grown[..., None]), axis=2)


def moved(camera: Pinhole, step: Array) -> Pinhole:
    """The camera after a step (7,) of turn, place and log focal length."""
    turn = (camera.turn.T @ cv2.Rodrigues(step[:3])[0]).T
    return replace(camera, turn=turn, place=camera.place + step[3:6], focal=float(camera.focal * np.exp(step[6])))


def corrected(image: Array32, camera: Pinhole, court: Court, free: Index = EVERY) -> tuple[Pinhole, float]:
    """The camera that fits the ridges of a picture's `brightness`, and the share of the court's lines that then fit.

    Args: free: numbers of the seven that are corrected; the others stay.
    """
    first = camera.focal
    for reach in REACHES:
        seen = ridges(image, camera, court, reach)
        if len(seen.offset) < 2 * len(free):
            return camera, 0.0
        row = np.einsum("na,nab->nb", seen.normal, slopes(camera, seen.points)[1]) / SIGMA
        weight = 1.0 / (1.0 + (seen.offset / SIGMA / ROBUST) ** 2)
        information = (row * weight[:, None]).T @ row + 1e-6 * np.eye(7)
        pull = row.T @ (weight * seen.offset / SIGMA)
        information[6, 6] += FOCAL_SIGMA**-2
        pull[6] += np.log(first / camera.focal) / FOCAL_SIGMA**2
        step = np.zeros(7)
        step[free] = np.linalg.solve(information[np.ix_(free, free)], pull[free])
        step *= min(1.0, 0.2 / np.abs(step[[0, 1, 2, 6]]).max())
        camera = moved(camera, step)
    if not np.isfinite(camera.project(court.corners)).all():
        return camera, 0.0
    return camera, ridges(image, camera, court, REACHES[-1]).fit
