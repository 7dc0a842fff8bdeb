"""Rates strokes, and lets them grow over further candidates, in machine code: the inner loops of `strokes`."""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numba import from_dtype, types

from ballfg.arrays import Array
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, INDEX, NOTHING, ONE, REAL, THREE, TWO, several
from ballfg.estimation.observations.bounced_code import FLOWN, RAYS, SCENE, Flown, flown, share_at
from ballfg.estimation.rally.field import bar_gain, size_gain

SHORT: Final = 0.4
"""Of a picture's time, over which a path shows its motion."""
MISSED, RARE = 3, 0.02
"""Pictures that a flight may pass without a candidate, at least; more, as long as that is not rarer than this."""
LOST: Final = 0.12
"""s for which a flight may pass without a candidate all the same: what hides a ball hides it in many quick pictures."""
GATE: Final = 12.0
"""Squared Mahalanobis distance of a candidate from where it is foretold."""
BOUNCE: Final = 2.0
"""Logarithm of what a bounce costs: its time is free."""
UNBOUNCED: Final = 4.0
"""The same of a stroke without a bounce, and of a second bounce."""
OTHER_HALF: Final = 5.0
"""The same of a bounce on the half on which it scores for nobody: a stroke bounces on the other player's, a service on
its own first."""
NEAREST: Final = 0.1
"""m, least depth at which a ball is foretold."""

CANDIDATE: Final = np.dtype(
    [
        ("frame", np.int64),
        ("pixels", np.float64, (2,)),
        ("covariance", np.float64, (2, 2)),
        ("bar", np.float64, (2,)),
        ("usual", np.float64),
        ("size", np.float64, (2,)),
        ("common", np.float64),
        ("spot", np.float64),
        ("tvec", np.float64, (3,)),
    ]
)
"""A candidate, as in `Field`; spot: logarithm of how much likelier it is the ball than clutter, by its number alone;
tvec: m, of the camera that saw it, which may move."""
VIEW: Final = np.dtype(
    [
        ("rotation", np.float64, (3, 3)),
        ("focal", np.float64),
        ("middle", np.float64, (2,)),
        ("step", np.float64),
        ("seen", np.float64),
        ("exposure", np.float64),
        ("net", np.float64),
        ("ball", np.float64),
    ]
)
"""The camera, which has no distortion; numbers of `Field`; m, x of the court's middle, NaN where it has no ends; m, the
ball's radius."""
ROW: Final[Any] = from_dtype(CANDIDATE)
CANDIDATES: Final[Any] = ROW[::1]
VIEWED: Final[Any] = from_dtype(VIEW)


class Rated(NamedTuple):
    """A stroke's score, the times of its bounces or of its anchor (1,) s, and its path."""

    score: float
    times: Array
    path: Flown


RATED: Final[Any] = types.NamedTuple((REAL, ONE, FLOWN), Rated)


@machine_code(NOTHING(TWO, ONE, REAL, ONE))
def _place(vectors, share, drop, at):
    """Writes the position (3,) m that is shares (c,) of vectors (c, 3) less a drop, m."""
    for axis in range(3):
        at[axis] = -drop if axis == 2 else 0.0
        for c in range(len(share)):
            at[axis] += share[c] * vectors[c, axis]


@machine_code(NOTHING(TWO, ONE, TWO))
def _spread(covariance, share, spread):
    """Writes the covariance (3, 3) m^2 of a position that is shares (c,) of vectors."""
    spread[:] = 0.0
    for c in range(len(share)):
        for d in range(len(share)):
            for a in range(3):
                for b in range(3):
                    spread[a, b] += share[c] * covariance[3 * c + a, 3 * d + b] * share[d]


@machine_code(REAL(VIEWED, ROW, ONE, ONE, TWO))
def _see(view, row, place, pixels, slope):
    """Writes where the camera, as it saw a row, sees a place (3,) m, pixels (2,), and their slopes by it (2, 3).

    Returns: m, how far before the camera it is, at least `NEAREST`.
    """
    at = np.empty(3)
    for r in range(3):
        at[r] = row.tvec[r]
        for a in range(3):
            at[r] += view.rotation[r, a] * place[a]
    depth = max(at[2], NEAREST)
    for r in range(2):
        seen = at[r] / depth
        pixels[r] = view.focal * seen + view.middle[r]
        for a in range(3):
            slope[r, a] = view.focal * (view.rotation[r, a] - seen * view.rotation[2, a]) / depth
    return depth


