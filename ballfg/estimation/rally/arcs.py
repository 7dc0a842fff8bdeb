"""Finds smooth arcs among the candidates of successive pictures: the seeds of flights.

Three candidates of successive pictures whose second difference a ball may have begin an arc; it goes on to both sides
where a parabola through its last points meets a candidate.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.vision.detection.detections import Detections

FASTEST: Final = 40.0
"""m/s, of a ball."""
SLOWEST: Final = 0.7
"""m/s: what is slower is not followed."""
TURNING: Final = 45.0
"""m/s^2, acceleration of a ball in flight: gravity, drag at 15 m/s, lift."""
NOISE: Final = 2.0
"""px, of a second difference, and of a point about a parabola."""
MEMORY: Final = 5
"""Last points that foretell the next one."""
MISSED: Final = 2
"""Pictures that an arc may pass without a candidate."""
LEAST: Final = 4
"""Points of an arc."""
ASKEW: Final = 0.5
"""rad between a bar and the motion of its centre."""
LONG: Final = 8.0
"""px of a bar and of a motion whose directions are compared."""
SEEN: Final = 0.9
"""Probability that the ball is among the candidates of a picture."""
BAR_SIGMA, BAR_SHARE = 1.5, 0.12
"""px, and share of its length, by which a ball's bar differs from its motion while the shutter is open."""
SMOOTH: Final = 3e-3
"""1/px^2: what moves smoothly and is no ball, a hand or a shoe, is met as often where its motion foretells it."""
RING: Final = 3.0
"""px, width of the rings in which bars of all candidates are counted."""
STRAY: Final = 0.1
"""Share of a ball's bars that are not: a bounce or a shirt within the exposure."""
EXPOSURES: Final = np.linspace(0.0, 1.0, 41)
"""Of the step, that are tried."""


