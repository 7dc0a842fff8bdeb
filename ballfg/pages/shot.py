"""A shot holds samples, states, predictions, contacts and hits of one track for drawing."""

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.pages.sight import Sight
from ballfg.state import CORRELATIONS, POSITION, STANDARD_GRAVITY, VELOCITY, VZ, Z

NEAR = 0.05
"""m. A falling ball that would come this near to a surface before it rises again has met it; states err by less."""
LARGEST_ACCELERATION = 150.0
"""m/s^2. Air and gravity change a velocity less than this: drag of a table-tennis ball at 25 m/s is 80 m/s^2."""
SUDDEN = 1.5
"""m/s. A smaller jump is not taken for a hit: velocities err, and bounces change them at the edge of a step."""
FLIGHT, LOST = "flight", "lost"
"""Labels of the states that are drawn as the estimate; the others are drawn by what the ball does."""
GAP = 0.1  # s. During a longer step the motion is unknown: the ball may have bounced several times.


@dataclass(frozen=True)
class Mark:
    """A contact or a hit. `kind`: "contact" or "hit".  `time`: s.  `place`: (3,) m, approximate place of the ball."""

    kind: str
    time: float
    place: tuple[float, float, float]


def marks(
    times: Array, states: Array, surfaces: Sequence[float], radius: float, flying: Sequence[bool] | None = None
) -> Iterator[Mark]:
    """Contacts and hits between the states of a track.

    A contact is a turn of the vertical velocity from down to up near a surface, a hit is a jump of the velocity beyond
    air, gravity or a contact. Steps of more than `GAP` have none.

    Args: times: (m,) s.  states: (m, 9).  surfaces: m, heights of table and floor.  radius: m, of the ball.
        flying: (m,) False where it is held, rolls or rests; None if it always flies.
    """
    for i, step in enumerate(np.diff(times)):
        if step > GAP or (flying is not None and not all(flying[i : i + 2])):
            continue
        before, after = states[i], states[i + 1]
        contact = _contact(before, after, float(step), surfaces, radius)
        if contact is not None:
            yield _mark("contact", float(times[i]), before, contact)
            continue
        jump = float(np.linalg.norm(after[VELOCITY] - before[VELOCITY]))
        if jump > SUDDEN + LARGEST_ACCELERATION * step:
            yield _mark("hit", float(times[i]), before, 0.5 * float(step))


def _contact(before: Array, after: Array, step: float, surfaces: Sequence[float], radius: float) -> float | None:
    """Seconds from the first of two states to a contact with a surface; None without a contact."""
    if not before[VZ] < 0.0 < after[VZ]:
        return None
    for surface in surfaces:
        level = surface + radius
        fall = float(before[Z]) - level
        reached = fall + float(before[VZ]) * step - 0.5 * STANDARD_GRAVITY * step**2
        if abs(fall) < NEAR or (fall > 0.0 and reached < NEAR):
            falling = math.sqrt(float(before[VZ]) ** 2 + 2.0 * STANDARD_GRAVITY * max(fall, 0.0))
            return min((falling + float(before[VZ])) / STANDARD_GRAVITY, step)
    return None


def _mark(kind: str, time: float, before: Array, later: float) -> Mark:
    x, y, z = (before[POSITION] + later * before[VELOCITY]).tolist()
    return Mark(kind, time + later, (x, y, z - 0.5 * STANDARD_GRAVITY * later**2))


