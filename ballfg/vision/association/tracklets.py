"""Finds short pieces of smooth motion among one camera's candidates.

A piece starts with three candidates in (nearly) successive frames, goes on where its quadratic continuation leads, and
ends where two answers are equally good or nothing is found for a few frames. At a bounce, for instance, a new one
starts.
"""

import math
from dataclasses import dataclass, field
from itertools import product
from typing import Final

import numpy as np

from ballfg.arrays import Index
from ballfg.vision.association.paths import RATE_OF_CHANGE
from ballfg.vision.detection.detections import Detections

MAX_MISSED: Final = 3  # frames in a row that a piece may miss
MAX_TURN: Final = 15.0  # rad/s, fastest motion across the view that is followed: 15 m/s at a distance of 1 m
_PULL: Final = 7.0  # rad/s^2, acceleration across the view of what moves slowly: gravity at 1.4 m
_GATE: Final = 16.0  # squared deviation, in variances of the prediction, that continues a piece: 4 sigma
_MARGIN: Final = 9.0  # least advantage of the best answer's cost over the next for an unambiguous choice
_LEAST_VARIANCE: Final = 0.06  # px^2, of a candidate, a quarter of a pixel's sigma: compression, shading, the lens
_SCORE_COST: Final = 6.0  # cost of a candidate of score 0 against one of score 1
_STILL: Final = 3.0  # px, what moves by less over its piece's life does not move


@dataclass(eq=False)
class _Seen:
    """One candidate, as plain numbers: the loops below handle few of them, millions of times."""

    row: int
    frame: int
    time: float
    u: float
    v: float
    variance: float
    cost: float
    free: bool = True


@dataclass(eq=False)
class _Piece:
    seen: list[_Seen]
    answers: list[tuple[float, _Seen]] = field(default_factory=list)


def find_tracklets(detections: Detections, focal: float) -> list[Index]:
    """The pieces of a camera of that focal length (px): rows (k,) of each, k >= 3, in time, by their first ones."""
    open_pieces: list[_Piece] = []
    done: list[_Piece] = []
    recent: list[list[_Seen]] = []
    last = -1
    for number, candidates in _frames(detections):
        lost = min(number - last - 1, MAX_MISSED)
        recent, last = [*recent, *([] for _ in range(lost)), candidates][-(MAX_MISSED + 1) :], number
        done += [piece for piece in open_pieces if number - piece.seen[-1].frame > MAX_MISSED + 1]
        open_pieces = [piece for piece in open_pieces if number - piece.seen[-1].frame <= MAX_MISSED + 1]
        _offer(open_pieces, candidates, focal)
        _accept(open_pieces, done)
        open_pieces += _start(recent, focal)
    rows = [np.array([seen.row for seen in piece.seen], dtype=np.int64) for piece in done + open_pieces]
    moving = [piece for piece in rows if np.ptp(detections.pixels[piece], axis=0).max() > _STILL]
    return sorted(moving, key=lambda piece: int(piece[0]))


def _frames(detections: Detections) -> list[tuple[int, list[_Seen]]]:
    """The frames with candidates, and their numbers, which count frames that are missing too."""
    steps = np.diff(detections.frames)
    # A table of a clean detector has no row of a frame without a ball: time tells how many frames lie between.
    counted = np.maximum(np.rint(steps / np.median(steps)), 1.0) if len(steps) else steps
    numbers = np.concatenate(([0], np.cumsum(counted)))[: len(detections.frames)].astype(np.int64).tolist()
    frames: list[list[_Seen]] = [[] for _ in detections.frames]
    variances = np.maximum(np.trace(detections.covariances, axis1=1, axis2=2) / 2.0, _LEAST_VARIANCE)
    costs = _SCORE_COST * (1.0 - detections.scores)
    columns = (detections.frame, detections.times, detections.pixels, variances, costs)
    rows = zip(*(column.tolist() for column in columns), strict=True)
    for row, (frame, time, (u, v), variance, cost) in enumerate(rows):
        frames[frame].append(_Seen(row, numbers[frame], time, u, v, variance, cost))
    return [(number, seen) for number, seen in zip(numbers, frames, strict=True) if seen]


def _offer(pieces: list[_Piece], candidates: list[_Seen], focal: float) -> None:
    """Writes the candidates near each piece's continuation into its `answers`, best first."""
    for piece in pieces:
        u, v, variance = _predicted(piece.seen, candidates[0].time, focal)
        piece.answers = []
        for seen in candidates:
            distance = ((seen.u - u) ** 2 + (seen.v - v) ** 2) / (variance + seen.variance)
            if distance <= _GATE:
                piece.answers.append((distance + seen.cost, seen))
        piece.answers.sort(key=lambda answer: answer[0])


