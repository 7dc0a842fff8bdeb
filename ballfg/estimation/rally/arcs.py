"""Finds smooth arcs among the candidates of successive pictures: the seeds of flights.

Three candidates whose second difference a ball may have begin an arc; it goes on to both sides where a parabola through
its last points meets a candidate. Over pictures without the ball arcs begin with the likeliest candidates only, and
bars must agree with the motion. What goes on in a straight line at a steady speed for longer than gravity lets a ball
do so is clutter.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Any, Final

import numpy as np
from numba import types

from ballfg.arrays import Index, Mask
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, INDEX, NOTHING, ONE, REAL, TWO, several
from ballfg.estimation.rally.field import Field, along

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
BENT: Final = 3.0
"""Noises, root mean square, by which gravity bends a flight that is told from a straight line."""
CARRIED: Final = 1.0 / 3.0
"""Least share of gravity that bends a flight: the lift of much backspin carries the rest."""
MOSTLY: Final = 0.5
"""Share of straight candidates from which on an arc is no seed of a flight."""
EXPOSURES: Final = np.linspace(0.0, 1.0, 41)
"""Of the step, that are tried."""
FLAGS: Final[Any] = types.Array(types.boolean, 2, "C")


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

    def without(self, clutter: Mask) -> "Foretold":
        """What is left without the triples that hold one of some candidates (n,) bool."""
        kept = np.asarray(~clutter[np.array(self.rows, dtype=np.int64).reshape(-1, 3)].any(axis=1))
        return Foretold(*([one for one, keep in zip(of, kept, strict=True) if keep] for of in vars(self).values()))


def telling(field: Field) -> float:
    """s, for which a ball flies until gravity has bent its flight by clearly more than noise.

    The second integral of an acceleration a over a time T misses its best straight line by a T^2 / (2 sqrt(180)), root
    mean square.
    """
    return float(np.sqrt(BENT * NOISE * 2.0 * np.sqrt(180.0) / (CARRIED * field.fall))) if field.fall else np.inf


def straight(field: Field, found: Sequence[Index]) -> Mask:
    """(n,) True for candidates of arcs that are straight and steady for longer than gravity lets a ball be so.

    Such a motion (a light, a shadow, somebody who walks by) foretells its candidates as exactly as a flight does, and a
    flight through it would explain nothing. Long arcs are looked at in parts.
    """
    among, longest = np.zeros(len(field.frame), dtype=bool), telling(field)
    for rows in found:
        since = field.stamps[field.frame[rows]] - field.stamps[field.frame[rows[0]]]
        parts = int(since[-1] / longest)
        ends = np.searchsorted(since, np.arange(1, parts) * since[-1] / parts) if parts else ()
        for part in np.split(rows, ends) if parts else ():
            among[part] |= len(part) >= LEAST and field.off(part, 1) < NOISE
    return among


def _flown(field: Field, found: Sequence[Index]) -> tuple[list[Index], Mask]:
    """The arcs that may be flights, and `straight` of all."""
    clutter = straight(field, found)
    return [rows for rows in found if clutter[rows].mean() < MOSTLY], clutter


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
        sums.append(_likeliest(gain, first, last, order, len(field.first)))
    return replace(field, exposure=float(EXPOSURES[int(np.argmax(sums))]))


@machine_code(REAL(ONE, COUNTS, COUNTS, COUNTS, COUNT))
def _likeliest(gain, first, last, order, frames):
    """The largest sum of gains (k,) of arcs that follow each other; order (k,) is that of their ends."""
    best, done = np.zeros(frames + 1), 0  # of arcs that end before a picture
    for arc in order:
        best[done + 1 : last[arc] + 2] = best[done]
        done = last[arc] + 1
        best[done] = max(best[done], best[first[arc]] + gain[arc])
    return best.max()


def arcs(field: Field) -> tuple[list[Index], Field, Foretold]:
    """Numbers of the candidates of each arc, in order of time, longest arcs first; arcs may share candidates.

    Returns: the arcs, the field with the exposure that they show, in which straight motions are no evidence of a ball,
    and how often other arcs foretell candidates.
    """
    tally, frames = Foretold([], [], []), len(field.first) - 1
    widest = max((field.first[min(k + 1 + APART, frames)] - field.first[k + 1] for k in range(frames)), default=0)
    used = np.zeros((len(field.frame), int(widest)), dtype=bool)
    every = [field.rows(frame) for frame in range(len(field.first) - 1)]
    found = _begun(field, every, (1,), used, tally)
    long, _ = _flown(field, sorted((rows for rows in found if len(rows) >= LEAST), key=lambda rows: -len(rows)))
    none = np.zeros(0, dtype=np.int64)
    field = replace(field, exposure=with_exposure(field.smooth(tally.density(none)), long).exposure)
    likeliest = [rows[np.argsort(field.density[rows], kind="stable")[:LIKELIEST]] for rows in every]
    found += _begun(field, likeliest, range(1, APART + 1), used, tally)
    found = [rows for rows in found if len(rows) >= LEAST or field.agree(rows, AGREE)]
    found, clutter = _flown(field, found)
    return sorted(found, key=lambda rows: -len(rows)), field.without(clutter), tally.without(clutter)


def _begun(field: Field, rows_of: Sequence[Index], gaps: Sequence[int], used: Mask, tally: Foretold) -> list[Index]:
    """Arcs that begin with three of the rows of pictures, so many pictures apart, and were not used before.

    Args: used: (n, k) of each candidate and those of the next pictures whether an arc holds both; is overwritten.
    """
    found, bend = list[Index](), TURNING * field.step**2 * field.scale
    for frame in range(1, len(rows_of) - 1):
        for before, after in product(gaps, gaps):
            if not before <= frame < len(rows_of) - after:
                continue
            three = _triples(field, [rows_of[frame + k] for k in (-before, 0, after)], before, after, bend)
            flat, ends, asked, met = _followed(field.frame, field.pixels, field.bars, field.first, three, bend, used)
            found += np.split(flat, ends)[:-1]
            tally.rows += three[asked].tolist()
            tally.met += (met > 0).tolist()
            tally.area += [np.pi * _reach(bend, 0) ** 2] * len(asked)
    return found


def _triples(field: Field, rows: Sequence[Index], before: int, after: int, bend: float) -> Index:
    """Rows (k, 3) of three pictures that may be one ball, smoothest first: `before` and `after` the middle one."""
    flat, off = _smooth(field.pixels, *rows, before, after, field.step * field.scale, bend)
    three = flat.reshape(-1, 3)
    motion = (field.pixels[three[:, 2]] - field.pixels[three[:, 0]]) / (before + after)
    good = np.all([field.along(three[:, n], motion) for n in range(3)], axis=0)
    if max(before, after) > 1:
        good &= np.all([field.bar_off(three[:, n], motion) < AGREE for n in range(3)], axis=0)
    return three[good][np.argsort(off[good], kind="stable")]


@machine_code(types.Tuple((COUNTS, ONE))(TWO, COUNTS, COUNTS, COUNTS, COUNT, COUNT, REAL, REAL))
def _smooth(pixels, first, middle, last, before, after, unit, bend):
    """Rows (3 k,) of candidates of three pictures, and px (k,) of their second differences, if a ball may have them.

    Args: first, middle, last: rows of the pictures.  unit: px, of 1 m/s in a picture.
    """
    flat, off = [0][:0], [0.0][:0]
    for i in first:
        for j in middle:
            x, y = (pixels[j, 0] - pixels[i, 0]) / before, (pixels[j, 1] - pixels[i, 1]) / before
            if SLOWEST * unit < math.sqrt(x * x + y * y) < FASTEST * unit:
                for k in last:
                    u, v = pixels[k, 0] - pixels[j, 0] - after * x, pixels[k, 1] - pixels[j, 1] - after * y
                    bent = math.sqrt(u * u + v * v)
                    if bent < 0.5 * bend * after * (before + after) + NOISE:
                        flat += [i, j, k]
                        off.append(bent)
    return np.array(flat), np.array(off)


@machine_code(REAL(REAL, COUNT))
def _reach(bend, missed):
    """Distance, px, from where it is foretold, within which a candidate continues an arc that just missed some."""
    return NOISE + 0.35 * (bend + NOISE) * (1 + missed) ** 2


@machine_code(NOTHING(COUNTS, TWO, COUNTS, COUNT, ONE, ONE))
def _ahead(frames, pixels, rows, frame, place, motion):
    """Writes place (2,) px and motion (2,) px a picture in a picture, by a parabola through points (n,)."""
    s = np.zeros(5)
    for row in rows:
        for power in range(5):
            s[power] += float(frames[row] - frame) ** power
    # rows of the inverse of the normal equations' matrix, times its determinant
    own = (s[2] * s[4] - s[3] * s[3], s[2] * s[3] - s[1] * s[4], s[1] * s[3] - s[2] * s[2])
    way = (own[1], s[0] * s[4] - s[2] * s[2], s[1] * s[2] - s[0] * s[3])
    size = s[0] * own[0] + s[1] * own[1] + s[2] * own[2]
    place[:], motion[:] = 0.0, 0.0
    for row in rows:
        t = float(frames[row] - frame)
        for axis in range(2):
            place[axis] += (own[0] + own[1] * t + own[2] * t * t) / size * pixels[row, axis]
            motion[axis] += (way[0] + way[1] * t + way[2] * t * t) / size * pixels[row, axis]


@machine_code(COUNT(COUNTS, TWO, TWO, COUNTS, COUNTS, COUNTS, COUNT, REAL))
def _extend(frames, pixels, bars, begins, arc, span, way, bend):
    """Goes on with an arc, rows span[0] to span[1] of `arc`, after it (way 1) or before it, as candidates continue it.

    Overwrites: arc, span. Returns: 1 if the next picture has a candidate that continues it, 0 if not, -1 if none is.
    """
    missed, first, place, motion = 0, -1, np.empty(2), np.empty(2)
    frame = frames[arc[span[1] - 1 if way > 0 else span[0]]]
    while missed <= MISSED:
        frame += way
        if not 0 <= frame < len(begins) - 1:
            break
        begin = max(span[1] - MEMORY, span[0]) if way > 0 else span[0]
        _ahead(frames, pixels, arc[begin : min(begin + MEMORY, span[1])], frame, place, motion)
        nearest, best = _reach(bend, missed), -1
        for row in range(begins[frame], begins[frame + 1]):
            off = math.hypot(pixels[row, 0] - place[0], pixels[row, 1] - place[1])
            if off < nearest and along(bars[row, 0], bars[row, 1], motion[0], motion[1]):
                nearest, best = off, row
        if first < 0:
            first = int(best >= 0)
        missed = 0 if best >= 0 else missed + 1
        if best >= 0 and way > 0:
            arc[span[1]] = best
            span[1] += 1
        elif best >= 0:
            span[0] -= 1
            arc[span[0]] = best
    return first


@machine_code(several(COUNTS, 4)(COUNTS, TWO, TWO, COUNTS, INDEX, REAL, FLAGS))
def _followed(frames, pixels, bars, begins, triples, bend, used):
    """The arcs that triples (k, 3) begin, and these themselves, but for those whose pairs are used; overwrites used.

    Returns: rows of all arcs; where each one ends among them; the triples that foretold a fourth candidate, ahead or
    behind, and 1 where it was there.
    """
    flat, ends, asked, met = [0][:0], [0][:0], [0][:0], [0][:0]
    arc, span = np.empty(2 * len(begins) + 3, dtype=np.int64), np.empty(2, dtype=np.int64)
    for k in range(len(triples)):
        a, b, c = triples[k, 0], triples[k, 1], triples[k, 2]
        if used[a, b - begins[frames[a] + 1]] and used[b, c - begins[frames[b] + 1]]:
            continue
        span[0], span[1] = len(begins), len(begins) + 3
        arc[span[0]], arc[span[0] + 1], arc[span[0] + 2] = a, b, c
        for way in (1, -1):
            three = span[1] - span[0] == 3
            there = _extend(frames, pixels, bars, begins, arc, span, way, bend)
            if three and there >= 0:
                asked.append(k)
                met.append(there)
        for place in range(span[0], span[1]):
            flat.append(arc[place])
            if place > span[0]:
                used[arc[place - 1], arc[place] - begins[frames[arc[place - 1]] + 1]] = True
        ends.append(len(flat))
        if span[1] - span[0] > 3:  # beyond pictures without the ball an arc may go on through a bounce
            for row in triples[k]:
                flat.append(row)
            ends.append(len(flat))
    return np.array(flat), np.array(ends), np.array(asked), np.array(met)
