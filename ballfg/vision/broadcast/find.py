"""Finds a court in one picture: quadrilaterals of straight edges, ranked by how well all lines of the court fit.

Segments (LSD; Grompone von Gioi et al. 2010) that continue each other are joined; four that meet at corners are a
quadrilateral. A quadrilateral that a pinhole camera above the court may see gives that camera; the share of the court's
lines along which the picture has an edge of their direction ranks them.
"""

from __future__ import annotations

from itertools import combinations
from typing import Final

import cv2
import numpy as np

from ballfg.arrays import Array, Mask
from ballfg.vision.arrays import Image
from ballfg.vision.broadcast.court import Court
from ballfg.vision.broadcast.pinhole import Pinhole, posed

SHORTEST: Final = 0.02
"""Of the image's diagonal: a shorter segment is not used."""
MOST_LINES: Final = 90
"""Longest ones that are combined."""
PARALLEL, ASIDE, GAPS = 0.03, 2.0, (0.15, 0.6)
"""rad and px by which segments of one line differ; the gap between them, of the longer one. A wide gap bridges a player
before an edge, but continues another edge with what lies in its direction on the floor: lines of both are combined."""
OPEN: Final = (8.0, 0.12)
"""px, and share of a segment's length, by which it may end before a corner or pass it."""
SMALLEST: Final = 0.004
"""Of the image's area."""
FOCALS: Final = np.geomspace(0.5, 10.0, 22)
"""Focal lengths that are tried, of the image's width."""
FINER: Final = (FOCALS[1] / FOCALS[0]) ** np.linspace(-1.0, 1.0, 13)
"""Factors about the best of them that are tried next: one step misses the corners of a large court by too much."""
MISSED: Final = 0.03
"""Of the quadrilateral's size: the corners' error by which a pinhole camera may miss them."""
UPRIGHT: Final = 0.35
"""rad by which a camera may be tilted to the side."""
DISTANCES: Final = (1.0, 60.0)
"""Of the court's half length."""
ALONG: Final = 2.0
"""Ratio of x to y from which a camera looks along the court."""
SAMPLES: Final = 24
"""Along a line of the court."""
EDGE: Final = 12.0
"""Grey levels a px: least slope of an edge."""
ACROSS: Final = (-2.0, -1.0, 0.0, 1.0, 2.0)
"""px from a line of the court in which its edge is looked for."""


def find_court(image: Image, court: Court) -> list[tuple[Pinhole, float]]:
    """Cameras that may have taken a picture of a court, and the shares of the court's lines that fit, best first.

    Args: image: (h, w, 3) BGR.  court: with its corners and lines.
    """
    lines = joined_segments(image)
    quads = quadrilaterals(lines, image.shape[1], image.shape[0])
    cameras = cameras_of(quads, court, (image.shape[1], image.shape[0]))
    slopes = slopes_of(image)
    rated = [(camera, support(slopes, camera, court)) for camera in cameras]
    return sorted(rated, key=lambda pair: -pair[1])