@dataclass(frozen=True, eq=False)
class ShownShot:
    """The contents of one track's drawing; arrays without rows stand for missing ones."""

    name: str  # of the track
    times: Array = field(default_factory=lambda: np.zeros(0))  # (n,) s, stamps of the samples
    positions: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (n, 3) m, as measured
    noise: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(n, 3) m, standard deviation of each measured coordinate; NaN if unknown."""
    state_times: Array = field(default_factory=lambda: np.zeros(0))  # (m,) s
    states: Array = field(default_factory=lambda: np.zeros((0, 9)))  # (m, 9) position m, velocity m/s, spin rad/s
    state_sigmas: Array = field(default_factory=lambda: np.zeros((0, 9)))  # (m, 9) in the same units
    predicted_times: Array = field(default_factory=lambda: np.zeros(0))  # (k,) s
    predicted: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (k, 3) m
    predicted_sigmas: Array = field(default_factory=lambda: np.zeros((0, 3)))  # (k, 3) m, of a measured position
    marks: tuple[Mark, ...] = ()  # contacts and hits in the states
    labels: NDArray[np.str_] = field(default_factory=lambda: np.zeros(0, np.str_))
    """(m,) what the ball does at each state; empty if unknown."""
    correlations: Array = field(default_factory=lambda: np.zeros((0, 3)))
    """(m, 3) of the states' x and y, x and z, y and z; empty if unknown: then they are taken as 0."""
    sight: Sight | None = None  # how cameras saw the ball; None for measured positions
    flights: Index = field(default_factory=lambda: np.zeros(0, np.int64))
    """(k,) number of the flight that each prediction is of; empty: all are of one."""

    @property
    def flying(self) -> list[bool] | None:
        """(m,) True at states of flight, a lost sample within it included; None without labels."""
        return [label in (FLIGHT, LOST) for label in self.labels.tolist()] if len(self.labels) else None

    @property
    def start(self) -> float:
        """s, the first stamp of all."""
        return float(min(t[0] for t in (self.times, self.state_times, self.predicted_times) if len(t)))

    @property
    def rows(self) -> int:
        """Number of samples, states and predictions."""
        return len(self.times) + len(self.state_times) + len(self.predicted_times)

    @property
    def lines(self) -> list[tuple[str, Array, Array, Array]]:
        """Name, stamps (k,) s, places (k, 3) m and covariances (k, 3, 3) m^2 of the estimate and of the prediction.

        Where the ball does not fly, and in one more row in each step of more than `gap`, they are NaN: not drawn.
        """
        estimated = covariances(self.state_sigmas[:, :3], self.correlations)
        predicted = covariances(self.predicted_sigmas)
        flies = np.full(len(self.states), True) if self.flying is None else np.array(self.flying)
        places = np.where(flies[:, None], self.states[:, :3], np.nan)
        return [
            ("estimate", *self.broken(self.state_times, places, estimated)),
            ("prediction", *self.broken(self.predicted_times, self.predicted, predicted)),
        ]

    @property
    def gap(self) -> float:
        """In s; paths are not drawn over longer steps: `GAP`, or more where most steps are long."""
        steps = [np.diff(times) for times in (self.times, self.state_times, self.predicted_times)]
        return max(GAP, *(2.0 * float(np.median(one)) for one in steps if len(one)), 0.0)

    def broken(self, times: Array, places: Array, spread: Array) -> tuple[Array, Array, Array]:
        """Stamps (k,) s and rows (k, ...) at them, with one more row of NaN in each step of more than `gap`."""
        after = np.flatnonzero(np.diff(times) > self.gap) + 1
        cut, wide = (np.insert(rows, after, np.nan, axis=0) for rows in (places, spread))
        return np.insert(times, after, np.nan), cut, wide

    @property
    def on_rays(self) -> "ShownShot":
        """The shot with what stands for measured positions of a ball that one camera saw; itself for other balls."""
        if self.sight is None or not self.sight.one_view:
            return self
        known = _at(self.times, self.state_times, self.states[:, :3])
        positions, noise = self.sight.measured(np.where(np.isfinite(known), known, self.positions))
        return replace(self, positions=positions, noise=noise)

    def residuals(self) -> Array:
        """(n, 3) m, measured less estimated; NaN without a state, and where the state is the measured position."""
        found = self.positions - _at(self.times, self.state_times, self.states[:, :3])
        found[(found == 0.0).all(axis=1)] = np.nan  # of a held ball, for instance: nothing was estimated there
        return found

    def prediction_errors(self) -> Array:
        """(k, 3) m, measured less predicted; NaN without a measurement."""
        return _at(self.predicted_times, self.times, self.positions) - self.predicted

    def horizons(self) -> Array:
        """(k,) s from the last observed sample of each prediction's flight; NaN where none is before it."""
        found, flights = np.full(len(self.predicted_times), np.nan), self.flights
        for flight in np.unique(flights).tolist() or [0]:
            own = flights == flight if len(flights) else np.full(len(found), True)
            if own.any() and len(before := self.times[self.times < self.predicted_times[own].min()]):
                found[own] = self.predicted_times[own] - before[-1]
        return found


