"""Finds a court in one picture: quadrilaterals of straight edges, ranked by how well all lines of the court fit.

Segments (LSD; Grompone von Gioi et al. 2010) that continue each other are joined; four that meet at corners are a
quadrilateral. A quadrilateral that a pinhole camera above the court may see gives that camera; the share of the court's
lines along which the picture has an edge of their direction ranks them.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Mask
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.court import Court
from ballfg.vision.broadcast.lines import moved, sampled, slopes
from ballfg.vision.broadcast.pinhole import Pinhole, posed

SHORTEST: Final = 0.02  # of the image's diagonal: a shorter segment is not used
MOST_LINES: Final = 90  # longest ones that are combined
SAME: Final = 2.0
"""px between the ends of lines, or the corners of courts, that are one: a picture's brightness and its strongest colour
show most lines twice."""
PARALLEL, ASIDE, GAPS = 0.03, 2.0, (0.15, 0.6)
"""rad and px by which segments of one line differ; the gap between them, of the longer one. A wide gap bridges a player
before an edge, but continues another edge with what lies in its direction on the floor: lines of both are combined."""
OPEN: Final = (8.0, 0.12)  # px, and share of a segment's length, by which it may end before a corner or pass it
SMALLEST: Final = 0.004  # of the image's area
FOCALS: Final = np.geomspace(0.5, 10.0, 22)  # focal lengths that are tried, of the image's width
ROUNDS: Final = 8  # steps in which the camera of a quadrilateral is found from the best of them
MISSED: Final = 0.03  # of the quadrilateral's size: the corners' error by which a pinhole camera may miss them
UPRIGHT: Final = 0.35  # rad by which a camera may be tilted to the side
DISTANCES: Final = (1.0, 60.0)  # of the court's half length
ALONG: Final = 2.0  # ratio of x to y from which a camera looks along the court
EDGE: Final = 12.0  # grey levels a px: least slope of an edge
ACROSS: Final = (-2.0, -1.0, 0.0, 1.0, 2.0)  # px from a line of the court in which its edge is looked for


def find_court(image: Image, court: Court) -> list[tuple[Pinhole, float]]:
    """Cameras that may have taken a picture of a court, and the shares of the court's lines that fit, best first.

    Args: image: (h, w, 3) BGR.  court: with its corners and lines.
    """
    lines = joined_segments(image)
    quads = quadrilaterals(lines, image.shape[1], image.shape[0])
    cameras = cameras_of(quads, court, (image.shape[1], image.shape[0]))
    slopes = slopes_of(image)
    rated = [(camera, support(slopes, camera, court)) for camera in cameras]
    rated.sort(key=lambda pair: -pair[1])
    corners = np.array([camera.project(court.corners) for camera, _ in rated])
    corners = corners.reshape(len(rated), len(court.corners), 2)
    return [pair for pair, first in zip(rated, _first_of_each(corners, SAME), strict=True) if first]


def joined_segments(image: Image) -> Array:
    """(n, 2, 2) px, ends of straight edges, longest first; pieces of one line are joined."""
    detector = cv2.createLineSegmentDetector()
    found = [detector.detect(grey)[0] for grey in (image.max(axis=2), cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))]
    parts = [one.reshape(-1, 2, 2) for one in found if one is not None]
    if not parts:
        return np.zeros((0, 2, 2))
    segments = np.concatenate(parts).astype(np.float64)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    least = SHORTEST * np.hypot(*image.shape[:2])
    segments = segments[length > 0.25 * least]
    segments = segments[np.argsort(-np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1), kind="stable")]
    lines = np.unique(np.concatenate([_joined(segments, gap) for gap in GAPS]), axis=0)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    lines = lines[np.argsort(-length, kind="stable")][: np.count_nonzero(length > least)]
    from_left = np.take_along_axis(lines, np.argsort(lines[:, :, :1], axis=1, kind="stable"), axis=1)
    return from_left[_first_of_each(from_left, SAME)][:MOST_LINES]


def _first_of_each(points: Array, near: float) -> Mask:
    """(n,) False for sets of points (n, k, 2) px that all lie near to those of an earlier set."""
    apart = np.abs(points[:, None] - points).max(axis=(2, 3), initial=0.0)
    return ~np.tril(apart < near, -1).any(axis=1)


def _joined(segments: Array, gap: float) -> Array:
    """(m, 2, 2) px, lines of segments (n, 2, 2), longest first, that a `gap` of the longer one may part."""
    joined = list[Array]()
    while len(segments):
        line, segments = segments[0], segments[1:]
        while (more := _continues(line, segments, gap)).any():
            line, segments = _hull(line, segments[more]), segments[~more]
        joined.append(line)
    return np.array(joined).reshape(-1, 2, 2)


def _continues(line: Array, others: Array, most: float) -> Mask:
    """(n,) which others (n, 2, 2) lie on a line (2, 2) and at `most` so far from its ends, of the longer one."""
    along = line[1] - line[0]
    length = np.linalg.norm(along)
    along = along / length
    normal = np.array([-along[1], along[0]])
    away = others.reshape(-1, 2) - line[0]
    first, last = (away @ normal).reshape(-1, 2).T
    begin, end = (away @ along).reshape(-1, 2).T
    gap = np.maximum(np.minimum(begin, end) - length, -np.maximum(begin, end))
    extent = np.abs(end - begin)
    aside, turned = np.maximum(np.abs(first), np.abs(last)), np.abs(last - first) / np.maximum(extent, 1e-9)
    return np.asarray((turned < PARALLEL) & (aside < ASIDE) & (gap < most * np.maximum(length, extent)))


def _hull(line: Array, others: Array) -> Array:
    """(2, 2) px, the line through the ends of a line and others, weighted by length, as long as all of them."""
    ends = np.concatenate((line[None], others))
    weight = np.repeat(np.linalg.norm(ends[:, 1] - ends[:, 0], axis=1), 2)
    points = ends.reshape(-1, 2)
    middle = weight @ points / weight.sum()
    away = points - middle
    along = np.linalg.eigh((away * weight[:, None]).T @ away)[1][:, 1]
    places = away @ along
    return np.asarray(middle + np.array([[places.min()], [places.max()]]) * along)


def quadrilaterals(lines: Array, width: int, height: int) -> Array:
    """(q, 4, 2) px, corners in clockwise order as seen, of lines (n, 2, 2) px that meet at their ends."""
    start, along = lines[:, 0], lines[:, 1] - lines[:, 0]
    length = np.linalg.norm(along, axis=1)
    unit = along / np.maximum(length, 1e-9)[:, None]
    cross = unit[:, None, 0] * unit[None, :, 1] - unit[:, None, 1] * unit[None, :, 0]
    between = start[None] - start[:, None]
    with np.errstate(divide="ignore", invalid="ignore"):
        place = (between[..., 0] * unit[None, :, 1] - between[..., 1] * unit[None, :, 0]) / cross  # px along line i
    tolerance = (OPEN[0] + OPEN[1] * length)[:, None]
    at_start, at_end = np.abs(place) < tolerance, np.abs(place - length[:, None]) < tolerance
    apart = np.abs(cross) > np.sin(0.1)
    meet, past = apart & (at_start | at_end), apart & ((place < tolerance) | (place > length[:, None] - tolerance))
    meet, past = meet & meet.T, past & past.T
    corner = start[:, None] + np.nan_to_num(place)[..., None] * unit[:, None]
    second = place > 0.5 * length[:, None]
    found = list[Array]()
    for a, c in combinations(range(len(lines)), 2):
        whole, most = meet[a] & meet[c], (meet[a] & past[c]) | (past[a] & meet[c])
        b, d = (one.ravel() for one in np.meshgrid(np.flatnonzero(whole), np.flatnonzero(most), indexing="ij"))
        opposite = (second[a, b] != second[a, d]) & (second[c, b] != second[c, d]) & ((b < d) | ~whole[d])
        opposite &= (second[b, a] != second[b, c]) & (second[d, a] != second[d, c])
        b, d = b[opposite], d[opposite]
        found.append(np.stack((corner[a, b], corner[b, c], corner[c, d], corner[d, a]), axis=1))
    quads = np.concatenate((np.zeros((0, 4, 2)), *found))
    edges = np.roll(quads, -1, axis=1) - quads
    turns = edges[..., 0] * np.roll(edges[..., 1], -1, axis=1) - edges[..., 1] * np.roll(edges[..., 0], -1, axis=1)
    x, y = quads[..., 0], quads[..., 1]
    area = 0.5 * (x * np.roll(y, -1, axis=1) - y * np.roll(x, -1, axis=1)).sum(axis=1)
    quads = np.where((area < 0.0)[:, None, None], quads[:, ::-1], quads)
    convex = (turns > 0.0).all(axis=1) | (turns < 0.0).all(axis=1)
    kept = quads[convex & (np.abs(area) > SMALLEST * width * height)]
    return np.unique(np.round(kept, 2), axis=0) if len(kept) else kept


def cameras_of(quads: Array, court: Court, size: tuple[int, int]) -> list[Pinhole]:
    """The cameras above the court that see its corners near those of quadrilaterals (q, 4, 2) px."""
    middle, found = (np.array(size) - 1.0) / 2.0, list[Pinhole]()
    flat = court.corners[:, :2].astype(np.float32)
    for quad in quads:
        scale = np.linalg.norm(quad - quad.mean(axis=0), axis=1).mean()
        for first in range(2):  # clockwise as seen from above is clockwise in the picture
            seen = np.roll(quad[::-1], first, axis=0)
            plane = cv2.getPerspectiveTransform(flat, (seen - middle).astype(np.float32))
            one = _first(np.asarray(plane, dtype=np.float64), seen - middle, court, size)
            if one is not None:
                one = _fitted(one, court, seen)
                missed = np.linalg.norm(one.project(court.corners) - seen, axis=1)
                found += [one] if (missed < MISSED * scale).all() else []  # NaN: one is behind the camera
    return [_in_front(one) for one in found if _possible(one.turn[None], one.place[None], court).all()]


def _fitted(camera: Pinhole, court: Court, seen: Array) -> Pinhole:
    """The camera after steps of Gauss and Newton to where the corners are seen (4, 2) px.

    From low behind a court the rotation nearest to a homography misses them by a quarter of the court.
    """
    for _ in range(ROUNDS):
        if not np.isfinite(camera.project(court.corners)).all():
            break
        pixels, slope = slopes(camera, court.corners)
        rows, left = slope.reshape(-1, 7), (seen - pixels).ravel()
        step = np.linalg.solve(rows.T @ rows + 1e-6 * np.eye(7), rows.T @ left)
        camera = moved(camera, step * min(1.0, 0.2 / np.abs(step[[0, 1, 2, 6]]).max()))
    return camera


def _first(plane: Array, seen: Array, court: Court, size: tuple[int, int]) -> Pinhole | None:
    """The camera of `FOCALS` that sees a court's corners nearest to where they are seen; None if none may.

    Args: plane: (3, 3), from the court to `seen` (4, 2) px from the image's middle.
    """
    focal = FOCALS * size[0]
    turn, place = posed(np.tile(plane, (len(focal), 1, 1)), focal)
    at = (court.corners - place[:, None]) @ turn.swapaxes(1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = np.linalg.norm(focal[:, None, None] * at[..., :2] / at[..., 2:] - seen, axis=2).max(axis=1)
    missed[~_possible(turn, place, court)] = np.inf
    best = int(np.argmin(missed))
    return Pinhole(turn[best], place[best], float(focal[best]), size) if np.isfinite(missed[best]) else None


def _in_front(camera: Pinhole) -> Pinhole:
    """The camera at the side of -y, or of -x if it looks along the court: half a turn changes no picture."""
    x, y, _ = camera.place
    if x < 0.0 if abs(x) > ALONG * abs(y) else y < 0.0:
        return camera
    half = np.array([-1.0, -1.0, 1.0])
    return replace(camera, turn=camera.turn * half, place=camera.place * half)


def _possible(turn: Array, place: Array, court: Court) -> Mask:
    """(m,) bool: cameras above the court, upright, at a distance from which courts are filmed."""
    up = -turn[:, 1, 2]  # of the world's z, upwards in the picture
    tilted = np.abs(np.arctan2(turn[:, 0, 2], up))
    reach = np.linalg.norm(place, axis=1) / court.size[0]
    at = (court.corners - place[:, None]) @ turn.swapaxes(1, 2)
    near = (reach > DISTANCES[0]) & (reach < DISTANCES[1])
    return np.asarray((place[:, 2] > 0.0) & (at[..., 2] > 0.0).all(axis=1) & (tilted < UPRIGHT) & near)


def slopes_of(image: Image) -> Array:
    """(h, w, 2) grey levels a px, the slope along x and y in the channel where it is largest."""
    blurred = cv2.GaussianBlur(image, (3, 3), 0)
    x, y = (cv2.Sobel(blurred, cv2.CV_32F, *way, scale=0.125) for way in ((1, 0), (0, 1)))
    strongest = np.argmax(x * x + y * y, axis=2)[..., None]
    return np.concatenate([np.take_along_axis(one, strongest, axis=2) for one in (x, y)], axis=2)


def support(slopes: Array, camera: Pinhole, court: Court) -> float:
    """Share of the court's lines, seen by a camera, along which the picture has edges of their direction.

    Args: slopes: (h, w, 2) as of `slopes_of`.
    """
    _, pixels, normals, _ = sampled(camera, court)
    normal = normals[:, None]
    fits = np.zeros(pixels.shape[:2], dtype=bool)
    height, width = slopes.shape[:2]
    for offset in ACROSS:
        x, y = np.moveaxis(np.round(np.nan_to_num(pixels + offset * normal, nan=-1.0)).astype(np.int64), -1, 0)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        here = slopes[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        steep = np.abs((here * normal).sum(axis=-1))
        fits |= inside & (steep > EDGE) & (steep > 0.9 * np.linalg.norm(here, axis=-1))
    return float(fits.mean())