@machine_code(REAL(RAYS, CANDIDATES, SCENE, VIEWED, COUNTS, ONE, COUNT, FLOWN))
def _gain(rays, candidates, scene, view, rows, times, bounces, path):
    """Logarithm of how much likelier candidates (n,) of a path are a ball than clutter, by number, bars and sizes.

    Their distances from the path count in its misfit.
    """
    gain, half = 0.0, 0.5 * SHORT * view.step
    share, at, slope, ends = np.empty(len(path.vectors)), np.empty(3), np.empty((2, 3)), np.empty((2, 2))
    for row in rows:
        depth = 0.0
        for end in range(2):
            moment = rays[row].time + (half if end else -half)
            drop = share_at(moment, times, bounces, path.drag, scene.gravity, share)
            _place(path.vectors, share, drop, at)
            depth += 0.5 * _see(view, candidates[row], at, ends[end], slope)
        one, long = candidates[row], view.exposure / SHORT
        x, y = long * (ends[1, 0] - ends[0, 0]), long * (ends[1, 1] - ends[0, 1])
        gain += one.spot + bar_gain(one.bar[0], one.bar[1], x, y, one.usual)
        gain += size_gain(one.size[0], one.size[1], math.log(view.focal * view.ball / depth), one.common)
    passed = candidates[rows[-1]].frame - candidates[rows[0]].frame + 1 - len(rows)
    return gain + passed * math.log(1.0 - view.seen)


@machine_code(REAL(SCENE, VIEWED, ONE, COUNT, FLOWN))
def halves(scene, view, times, bounces, path):
    """Logarithm of what the halves of the court cost on which a path bounces, as well as these are known."""
    if math.isnan(view.net):
        return 0.0
    cost, share, at, spread = 0.0, np.empty(len(path.vectors)), np.empty(3), np.empty((3, 3))
    for bounce in range(bounces):
        drop = share_at(times[bounce], times, bounces, path.drag, scene.gravity, share)
        _place(path.vectors, share, drop, at)
        _spread(path.covariance, share, spread)
        ahead = (at[0] - view.net) * np.sign(path.vectors[1, 0])
        if bounce < bounces - 1:  # a service bounces on the server's half first
            ahead = -ahead
        right = 0.5 * math.erfc(-ahead / math.sqrt(2.0 * spread[0, 0]))
        cost -= math.log(right + math.exp(-OTHER_HALF) * (1.0 - right))
    return cost


@machine_code(RATED(RAYS, CANDIDATES, SCENE, VIEWED, COUNTS, ONE))
def rated(rays, candidates, scene, view, rows, bounces):
    """The stroke through some candidates (n,) with bounces at times (b,) s."""
    middle, count = len(rows) // 2, len(bounces)
    anchor = 0.5 * (rays[rows[middle]].time + rays[rows[len(rows) - 1 - middle]].time)
    times = bounces if count else np.full(1, anchor)
    path = flown(rays, rows, scene, times, count, True)
    price = BOUNCE * count + (UNBOUNCED if count != 1 else 0.0) - path.narrowed
    gain = _gain(rays, candidates, scene, view, rows, times, count, path)
    return Rated(gain - 0.5 * path.misfit - price - halves(scene, view, times, count, path), times, path)


@machine_code(NOTHING(RAYS, CANDIDATES, SCENE, VIEWED, INDEX, TWO, THREE, TWO, THREE))
def all_rated(rays, candidates, scene, view, rows, numbers, vectors, drag, covariance):
    """`rated` without bounces for (k, n) candidates. Writes: numbers (k, 4), score, anchor, misfit, narrowed; paths."""
    none = np.empty(0)
    for k in range(len(rows)):
        one = rated(rays, candidates, scene, view, rows[k], none)
        numbers[k, 0], numbers[k, 1] = one.score, one.times[0]
        numbers[k, 2], numbers[k, 3] = one.path.misfit, one.path.narrowed
        vectors[k], drag[k], covariance[k] = one.path.vectors, one.path.drag, one.path.covariance