def unbroken(places: Array) -> list[slice]:
    """The runs of two or more known rows of a path (n, 3) m or (n, 2) m between rows of NaN."""
    known = np.isfinite(places).all(axis=1)
    ends = np.flatnonzero(np.diff(known, prepend=False, append=False)).reshape(-1, 2).tolist()
    return [slice(first, end) for first, end in ends if end - first > 1]


def covariances(sigmas: Array, correlations: Array | None = None) -> Array:
    """(k, 3, 3) m^2 of standard deviations (k, 3) m and correlations (k, 3) of x and y, x and z, y and z.

    Without correlations, or with none, the coordinates are independent.
    """
    found = sigmas[:, :, None] * sigmas[:, None, :]
    rho = np.zeros(sigmas.shape) if correlations is None or not len(correlations) else correlations
    for number, (i, j) in enumerate(CORRELATIONS.values()):
        share = rho[:, number]
        found[:, i, j] *= share
        found[:, j, i] *= share
    return np.asarray(found)


def _at(times: Array, known: Array, values: Array) -> Array:
    """Rows (m, 3) of the known stamps (m,) at times (n,); NaN at other times."""
    found = np.full((len(times), 3), np.nan)
    if len(known):
        i = np.clip(np.searchsorted(known, times - SAME_STAMP), 0, len(known) - 1)
        same = np.abs(known[i] - times) <= SAME_STAMP
        found[same] = values[i[same]]
    return found


SAME_STAMP = 1e-9  # s. Tables keep all digits of a stamp, so that those of one sample agree far better.


LEVEL = 0.9  # Nominal coverage of an interval
HALF_WIDTH = NormalDist().inv_cdf((1.0 + LEVEL) / 2.0)
"""Standard deviations on either side of a prediction for that coverage."""
BIN = 0.05  # s, width of the bins of the horizon


@dataclass(frozen=True)
class Coverage:
    """Shares by horizon, the time since the last sample before the first predicted one of a flight."""

    horizons: Array  # (b,) s, the middle of each bin that holds samples
    shares: Array  # (b, 3) of the coordinates x, y, z inside their intervals, 0 to 1
    samples: Index  # (b,) counts
    shots: Index  # (b,) counts


def coverage(shots: Iterable[ShownShot]) -> Coverage:
    """The coverage of the predictions of many shots.

    Args: shots: with samples and predictions; samples outside of the predicted part are left out.
    """
    inside, bins, first = [np.zeros((0, 3), dtype=bool)], [np.zeros(0, np.int64)], [np.zeros(0, np.int64)]
    for shot in shots:
        errors, ahead = np.abs(shot.prediction_errors()), shot.horizons()
        known = np.isfinite(errors).all(axis=1) & np.isfinite(ahead) & ~np.isnan(shot.predicted_sigmas).any(axis=1)
        inside.append(errors[known] <= HALF_WIDTH * shot.predicted_sigmas[known])
        bins.append(np.floor((ahead[known] + SAME_STAMP) / BIN).astype(np.int64))
        first.append(np.unique(bins[-1]))
    order, place, counts = np.unique(np.concatenate(bins), return_inverse=True, return_counts=True)
    sums = np.zeros((len(order), 3))
    np.add.at(sums, place, np.concatenate(inside))
    tracks = np.bincount(np.searchsorted(order, np.concatenate(first)), minlength=len(order))
    return Coverage(np.asarray((order + 0.5) * BIN), sums / counts[:, None], counts, tracks)