def _accept(pieces: list[_Piece], done: list[_Piece]) -> None:
    """Gives every piece its unambiguous candidate; moves the other pieces to `done`."""
    claims: dict[int, list[float]] = {}
    for piece in pieces:
        for cost, seen in piece.answers:
            claims.setdefault(seen.row, []).append(cost)
    unclear = []
    for piece in pieces:
        if not piece.answers:
            continue
        cost, best = piece.answers[0]
        others = sorted(claims[best.row])
        rivals = [c for c, seen in piece.answers[1:] if not min(claims[seen.row]) < c - _MARGIN]
        wanted = others[0] < cost or (len(others) > 1 and others[1] < cost + _MARGIN)
        if wanted or any(rival < cost + _MARGIN for rival in rivals):
            unclear.append(piece)
        else:
            best.free = False
            piece.seen.append(best)
    done += unclear
    pieces[:] = [piece for piece in pieces if piece not in unclear]


def _predicted(seen: list[_Seen], time: float, focal: float) -> tuple[float, float, float]:
    """Continuation of a piece at `time`: u, v, variance (px^2), by a parabola through three of its last samples.

    Neighbours are a short lever, samples farther apart leave more curvature out; the surer answer counts.
    """
    best = (0.0, 0.0, math.inf)
    for spread in (1, 2, 4):
        if len(seen) < 2 * spread + 1:
            break
        a, b, c = seen[-1], seen[-1 - spread], seen[-1 - 2 * spread]
        da, db, dc = time - a.time, time - b.time, time - c.time
        ab, ac, bc = a.time - b.time, a.time - c.time, b.time - c.time
        wa, wb, wc = db * dc / (ab * ac), -da * dc / (ab * bc), da * db / (ac * bc)
        pull = math.hypot((a.u - b.u) / ab - (b.u - c.u) / bc, (a.v - b.v) / ab - (b.v - c.v) / bc) * 2.0 / ac
        left_out = (pull + _PULL * focal) * RATE_OF_CHANGE * da * db * dc / 6.0
        variance = wa * wa * a.variance + wb * wb * b.variance + wc * wc * c.variance + left_out**2
        if variance < best[2]:
            best = (wa * a.u + wb * b.u + wc * c.u, wa * a.v + wb * b.v + wc * c.v, variance)
    return best


def _start(recent: list[list[_Seen]], focal: float) -> list[_Piece]:
    """New pieces of three free candidates, the last of them in the last frame, least acceleration first."""
    found: list[tuple[float, _Seen, _Seen, _Seen]] = []
    last = [seen for seen in recent[-1] if seen.free]
    before = [[seen for seen in frame if seen.free] for frame in recent[:-1]]
    for first, second in [(-2, -1), (-3, -1), (-3, -2)]:
        if last and len(before) >= -first:
            for a, b in product(before[first], before[second]):
                found += _triples(a, b, last, focal)
    found.sort(key=lambda triple: triple[0])
    pieces = []
    for _, a, b, c in found:
        if a.free and b.free and c.free:
            a.free = b.free = c.free = False
            pieces.append(_Piece([a, b, c]))
    return pieces


def _triples(a: _Seen, b: _Seen, last: list[_Seen], focal: float) -> list[tuple[float, _Seen, _Seen, _Seen]]:
    """The candidates c that go on from a and b, with their cost; those too fast or too sharply turned left out."""
    ab = b.time - a.time
    across, down = (b.u - a.u) / ab, (b.v - a.v) / ab
    speed = math.hypot(across, down)
    if speed > MAX_TURN * focal:
        return []
    found = []
    for c in last:
        bc = c.time - b.time
        ratio = bc / ab
        u, v = b.u + across * bc, b.v + down * bc
        pull = (_PULL * focal + 2.0 * RATE_OF_CHANGE * speed) * 0.5 * bc * (ab + bc)
        variance = c.variance + (1.0 + ratio) ** 2 * b.variance + ratio**2 * a.variance
        distance = ((c.u - u) ** 2 + (c.v - v) ** 2) / (variance + pull**2 / 4.0)
        if distance <= _GATE / 2.0:
            found.append((distance + a.cost + b.cost + c.cost + math.sqrt(variance + pull**2 / 4.0), a, b, c))
    return found