@machine_code(NOTHING(SCENE, VIEWED, ROW, RATED, REAL, ONE, TWO))
def _foretell(scene, view, row, stroke, moment, pixels, spread):
    """Where a stroke is seen at a moment, s, as a row was. Writes: pixels (2,), their covariance (2, 2)."""
    path, count = stroke.path, len(stroke.path.drag) - 1
    share, at, slope, wide = np.empty(len(path.vectors)), np.empty(3), np.empty((2, 3)), np.empty((3, 3))
    drop = share_at(moment, stroke.times, count, path.drag, scene.gravity, share)
    _place(path.vectors, share, drop, at)
    _see(view, row, at, pixels, slope)
    _spread(path.covariance, share, wide)
    spread[:] = 0.0
    for r in range(2):
        for q in range(2):
            for a in range(3):
                for b in range(3):
                    spread[r, q] += slope[r, a] * wide[a, b] * slope[q, b]


@machine_code(COUNTS(RAYS, CANDIDATES, SCENE, VIEWED, several(COUNT, 2), COUNTS, RATED))
def _met(rays, candidates, scene, view, here, rows, stroke):
    """The rows (n + 1,) of a stroke with the nearest candidate of a picture, rows here[0] to here[1]; (0,) if none."""
    first, end = here
    if first == end:
        return np.empty(0, dtype=np.int64)
    pixels, spread, moment = np.empty(2), np.empty((2, 2)), math.nan
    best, nearest = -1, GATE
    for row in range(first, end):
        if rays[row].time != moment:  # a rolling shutter sees each row at a time of its own
            moment = rays[row].time
            _foretell(scene, view, candidates[row], stroke, moment, pixels, spread)
        one = candidates[row]
        x, y = one.pixels[0] - pixels[0], one.pixels[1] - pixels[1]
        xx, yy = one.covariance[0, 0] + spread[0, 0], one.covariance[1, 1] + spread[1, 1]
        xy = one.covariance[0, 1] + spread[0, 1]
        off = (yy * x * x - 2.0 * xy * x * y + xx * y * y) / (xx * yy - xy * xy)
        if off < nearest:
            best, nearest = row, off
    return np.sort(np.append(rows, best)) if best >= 0 else np.empty(0, dtype=np.int64)


@machine_code(several(COUNTS, 2)(RAYS, CANDIDATES, COUNTS, SCENE, VIEWED, COUNTS, ONE, COUNT))
def grown(rays, candidates, begins, scene, view, rows, bounces, way):
    """The candidates of a stroke with further ones after it (way 1) or before it (-1), while they make it likelier.

    The second ones go on with doubtful candidates, to where they are best: few candidates leave a path so wide that one
    more hardly counts, but the next ones do. The less often the ball is seen, the more doubt is allowed.

    Args: begins: (f + 1,) where the candidates of each picture begin.
    """
    missed, frame, unseen = 0, candidates[rows[-1 if way > 0 else 0]].frame, math.log(1.0 - view.seen)
    stroke = rated(rays, candidates, scene, view, rows, bounces)
    careful, best, top, doubtful = rows, rows, stroke.score, False
    most = max(MISSED, int(LOST / view.step), int(math.log(RARE) / unseen))
    while missed <= most:
        frame += way
        if not 0 <= frame < len(begins) - 1:
            break
        missed += 1
        more = _met(rays, candidates, scene, view, (begins[frame], begins[frame + 1]), rows, stroke)
        if not len(more):
            continue
        longer = rated(rays, candidates, scene, view, more, bounces)
        if longer.score <= stroke.score + missed * unseen:
            continue
        doubtful = doubtful or longer.score <= stroke.score
        missed, stroke, rows = 0, longer, more
        if stroke.score > top:
            best, top = rows, stroke.score
        if not doubtful:
            careful = rows
    return careful, best


@machine_code(COUNTS(RAYS, CANDIDATES, COUNTS, SCENE, VIEWED, COUNTS, ONE))
def filled(rays, candidates, begins, scene, view, rows, bounces):
    """The candidates of a stroke with those between its own that make it likelier."""
    first, last = candidates[rows[0]].frame, candidates[rows[-1]].frame
    taken = np.zeros(last - first + 1, dtype=np.bool_)
    for row in rows:
        taken[candidates[row].frame - first] = True
    stroke = rated(rays, candidates, scene, view, rows, bounces)
    for frame in range(first, last):
        if taken[frame - first]:
            continue
        more = _met(rays, candidates, scene, view, (begins[frame], begins[frame + 1]), rows, stroke)
        if len(more):
            longer = rated(rays, candidates, scene, view, more, bounces)
            if longer.score > stroke.score:
                stroke, rows = longer, more
    return rows
