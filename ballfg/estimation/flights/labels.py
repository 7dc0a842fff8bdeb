"""Labels the samples of a track: flight, held, rolling, resting or lost.

Tracks that fall throughout, which a quick test of their accelerations tells, are flight without any further search.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from typing import Final

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.flights.decode import decode
from ballfg.estimation.flights.modes import BOUNCE, CHANGE, HANDLED, ROLLING, STILL, STRIKE, SWAYED
from ballfg.estimation.result import Label
from ballfg.estimation.segmentation.bank import FLYING, Scene
from ballfg.estimation.segmentation.physics import SegmentationPhysics
from ballfg.estimation.segmentation.result import OUTLIER
from ballfg.estimation.segmentation.settings import SegmentationSettings
from ballfg.tracks import Track

FEWEST: Final = 5  # Least number of samples for labels
SHORTEST: Final = 5  # Least number of samples of a flight that is used: fewer show no velocity
LEAST_SIGMA: Final = 1.5e-3
"""m. Least standard deviation of a sample: slow errors of trackers do not show in the scatter."""
MERGED: Final = 0.15  # s since its last event after which a hypothesis merges with others of its mode
LEAST_MERGED: Final = 12  # Samples, likewise, at least
MOST: Final = 400  # Largest number of hypotheses
MARGIN: Final = 25.0  # nats. Hypotheses this far behind the best are dropped
ANY_BALL: Final = SegmentationSettings(air_growth=1.25)
"""Of flights whose ball may not be the declared one: its drag is off by as much as lift may be."""
GAP: Final = ANY_BALL.short_gap  # s. Over a longer one a flight may bounce unseen: each side by itself
ROLLED: Final = 0.03  # m. A ball that gets less far does not roll
ALIKE: Final = 0.03  # m. Places within this height of each other are on one surface
HANDS: Final = 30.0  # nats, by which hands must explain a recording better than flights, strikes and bounces alone
CALM: Final = 0.3  # Share of the samples that show the noise: others are near bounces, throws and catches
CALM_QUANTILE: Final = 0.3853  # Its quantile of the absolute value of a standard normal variable
WINDOW: Final = 0.12  # s, of the fit of an acceleration
LEAST_WINDOW: Final = 5  # Samples, likewise, at least
MOST_OFF: Final = 20.0
"""Squared whitened distance of an acceleration from that of a ball, of 3 degrees of freedom: one in 6,000 is larger."""
CLEARLY: Final = 3.0  # Multiple of that distance at which a ball at rest would have to stand for a window to tell
BESIDE: Final = 0.04
"""s. Windows with a bounce or a hit do not fall, for the length of a window and this; longer means something else."""
AT_END: Final = 0.05  # s, likewise where a track begins or ends
BLOCK: Final = 20_000  # Samples that are looked at together; memory grows with it


@dataclass(frozen=True, eq=False)
class Labels:
    """The labels of a track of n samples, and its bounces.

    Attributes:
        values: (n,) values of `Label`.
        bounces: (b,) intervals in which a flying ball bounced on something.
    """

    values: NDArray[np.int8]
    bounces: NDArray[np.int64]

    def estimable(self, heights: Array, levels: Sequence[float]) -> NDArray[np.bool_]:
        """(n,) True for samples of flight, and of rolling or rest on known surfaces: estimators explain them.

        Args: heights: (n,) m, of the samples.  levels: m, heights of the ball's centre on the surfaces.
        """
        down = np.isin(self.values, (Label.ROLLING, Label.RESTING))
        near = np.abs(heights[:, None] - np.array(levels)).min(axis=1, initial=np.inf) < ALIKE
        return np.asarray((self.values != Label.HELD) & (~down | near))

    def stretches(self, label: Label) -> list[tuple[int, int]]:
        """First and last sample, inclusive, of each run of a label; lost samples within a run belong to it."""
        kept = np.flatnonzero(self.values != Label.LOST)
        ends = np.flatnonzero(np.diff(self.values[kept], prepend=-1, append=-1))
        runs = [(int(kept[a]), int(kept[b - 1])) for a, b in pairwise(ends.tolist())]
        return [run for run in runs if self.values[run[0]] == label]


def label_samples(track: Track, physics: SegmentationPhysics, levels: Sequence[float] = ()) -> Labels:
    """Labels each sample of a track.

    Positions that were computed from cameras, or seen by one, are taken for flight throughout.

    Args: track: of any length.  physics: of the ball.  levels: m, heights at which the ball is known to lie.
    Source: docs/derivations/segmentation.md.
    """
    times, positions, n = track.seconds, track.positions, len(track)
    values, bounces = np.zeros(n, np.int8), list[int]()
    if track.rough or track.one_view or n < FEWEST:
        return Labels(values, np.zeros(0, np.int64))
    sigmas = np.maximum(np.tile(scatter(times, positions), (n, 1)), LEAST_SIGMA)
    edges = [0, *(np.flatnonzero(np.diff(times) > GAP) + 1).tolist(), n]
    for first, stop in pairwise(edges):
        part = slice(first, stop)
        if not falls_throughout(times[part], positions[part], sigmas[0], physics):
            found = _explained(times[part], positions[part], sigmas[part], physics, levels)
            values[part] = found.values
            bounces += (found.bounces + first).tolist()
    return Labels(values, np.array(bounces, dtype=np.int64))


def _explained(
    times: Array, positions: Array, sigmas: Array, physics: SegmentationPhysics, levels: Sequence[float]
) -> Labels:
    """`label_samples` without gaps."""
    n, step = len(times), float(np.median(np.diff(times))) if len(times) > 1 else 1.0
    settings = replace(ANY_BALL, most=MOST, margin=MARGIN, mature=max(LEAST_MERGED, round(MERGED / step)))
    scene = Scene(physics, Surfaces(0.0), settings)
    given = times - times[0], np.array(positions, order="C"), np.array(sigmas, order="C")
    events, most = decode(*given, True, scene.numbers)
    if ((events["surface"] >= HANDLED) & (events["surface"] <= SWAYED)).any():
        alone, least = decode(*given, False, scene.numbers)
        events = events if most - least >= HANDS else alone
    modes, lost = np.zeros(n, np.int64), np.zeros(n, dtype=bool)
    plain = events[["kind", "index", "surface"]].tolist()
    for kind, index, mode in plain:
        if kind in (CHANGE, STRIKE):
            modes[index + 1 :] = mode
        lost[index] |= kind == OUTLIER
    bounces = np.array([index for kind, index, _ in plain if kind == BOUNCE], dtype=np.int64)
    values = _placed(positions, modes, bounces, levels)
    values[lost] = Label.LOST
    return Labels(values, bounces)


def _placed(
    positions: Array, modes: NDArray[np.int64], bounces: NDArray[np.int64], levels: Sequence[float]
) -> NDArray[np.int8]:
    """Labels by modes: what does not move lies where the ball bounces or rolls, and is held elsewhere."""
    values = np.full(len(modes), Label.HELD, np.int8)
    values[modes == FLYING] = Label.FLIGHT
    ends = [0, *(np.flatnonzero(np.diff(modes)) + 1).tolist(), len(modes)]
    heights = [*levels, *(float(min(positions[i, 2], positions[i + 1, 2])) for i in bounces.tolist())]
    down: list[tuple[int, int]] = []
    for first, stop in pairwise(ends):
        way = float(np.hypot(*(positions[stop - 1, :2] - positions[first, :2])))
        if modes[first] == ROLLING and way > ROLLED:
            values[first:stop] = Label.ROLLING
            heights.append(float(np.median(positions[first:stop, 2])))
        elif modes[first] in (ROLLING, STILL):
            down.append((first, stop))
    for first, stop in down:
        height = float(np.median(positions[first:stop, 2]))
        whole = stop - first == len(modes)
        if whole or any(abs(height - other) < ALIKE for other in heights):
            values[first:stop] = Label.RESTING
    return values


def contrasts(times: Array) -> Array:
    """(n - 4, 5) weights of length one of five neighbours that leave nothing of a cubic; times (n,) s."""
    stamps = sliding_window_view(times, 5)
    apart = stamps[:, :, None] - stamps[:, None, :]
    apart = apart / np.abs(apart).max(axis=(1, 2), keepdims=True) + np.eye(5)
    weights = 1.0 / np.prod(apart, axis=2)
    return np.asarray(weights / np.linalg.norm(weights, axis=1, keepdims=True))


def scatter(times: Array, positions: Array) -> Array:
    """(3,) m, white noise of each coordinate: what cubics through five neighbours leave, of the calmer samples.

    Args: times: (n,) s, n >= 5.  positions: (n, 3) m.
    """
    left = np.abs(np.einsum("ni,nxi->nx", contrasts(times), sliding_window_view(positions, 5, axis=0)))
    return np.asarray(np.quantile(left, CALM, axis=0) / CALM_QUANTILE)


def falls_throughout(times: Array, positions: Array, sigma: Array, physics: SegmentationPhysics) -> bool:
    """True if all of a track falls like a ball, apart from lone bounces and hits: then nothing holds the ball.

    The acceleration of short windows is compared with gravity and drag. False does not say the contrary.

    Args: times: (n,) s.  positions: (n, 3) m.  sigma: (3,) m, white noise.  physics: of the ball.
    """
    if len(times) < LEAST_WINDOW:
        return True
    step = float(np.median(np.diff(times)))
    size = max(LEAST_WINDOW, round(WINDOW / step) + 1)
    if len(times) < size:
        return True
    falling = np.concatenate([*_falling(times, positions, sigma, physics, size)])
    ends = np.flatnonzero(np.diff(falling, prepend=True, append=True))
    for first, stop in ends.reshape(-1, 2):
        at_end = first == 0 or stop == len(falling)
        lasts = times[min(stop, len(falling) - 1)] - times[first]
        if lasts > (AT_END if at_end else WINDOW + BESIDE + 2.0 * step):
            return False
    return True


def _falling(
    times: Array, positions: Array, sigma: Array, physics: SegmentationPhysics, size: int
) -> Iterator[NDArray[np.bool_]]:
    """(n - size + 1,) in blocks: whether each window of `size` samples falls like a ball, and would show if not."""
    for begin in range(0, len(times) - size + 1, BLOCK):
        part = slice(begin, begin + BLOCK + size - 1)
        stamps = sliding_window_view(times[part], size)
        reach = 0.5 * (stamps[:, -1:] - stamps[:, :1])
        scaled = (stamps - stamps.mean(axis=1, keepdims=True)) / reach
        design = np.stack((np.ones_like(scaled), scaled, scaled**2), axis=1)
        unscaled = np.linalg.inv(design @ design.transpose(0, 2, 1))
        fitted = unscaled @ (design @ sliding_window_view(positions[part], size, axis=0).transpose(0, 2, 1))
        velocity, pull = fitted[:, 1] / reach, 2.0 * fitted[:, 2] / reach**2
        speed = np.linalg.norm(velocity, axis=1, keepdims=True)
        noise = 2.0 * np.sqrt(unscaled[:, 2, 2, None]) / reach**2 * sigma
        off = pull + physics.drag * speed * velocity + np.array([0.0, 0.0, physics.gravity])
        spread = noise**2 + (ANY_BALL.still_air + ANY_BALL.air_growth * physics.drag * speed**2) ** 2
        telling = (noise[:, 2] ** 2 + ANY_BALL.still_air**2) * CLEARLY * MOST_OFF < physics.gravity**2
        yield telling & ((off**2 / spread).sum(axis=1) < MOST_OFF)
