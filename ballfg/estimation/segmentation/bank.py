"""Records of machine code for hypotheses, events, surfaces and a scene, and the evidence of a sample for hypotheses."""

import math
from dataclasses import fields
from typing import Any, Final, NamedTuple, TypeAlias

import numpy as np
from numba import from_dtype, types
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.dynamics.compiled.build import machine_code
from ballfg.dynamics.compiled.flight import white_acceleration
from ballfg.dynamics.compiled.signatures import COUNT, COUNTS, NOTHING, ONE, REAL
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import OUTLIER, WIDE
from ballfg.estimation.segmentation.settings import SegmentationSettings

FLYING: Final = -1
"""Value of `surface` for a ball in the air."""

NO_EVENT: Final = -(2**62)
"""The `tip` of a hypothesis without events."""

HYPOTHESIS: Final = np.dtype(
    [
        ("mean", np.float64, (3, 3)),
        ("cov", np.float64, (3, 3, 3)),
        ("shift", np.float64, (3,)),
        ("score", np.float64),
        ("surface", np.int64),
        ("age", np.int64),
        ("tip", np.int64),
    ]
)
"""One explanation of the past. The axes x, y, z are filtered independently; (p, v, b) are position, velocity, slack.

- mean: axis by (p m, v m/s, b m/s^2).  cov: axis by covariance of (p, v, b).
- shift: m, assumed offset of the tracker; `mean` is the measured motion, and surfaces are offset likewise.
- score: nats, log evidence less the prices of events, apart from a constant per sample.
- surface: index of the surface on which the ball rests, or `FLYING`.
- age: samples used since the last event.
- tip: its last event: the row of a log, or `NO_EVENT`.
"""

LOGGED: Final = np.dtype(
    [
        ("kind", np.int64),
        ("index", np.int64),
        ("surface", np.int64),
        ("before", np.int64),
        ("serial", np.int64),
        ("time", np.float64),
        ("offset", np.float64, (3,)),
    ]
)
"""An event of some hypotheses.

- kind: value of an `EventKind`.  index: the interval, or the sample.  surface: its index, -1 without one.
- before: the previous event, as the `tip` of a hypothesis.  time: s.  offset: m, of a shift.
- serial: its number in the whole stream, which it keeps when the log is compacted.
"""

SURFACE: Final = np.dtype([("centre", np.float64), ("restitution_sigma", np.float64)])
"""A surface: m, height of the ball's centre when it touches; spread of the restitution. The table comes first."""

Records: TypeAlias = NDArray[np.void]
"""Rows of one of these types."""
Record: TypeAlias = Any
"""One row; its fields are attributes in machine code. A row does not keep its array alive: functions that may hold the
last reference to an array pass the array and the number of the row."""

BANK: Final[Any] = from_dtype(HYPOTHESIS)[::1]
ONE_HYPOTHESIS: Final[Any] = from_dtype(HYPOTHESIS)
LOG: Final[Any] = from_dtype(LOGGED)[::1]
SURFACES: Final[Any] = from_dtype(SURFACE)[::1]

USED, WRITTEN = range(2)
"""Indices in the `fill` of a bank and its log: number of used rows of each."""


class Work(NamedTuple):
    """Hypotheses that become more during a sample, the events that they pass through, how many there are of each."""

    bank: Records
    log: Records
    fill: Index


class Sample(NamedTuple):
    """What is measured: position (3,) m, its noise sigma (3,) m, number of the sample, and its stamp, s."""

    position: Array
    sigma: Array
    number: int
    time: float


WORK: Final[Any] = types.NamedTuple((BANK, LOG, COUNTS), Work)
SAMPLE: Final[Any] = types.NamedTuple((ONE, ONE, COUNT, REAL), Sample)


@machine_code(COUNT(WORK, BANK, COUNT))
def add(work: Work, source: Records, place: int) -> int:
    """Puts a copy of one hypothesis of `source` behind the others of a bank; returns its row."""
    row = work.fill[USED]
    work.bank[row] = source[place]
    work.fill[USED] += 1
    return row


@machine_code(NOTHING(ONE_HYPOTHESIS, WORK, COUNT, COUNT, COUNT, REAL))
def pass_through(h: Record, work: Work, kind: int, index: int, surface: int, time: float) -> None:
    """Lets a hypothesis pass through an event, which is written to the log; arguments as in `LOGGED`."""
    row = work.fill[WRITTEN]
    work.fill[WRITTEN] += 1
    event = work.log[row]
    event.kind, event.index, event.surface, event.before, event.time = kind, index, surface, h.tip, time
    for axis in range(3):
        event.offset[axis] = 0.0
    h.tip = row