@dataclass(frozen=True, eq=False)
class Field:
    """The candidates of a recording as one fixed camera would see them, sorted by picture.

    Attributes:
        frame: (n,) numbers of their pictures.  pixels: (n, 2).  covariances: (n, 2, 2) px^2.
        bars: (n, 2) px from end to end, zero where not blurred.  density: (n,) 1/px^2, of clutter that looks as much
        like a ball.  usual: (n,) 1/px^2, density of a bar like each one's among all candidates.  first: (f + 1,) where each picture's begin.  step: s between pictures.
        scale: px for a m at the court.  exposure: of the step, during which the shutter is open.
    """

    frame: Index
    pixels: Array
    covariances: Array
    bars: Array
    density: Array
    usual: Array
    first: Index
    step: float
    scale: float
    exposure: float = 0.0

    @classmethod
    def of(cls, seen: Detections, scale: float) -> Field:
        """The field of detections of a fixed camera, with the exposure that its arcs show."""
        count, size = len(seen.frames), np.ptp(seen.pixels, axis=0)
        better = len(seen) - np.searchsorted(np.sort(seen.scores), seen.scores)
        first = np.searchsorted(seen.frame, np.arange(count + 1))
        step, bars = float(np.median(np.diff(seen.frames))), np.nan_to_num(seen.streaks[:, 1] - seen.streaks[:, 0])
        density = np.maximum(better / count / float(np.prod(np.maximum(size, 1.0))), SMOOTH)
        number = (np.linalg.norm(bars, axis=1) // RING).astype(np.int64)
        share = (np.bincount(number) + 1.0) / (len(bars) + number.max(initial=0) + 1.0)
        usual = share[number] / (np.pi * RING**2 * (2.0 * number + 1.0))  # of rings about a bar of no length
        return cls(seen.frame, seen.pixels, seen.covariances, bars, density, usual, first, step, scale)

    def rows(self, frame: int) -> Index:
        """Numbers of the candidates of a picture; none beyond the ends."""
        inside = 0 <= frame < len(self.first) - 1
        return np.arange(self.first[frame], self.first[frame + 1]) if inside else np.zeros(0, dtype=np.int64)

    def along(self, rows: Index, motion: Array) -> Array:
        """(n,) bool: the bars of rows (n,) lie along motions (n, 2) px, or one of both is short."""
        bars = self.bars[rows]
        cross = np.abs(bars[:, 0] * motion[:, 1] - bars[:, 1] * motion[:, 0])
        long, far = np.linalg.norm(bars, axis=1), np.linalg.norm(motion, axis=1)
        return np.asarray(~((long > LONG) & (far > LONG) & (cross > np.sin(ASKEW) * long * far)))

    def gain(self, rows: Index, motion: Array) -> float:
        """Logarithm of how much likelier candidates (n,) are of a ball with motions (n, 2) px a picture than clutter,
        by their number and their bars; without their distances from a path."""
        spot = self.density[rows] * 2.0 * np.pi * np.sqrt(np.linalg.det(self.covariances[rows]))
        return float(np.log(SEEN / spot).sum() + self.bar_gain(rows, motion, self.exposure).sum())

    def bar_gain(self, rows: Index, motion: Array, exposure: float) -> Array:
        """(n,) of the bars alone: a ball's is as long as its motion while the shutter is open, either way around."""
        bars, true = self.bars[rows], exposure * motion
        off = np.minimum(((bars - true) ** 2).sum(axis=1), ((bars + true) ** 2).sum(axis=1))
        variance = BAR_SIGMA**2 + BAR_SHARE**2 * (true**2).sum(axis=1)
        ratio = np.exp(-0.5 * off / variance) / (2.0 * np.pi * variance) / self.usual[rows]
        return np.asarray(np.log(STRAY + (1.0 - STRAY) * ratio))

    def motion(self, rows: Index) -> Array:
        """(n, 2) px a picture, of an arc."""
        return np.asarray(np.gradient(self.pixels[rows], self.frame[rows].astype(np.float64), axis=0))


def with_exposure(field: Field, found: Sequence[Index]) -> Field:
    """The field with the exposure for which the likeliest arcs that follow each other explain the bars best."""
    if not found:
        return field
    rows, motion = np.concatenate(found), np.concatenate([field.motion(one) for one in found])
    begin = np.cumsum([0, *(len(one) for one in found[:-1])])
    first, last = (field.frame[[one[end] for one in found]] for end in (0, -1))
    order = np.argsort(last, kind="stable")
    spot = np.log(SEEN / (field.density[rows] * 2.0 * np.pi * np.sqrt(np.linalg.det(field.covariances[rows]))))
    sums = list[float]()
    for exposure in EXPOSURES:
        gain = np.add.reduceat(spot + field.bar_gain(rows, motion, exposure), begin)
        best, done = np.zeros(len(field.first) + 1), 0  # of arcs that end before a picture
        for arc in order:
            best[done + 1 : last[arc] + 2] = best[done]
            done = int(last[arc]) + 1
            best[done] = max(best[done], best[first[arc]] + gain[arc])
        sums.append(float(best.max()))
    return replace(field, exposure=float(EXPOSURES[int(np.argmax(sums))]))


def arcs(field: Field) -> list[Index]:
    """Numbers of the candidates of each arc, in order of time, longest arcs first; arcs may share candidates."""
    used, found = set[tuple[int, int]](), list[Index]()
    bend = TURNING * field.step**2 * field.scale + NOISE
    for frame in range(1, len(field.first) - 2):
        for triple in _triples(field, frame, bend):
            if (triple[0], triple[1]) in used and (triple[1], triple[2]) in used:
                continue
            rows = list(triple)
            _extend(field, rows, 1, bend)
            rows.reverse()
            _extend(field, rows, -1, bend)
            rows.reverse()
            used.update(zip(rows[:-1], rows[1:], strict=True))
            if len(rows) >= LEAST:
                found.append(np.array(rows))
    return sorted(found, key=lambda rows: -len(rows))


def _triples(field: Field, frame: int, bend: float) -> Sequence[tuple[int, int, int]]:
    """Candidates of three pictures about `frame` that may be one ball, smoothest first."""
    a, b, c = (field.rows(frame + i) for i in (-1, 0, 1))
    if not (len(a) and len(b) and len(c)):
        return []
    before = field.pixels[b][None] - field.pixels[a][:, None]
    length = np.linalg.norm(before, axis=2)
    fast = (length < FASTEST * field.step * field.scale) & (length > SLOWEST * field.step * field.scale)
    i, j = np.nonzero(fast)
    after = field.pixels[c][None] - field.pixels[b[j]][:, None]
    bent = np.linalg.norm(after - before[i, j][:, None], axis=2)
    pair, k = np.nonzero(bent < bend)
    rows = np.stack((a[i[pair]], b[j[pair]], c[k]), axis=1)
    motion = 0.5 * (field.pixels[rows[:, 2]] - field.pixels[rows[:, 0]])
    good = np.all([field.along(rows[:, n], motion) for n in range(3)], axis=0)
    order = np.argsort(bent[pair, k][good], kind="stable")
    return [(int(x), int(y), int(z)) for x, y, z in rows[good][order]]


def _extend(field: Field, rows: list[int], way: int, bend: float) -> None:
    """Goes on with rows in the order of `way`, 1 or -1, as long as candidates continue them."""
    missed, frame = 0, int(field.frame[rows[-1]])
    while missed <= MISSED:
        frame += way
        last = np.array(rows[-MEMORY:])
        since = (field.frame[last] - frame).astype(np.float64)
        design = np.stack([since**n for n in range(3 if len(last) > 3 else 2 + (len(last) == 3))], axis=1)
        place = np.linalg.lstsq(design, field.pixels[last])[0]
        here = field.rows(frame)
        off = np.linalg.norm(field.pixels[here] - place[0], axis=1)
        off[~field.along(here, np.tile(place[1], (len(here), 1)))] = np.inf
        if len(here) and off.min() < NOISE + 0.35 * bend * (1 + missed) ** 2:
            rows.append(int(here[np.argmin(off)]))
            missed = 0
        else:
            missed += 1
            if not 0 <= frame < len(field.first) - 1:
                return
