"""Finds smooth arcs among the candidates of successive pictures: the seeds of flights.

Three candidates whose second difference a ball may have begin an arc; it goes on to both sides where a parabola through
its last points meets a candidate. Over pictures without the ball arcs begin with the likeliest candidates only, and
bars must agree with the motion.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache
from itertools import pairwise, product
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation.rally.field import Field

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
"""Points of an arc, where candidates are many."""
APART: Final = 3
"""Pictures, at most, between the first points of an arc."""
LIKELIEST: Final = 24
"""Candidates of a picture with which an arc begins over pictures without the ball."""
AGREE: Final = 3.0
"""Standard deviations of a bar about its motion."""
EXPOSURES: Final = np.linspace(0.0, 1.0, 41)
"""Of the step, that are tried."""


@dataclass
class Foretold:
    """Where three candidates foretell a fourth: their rows, whether one was there, the area, px^2, of the search."""

    rows: list[list[int]]
    met: list[bool]
    area: list[float]

    def density(self, ball: Index) -> float:
        """1/px^2, of smooth clutter: of candidates that others foretell, without those (n,) that are the ball."""
        clutter = ~np.isin(np.array(self.rows).reshape(-1, 3), ball).any(axis=1)
        area = float(np.array(self.area)[clutter].sum())
        return (float(np.array(self.met)[clutter].sum()) + 1.0) / area if area else 0.0


def with_exposure(field: Field, found: Sequence[Index]) -> Field:
    """The field with the exposure for which the likeliest arcs that follow each other explain the bars best."""
    if not found:
        return field
    rows, motion = np.concatenate(found), np.concatenate([field.motion(one) for one in found])
    begin = np.cumsum([0, *(len(one) for one in found[:-1])])
    first, last = (field.frame[[one[end] for one in found]] for end in (0, -1))
    order = np.argsort(last, kind="stable")
    spot = np.log(field.seen / (field.density[rows] * 2.0 * np.pi * np.sqrt(np.linalg.det(field.covariances[rows]))))
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


def arcs(field: Field) -> tuple[list[Index], Field, Foretold]:
    """Numbers of the candidates of each arc, in order of time, longest arcs first; arcs may share candidates.

    Returns: the arcs, the field with the exposure that they show, and how often they foretell candidates.
    """
    used, tally = set[tuple[int, int]](), Foretold([], [], [])
    every = [field.rows(frame) for frame in range(len(field.first) - 1)]
    found = _begun(field, every, (1,), used, tally)
    long = sorted((rows for rows in found if len(rows) >= LEAST), key=lambda rows: -len(rows))
    none = np.zeros(0, dtype=np.int64)
    field = replace(field, exposure=with_exposure(field.smooth(tally.density(none)), long).exposure)
    likeliest = [rows[np.argsort(field.density[rows], kind="stable")[:LIKELIEST]] for rows in every]
    found += _begun(field, likeliest, range(1, APART + 1), used, tally)
    found = [rows for rows in found if len(rows) >= LEAST or field.agree(rows, AGREE)]
    return sorted(found, key=lambda rows: -len(rows)), field, tally


def _begun(
    field: Field, rows_of: Sequence[Index], gaps: Sequence[int], used: set[tuple[int, int]], tally: Foretold
) -> list[Index]:
    """Arcs that begin with three of the rows of pictures, so many pictures apart, and were not used before."""
    found, bend = list[Index](), TURNING * field.step**2 * field.scale
    for frame in range(1, len(rows_of) - 1):
        for before, after in product(gaps, gaps):
            if not before <= frame < len(rows_of) - after:
                continue
            for triple in _triples(field, [rows_of[frame + k] for k in (-before, 0, after)], before, after, bend):
                if (triple[0], triple[1]) in used and (triple[1], triple[2]) in used:
                    continue
                rows = list(triple)
                _extend(field, rows, 1, bend, tally)
                rows.reverse()
                _extend(field, rows, -1, bend, tally)
                rows.reverse()
                used.update(pairwise(rows))
                found.append(np.array(rows))
                if len(rows) > len(triple):  # beyond pictures without the ball an arc may go on through a bounce
                    found.append(np.array(triple))
    return found


def _triples(
    field: Field, rows: Sequence[Index], before: int, after: int, bend: float
) -> Iterator[tuple[int, int, int]]:
    """Rows of three pictures that may be one ball, smoothest first: of one `before` and one `after` the middle one."""
    a, b, c = rows
    if not (len(a) and len(b) and len(c)):
        return
    step = (field.pixels[b][None] - field.pixels[a][:, None]) / before
    length = np.linalg.norm(step, axis=2)
    i, j = np.nonzero((length < FASTEST * field.step * field.scale) & (length > SLOWEST * field.step * field.scale))
    bent = field.pixels[c][None] - field.pixels[b[j]][:, None] - after * step[i, j][:, None]
    off = np.linalg.norm(bent, axis=2)
    pair, k = np.nonzero(off < 0.5 * bend * after * (before + after) + NOISE)
    three = np.stack((a[i[pair]], b[j[pair]], c[k]), axis=1)
    motion = (field.pixels[three[:, 2]] - field.pixels[three[:, 0]]) / (before + after)
    good = np.all([field.along(three[:, n], motion) for n in range(3)], axis=0)
    if max(before, after) > 1:
        good &= np.all([field.bar_off(three[:, n], motion) < AGREE for n in range(3)], axis=0)
    yield from three[good][np.argsort(off[pair, k][good], kind="stable")].tolist()


def _extend(field: Field, rows: list[int], way: int, bend: float, tally: Foretold) -> None:
    """Goes on with rows in the order of `way`, 1 or -1, as long as candidates continue them."""
    missed, frame = 0, int(field.frame[rows[-1]])
    while missed <= MISSED:
        frame += way
        if not 0 <= frame < len(field.first) - 1:
            return
        last = np.array(rows[-MEMORY:])
        place = _ahead(tuple((field.frame[last] - frame).tolist())) @ field.pixels[last]
        here, reach = field.rows(frame), NOISE + 0.35 * (bend + NOISE) * (1 + missed) ** 2
        off = np.linalg.norm(field.pixels[here] - place[0], axis=1)
        off[~field.along(here, np.tile(place[1], (len(here), 1)))] = np.inf
        near = len(here) > 0 and bool(off.min() < reach)
        if len(rows) == 3 and not missed:
            tally.rows.append(rows[:])
            tally.met.append(near)
            tally.area.append(np.pi * reach**2)
        if near:
            rows.append(int(here[np.argmin(off)]))
        missed = 0 if near else missed + 1


@lru_cache(maxsize=1024)
def _ahead(since: tuple[int, ...]) -> Array:
    """(2, n) weights of points so many pictures away, in their place and motion now: those of a parabola's fit."""
    design = np.stack([np.array(since, dtype=np.float64) ** n for n in range(min(len(since), 3))], axis=1)
    return np.asarray(np.linalg.pinv(design)[:2])