NUMBERS: Final = np.dtype(
    [
        *((one.name, np.float64) for one in (*fields(SegmentationPhysics), *fields(SegmentationSettings))),
        ("log_shares", np.float64, (3,)),
        ("drift", np.float64, (3, 2, 2)),
        ("extent", np.float64, (4,)),
    ]
)
"""The fields of `SegmentationPhysics` and of `SegmentationSettings` in their units, and derived numbers.

- log_shares: log prior of good, wide and outlying samples.  drift: process noise of (p, v) per dt, dt^2, dt^3.
- extent: m, (x low, x high, y low, y high) within which a contact with the table is tried.
"""
SCENE: Final[Any] = from_dtype(NUMBERS)


class Scene:
    """Ball, surfaces and settings for machine code: `numbers`, a row of `NUMBERS`; `rows` of `SURFACE`, table first."""

    def __init__(self, physics: SegmentationPhysics, surfaces: Surfaces, settings: SegmentationSettings) -> None:
        self.surfaces, self.settings, self.physics = surfaces, settings, physics
        s, drift = settings, np.zeros((3, 2, 2))
        drift[2, 0, 0], drift[1, 0, 1], drift[0, 1, 1] = white_acceleration(1.0, s.velocity_drift**2)
        drift[1, 1, 0] = drift[1, 0, 1]
        shares = np.log([1.0 - s.wide_share - s.outlier_share, s.wide_share, s.outlier_share])
        extent = np.array((-np.inf, np.inf, -np.inf, np.inf) if surfaces.extent is None else surfaces.extent)
        extent += s.extent_margin * np.array((-1.0, 1.0, -1.0, 1.0))
        own = (*vars(physics).values(), *vars(s).values())  # in the order of `fields`
        self.numbers: Record = np.array([(*own, shares, drift, extent)], dtype=NUMBERS)[0]
        heights = np.array(surfaces.heights())
        self.rows: Records = np.zeros(len(heights), dtype=SURFACE)
        self.rows["centre"] = heights + physics.surface_offset + physics.radius
        self.rows["restitution_sigma"] = s.floor_restitution_sigma
        self.rows["restitution_sigma"][:1] = s.restitution_sigma

    def height(self, surface: int) -> float | None:
        """m, declared height of a surface; None for -1."""
        return None if surface < 0 else self.surfaces.heights()[surface]


AS_GOOD, AS_WIDE, AS_OUTLIER = range(3)
"""The components of the noise, as in a scene's `log_shares`."""
SURPRISE: Final = 3
"""Index after the evidences of the components: squared whitened innovation of a good sample."""


@machine_code(REAL(WORK, COUNT, SAMPLE, SCENE))
def update(work: Work, first: int, sample: Sample, scene: Record) -> float:
    """Takes a sample into every hypothesis from row `first` on: its noise component, the Kalman update, the evidence.

    If the prediction is too uncertain to decide, the sample is also tried as an outlier: those hypotheses come last.
    This happens where the ball's place is hardly known: at its second sample, and at the first ones after a hit or a
    gap. Explanations that are far behind already are not multiplied.

    Returns: squared whitened innovation, as of a good sample, of the hypothesis that is the best afterwards.
    """
    bank, n, best, surprise = work.bank, work.fill[USED], -math.inf, 0.0
    position, sigma, evidence = sample.position, sample.sigma, np.empty((n - first, 4))
    for row in range(first, n):
        said = evidence[row - first]
        weigh(bank[row], position, sigma, scene, said)
        for component in range(3):
            if bank[row].score + said[component] > best:
                best, surprise = bank[row].score + said[component], said[SURPRISE]
    for row in range(first, n):
        said = evidence[row - first]
        component = AS_GOOD
        for other in (AS_WIDE, AS_OUTLIER):
            component = other if said[other] > said[component] else component
        margin = said[component] - said[AS_OUTLIER]
        apart = 0.0 < margin < scene.outlier_doubt
        if apart and bank[row].score + said[AS_OUTLIER] > best - scene.doubt_margin:
            lost = bank[add(work, bank, row)]
            lost.score += said[AS_OUTLIER]
            pass_through(lost, work, OUTLIER, sample.number, -1, sample.time)
        _take_in(bank[row], position, sigma, component, scene)
        bank[row].score += said[component]
        if component != AS_GOOD:
            kind = WIDE if component == AS_WIDE else OUTLIER
            pass_through(bank[row], work, kind, sample.number, -1, sample.time)
    return surprise