def joined_segments(image: Image) -> Array:
    """(n, 2, 2) px, ends of straight edges, longest first; pieces of one line are joined."""
    detector = cv2.createLineSegmentDetector()
    found = [detector.detect(grey)[0] for grey in (image.max(axis=2), cv2.cvtColor(image, cv2.COLOR_BGR2GRAY))]
    parts = [one.reshape(-1, 2, 2) for one in found if one is not None]
    if not parts:
        return np.zeros((0, 2, 2))
    segments = np.concatenate(parts).astype(np.float64)
    length = np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1)
    segments = segments[length > 0.25 * SHORTEST * np.hypot(*image.shape[:2])]
    segments = segments[np.argsort(-np.linalg.norm(segments[:, 1] - segments[:, 0], axis=1), kind="stable")]
    lines = np.unique(np.concatenate([_joined(segments, gap) for gap in GAPS]), axis=0)
    length = np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1)
    order = np.argsort(-length, kind="stable")[:MOST_LINES]
    return np.asarray(lines[order][length[order] > SHORTEST * np.hypot(*image.shape[:2])])


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
    meet = (np.abs(cross) > np.sin(0.1)) & (at_start | at_end)
    meet &= meet.T
    corner = start[:, None] + np.nan_to_num(place)[..., None] * unit[:, None]
    found = list[Array]()
    for a, c in combinations(range(len(lines)), 2):
        both = np.flatnonzero(meet[a] & meet[c])
        ends = (place[a, both] > 0.5 * length[a]), (place[c, both] > 0.5 * length[c])
        for i, j in combinations(range(len(both)), 2):
            if ends[0][i] != ends[0][j] and ends[1][i] != ends[1][j]:
                b, d = both[i], both[j]
                found.append(np.array([corner[a, b], corner[b, c], corner[c, d], corner[d, a]]))
    quads = np.array(found).reshape(-1, 4, 2)
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
        for first in range(4):  # clockwise as seen from above is clockwise in the picture
            seen = np.roll(quad[::-1], first, axis=0) - middle
            plane = np.asarray(cv2.getPerspectiveTransform(flat, seen.astype(np.float32)), dtype=np.float64)
            one, missed = _best(plane, seen, court, FOCALS * size[0], size)
            if np.isfinite(missed):
                one, missed = _best(plane, seen, court, one.focal * FINER, size)
            if missed < MISSED * scale:
                found.append(one)
    return [one for one in found if _in_front(one.place)]


def _best(plane: Array, seen: Array, court: Court, focal: Array, size: tuple[int, int]) -> tuple[Pinhole, float]:
    """The camera of those focal lengths (m,) px that sees a court's corners nearest to where they are seen.

    Args: plane: (3, 3), from the court to `seen` (4, 2) px from the image's middle.
    Returns: it, and by how much it misses them, px; infinite where none is possible.
    """
    turn, place = posed(np.tile(plane, (len(focal), 1, 1)), focal)
    at = (court.corners - place[:, None]) @ turn.swapaxes(1, 2)
    with np.errstate(divide="ignore", invalid="ignore"):
        missed = np.linalg.norm(focal[:, None, None] * at[..., :2] / at[..., 2:] - seen, axis=2).max(axis=1)
    missed[~_possible(turn, place, at, court)] = np.inf
    best = int(np.argmin(missed))
    return Pinhole(turn[best], place[best], float(focal[best]), size), float(missed[best])


def _in_front(place: Array) -> bool:
    """True for a camera at the side of -y, or of -x if it looks along the court: half a turn changes no picture."""
    x, y, _ = place
    return bool(x < 0.0 if abs(x) > ALONG * abs(y) else y < 0.0)


def _possible(turn: Array, place: Array, at: Array, court: Court) -> Mask:
    """(m,) bool: cameras above the court, upright, at a distance from which courts are filmed."""
    up = -turn[:, 1, 2]  # of the world's z, upwards in the picture
    tilted = np.abs(np.arctan2(turn[:, 0, 2], up))
    reach = np.linalg.norm(place, axis=1) / court.size[0]
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
    share = (np.arange(SAMPLES) + 0.5) / SAMPLES
    points = court.lines[:, None, 0] + share[:, None] * (court.lines[:, None, 1] - court.lines[:, None, 0])
    pixels = camera.project(points)
    along = pixels[:, -1] - pixels[:, 0]
    along /= np.linalg.norm(along, axis=1)[:, None]
    normal = np.stack((-along[:, 1], along[:, 0]), axis=1)[:, None]
    fits = np.zeros(pixels.shape[:2], dtype=bool)
    height, width = slopes.shape[:2]
    for offset in ACROSS:
        x, y = np.moveaxis(np.round(np.nan_to_num(pixels + offset * normal, nan=-1.0)).astype(np.int64), -1, 0)
        inside = (x >= 0) & (x < width) & (y >= 0) & (y < height)
        here = slopes[np.clip(y, 0, height - 1), np.clip(x, 0, width - 1)]
        steep = np.abs((here * normal).sum(axis=-1))
        fits |= inside & (steep > EDGE) & (steep > 0.9 * np.linalg.norm(here, axis=-1))
    return float(fits.mean())