@machine_code(REAL(REAL, REAL, REAL, COUNT, SCENE))
def _variance(known: float, speed: float, sigma: float, component: int, scene: Record) -> float:
    """m^2, of the innovation of one coordinate, for a sample of a component.

    Args: known: m^2, of the coordinate before the sample.  speed: m/s, along it.  sigma: m, of the sample.
    """
    if component == AS_OUTLIER:
        return known + scene.outlier_spread**2
    noise = (scene.stamp_jitter * speed) ** 2 + sigma**2
    return known + (noise * scene.wide_factor**2 if component == AS_WIDE else noise)


@machine_code(NOTHING(ONE_HYPOTHESIS, ONE, ONE, SCENE, ONE))
def weigh(h: Record, position: Array, sigma: Array, scene: Record, said: Array) -> None:
    """Writes a sample's evidence: (4,) nats, less 3/2 log 2 pi, if good, wide, outlier; and the squared innovation."""
    mean, cov, shares = h.mean, h.cov, scene.log_shares  # once: numba counts who holds them, which takes longer
    for component in range(3):
        volume, distance = 1.0, 0.0
        for axis in range(3):
            off = position[axis] - mean[axis, 0]
            spread = _variance(cov[axis, 0, 0], mean[axis, 1], sigma[axis], component, scene)
            volume *= spread
            distance += off * off / spread
        said[component] = shares[component] - 0.5 * (distance + math.log(volume))
        if component == AS_GOOD:
            said[SURPRISE] = distance


@machine_code(NOTHING(ONE_HYPOTHESIS, ONE, ONE, COUNT, SCENE))
def _take_in(h: Record, position: Array, sigma: Array, component: int, scene: Record) -> None:
    """The Kalman update with a sample of a component; an outlier changes nothing."""
    if component == AS_OUTLIER:
        return
    h.age += 1
    mean, cov = h.mean, h.cov
    for axis in range(3):
        spread = _variance(cov[axis, 0, 0], mean[axis, 1], sigma[axis], component, scene)
        off = position[axis] - mean[axis, 0]
        gain = (cov[axis, 0, 0] / spread, cov[axis, 1, 0] / spread, cov[axis, 2, 0] / spread)
        first = (cov[axis, 0, 0], cov[axis, 0, 1], cov[axis, 0, 2])
        for i in range(3):
            mean[axis, i] += gain[i] * off
            for k in range(3):
                cov[axis, i, k] -= gain[i] * first[k]


@machine_code(NOTHING(BANK, COUNT, COUNT, COUNTS))
def rank(bank: Records, first: int, stop: int, rows: Index) -> None:
    """Writes the rows first..stop - 1 of a bank, best first; equal ones in their order."""
    for row in range(first, stop):  # sorted as they come: few hypotheses, most of them in order
        place = row - first
        while place > 0 and bank[rows[place - 1]].score < bank[row].score:
            rows[place] = rows[place - 1]
            place -= 1
        rows[place] = row


@machine_code(BANK(BANK, COUNT, SCENE))
def prune(bank: Records, n: int, scene: Record) -> Any:
    """Selects the likely ones of the first n hypotheses, best first, and accepts a tracker shift that has lasted long.

    Hypotheses in the same mode whose last event is old have the same predictions, so the best of them represents all
    (the Viterbi step).
    """
    rows = np.empty(n, np.int64)
    rank(bank, 0, n, rows)
    most, count = int(scene.most), 0
    kept = np.empty(min(n, most), bank.dtype)
    least = bank[rows[0]].score - scene.margin
    for place in range(n):
        h = bank[rows[place]]
        if not h.score >= least or count >= most:
            break
        old, twin = h.age >= scene.mature, False
        if old:
            for earlier in range(count):
                other = kept[earlier]
                twin = twin or (other.age >= scene.mature and other.surface == h.surface)
        if twin:
            continue
        kept[count] = h
        if old:
            for axis in range(3):
                kept[count].shift[axis] = 0.0
        count += 1
    return kept[:count]
