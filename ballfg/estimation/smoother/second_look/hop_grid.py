"""Follows the vertical motion of a low-hopping ball on a grid of all possible hops.

No single sample shows hops as low as the noise, and a search for one arrangement of bounces finds one of many that
explain the samples about as well. So all of them are followed at once: a hop is its take-off speed and the elapsed
share of its duration, and a hidden Markov model on a grid of both is filtered forwards and smoothed backwards. The
result is an average over all arrangements of bounces.

Source: L. R. Rabiner, "A tutorial on hidden Markov models", Proceedings of the IEEE 77, 1989;
docs/derivations/smoother.md, "Low hops".
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.dynamics.motion.limits import REST_SPEED

if TYPE_CHECKING:
    from scipy.sparse import csr_array

SPEEDS: Final = 64
"""Number of take-off speeds in the grid."""
POINTS: Final = ((-np.sqrt(3.0), 1.0 / 6.0), (0.0, 2.0 / 3.0), (np.sqrt(3.0), 1.0 / 6.0))
"""Places and weights of the Gauss-Hermite rule with three points."""
STRAY_SHARE: Final = 0.01
"""Prior share of samples that are not the ball."""
STRAY_SPREAD: Final = 0.3
"""m, of their heights."""
RESTS: Final = 0.1
"""Prior probability that the ball lies still at the first sample."""
FAR_BEHIND: Final = 15.0
"""nats. A height of the surface that is so much less likely than another is dropped."""
MILLIONTH: Final = 1e-6
"""Probability of motion below which a ball is taken to lie still from there on."""


@dataclass(frozen=True)
class HopLaw:
    """The parameters of a hop.

    Attributes:
        gravity: m/s^2.  fastest: m/s, take-off speed of the highest hop.
        rebound: (`SPEEDS`,) m/s, speed after an impact for each speed of the grid.
        scatter: (`SPEEDS`,) m/s, standard deviation of that.
        acceleration: m/s^2/sqrt(Hz), density of the unmodelled acceleration.
    """

    gravity: float
    fastest: float
    rebound: Array
    scatter: Array
    acceleration: float

    @staticmethod
    def speeds(fastest: float) -> Array:
        """(`SPEEDS`,) m/s, the take-off speeds of a grid."""
        return np.linspace(REST_SPEED, fastest, SPEEDS)


@dataclass(frozen=True)
class HopMoments:
    """Moments of the ball's motion at n samples, over all arrangements of bounces.

    Attributes:
        mean: (n, 2) m and m/s, height above the surface and vertical velocity.
        second: (n, 2, 2) their second moments about zero.
        higher: (n, 2) third and fourth moment of the vertical velocity about zero.
        speed: (n,) m/s, take-off speed of the ball's present hop.  resting: (n,) probability that it lies still.
        bounces: (n - 1,) expected number of bounces in each interval.
    """

    mean: Array
    second: Array
    higher: Array
    speed: Array
    resting: Array
    bounces: Array

    def spread(self, point: Array) -> Array:
        """(n, 2, 2) second moments about points (n, 2), the velocity's raised to match its fourth moment."""
        cross = self.mean[:, :, None] * point[:, None, :]
        found = self.second - cross - cross.swapaxes(1, 2) + point[:, :, None] * point[:, None, :]
        v, (third, fourth) = point[:, 1], self.higher.T
        about = fourth - 4.0 * v * third + 6.0 * v**2 * self.second[:, 1, 1] - 4.0 * v**3 * self.mean[:, 1] + v**4
        found[:, 1, 1] = np.maximum(found[:, 1, 1], np.sqrt(np.maximum(about, 0.0) / 3.0))
        return np.asarray(found)

    def select(self, inside: slice) -> "HopMoments":
        """The moments of some of the samples."""
        whole = (self.mean, self.second, self.higher, self.speed, self.resting)
        mean, second, higher, speed, resting = (part[inside] for part in whole)
        return HopMoments(mean, second, higher, speed, resting, self.bounces[inside.start : inside.stop - 1])


class HopGrid:
    """A hidden Markov model of hops.

    Args:
        law: of the hops.  phases: number of cells for the duration of each hop.
        tick: s, to which stamps are rounded, so that few transition matrices are needed.
        finest: m, least noise of a sample that the cells resolve.
    """

    def __init__(self, law: HopLaw, phases: int, tick: float, finest: float = 0.0) -> None:
        self.law, self.phases, self.tick, self.finest = law, phases, tick, finest
        self.grid = HopLaw.speeds(law.fastest)
        share = np.tile((np.arange(phases) + 0.5) / phases, SPEEDS)
        self.speed = np.append(np.repeat(self.grid, phases), 0.0)
        """(k,) m/s, of each cell; the last one is rest."""
        since = np.append(share, 0.0) * 2.0 * self.speed / law.gravity
        self.height = self.speed * since - 0.5 * law.gravity * since**2
        self.rise = self.speed - law.gravity * since
        z, v, rests = self.height, self.rise, self.speed == 0.0
        self._features = np.stack((z, v, z * z, z * v, v * v, v**3, v**4, self.speed, rests), axis=1)
        self._first = np.full(len(self.speed), (1.0 - RESTS) / (len(self.speed) - 1))
        """(k,) probabilities of the cells before the first sample."""
        self._first[-1] = RESTS
        self._steps: dict[int, tuple[csr_array, csr_array]] = {}

    def ticks(self, times: Array) -> Index:
        """(n - 1,) intervals between stamps (n,) s, in ticks."""
        return np.diff(np.round((times - times[0]) / self.tick)).astype(np.int64)

    def evidence(self, times: Array, heights: Array, sigma: Array, levels: Array) -> Array:
        """(k,) log likelihoods for levels (k,) m of the surface, -inf if far behind; arguments as of `moments`."""
        found, belief = np.full(len(levels), -np.inf), self.unknown(levels)
        for k, ticks in enumerate([*self.ticks(times).tolist(), None]):
            belief = belief.weighed(heights[k], sigma[k])
            if ticks is None or (belief.cells[:, -1] > 1.0 - MILLIONTH).all():
                break
            belief = belief.moved(ticks)
        rest = zip(heights[k + 1 :], sigma[k + 1 :], strict=True)  # while the ball lies still
        left = [np.log(self.likelihood(height - belief.levels, noise)[:, -1]) for height, noise in rest]
        found[np.isin(levels, belief.levels)] = belief.said + np.sum(left, axis=0)
        return found

    def unknown(self, levels: Array) -> "HopBelief":
        """What is known before the first sample, for levels (k,) m of the surface."""
        return HopBelief(self, levels, np.zeros(len(levels)), np.tile(self._first, (len(levels), 1)))

    def moments(self, times: Array, heights: Array, sigma: Array) -> HopMoments:
        """Moments of the motion from (n,) s, heights (n,) m and sigma (n,) m, by the forward-backward algorithm."""
        steps = self.ticks(times)
        filtered = self._filtered(steps, heights, sigma)
        known, bounces = np.zeros((len(times), self._features.shape[1])), np.zeros(len(times) - 1)
        known[len(filtered) :, -1] = 1.0  # the ball lies still
        later = np.ones(len(self.speed))
        known[len(filtered) - 1] = filtered[-1] @ self._features
        for k in range(len(filtered) - 2, -1, -1):
            follow, counted = self.step(int(steps[k]))
            said = self.likelihood(heights[k + 1], sigma[k + 1]) * later
            before = follow @ said
            scale = filtered[k] @ before
            bounces[k] = filtered[k] @ (counted @ said) / scale
            later = before / scale
            known[k] = (filtered[k] * later) @ self._features
        return _moments(known, bounces)

    def moments_of(self, cells: Array) -> HopMoments:
        """The moments for probabilities (n, k) of the cells at n moments; bounces are not counted."""
        return _moments(cells @ self._features, np.zeros(len(cells) - 1))

    def likelihood(self, heights: Array | float, sigma: float) -> Array:
        """(..., k) density of samples at heights (...) m in each cell; of a noise that the cells resolve."""
        sigma = max(sigma, self.finest)
        off = (np.asarray(heights)[..., None] - self.height) / sigma
        good = (1.0 - STRAY_SHARE) * np.exp(-0.5 * off**2) / sigma
        return np.asarray(good + STRAY_SHARE / STRAY_SPREAD)

    def _filtered(self, steps: Index, heights: Array, sigma: Array) -> list[Array]:
        """(k,) probabilities of the cells after each sample, until the ball surely lies still."""
        before, found = self._first, list[Array]()
        for k in range(len(heights)):
            now = before * self.likelihood(heights[k], sigma[k])
            found.append(now / now.sum())
            if k == len(steps) or found[-1][-1] > 1.0 - MILLIONTH:
                break
            before = found[-1] @ self.step(int(steps[k]))[0]
        return found

    def step(self, ticks: int) -> "tuple[csr_array, csr_array]":
        """(k, k) probabilities of the cells over some ticks, and these times the number of bounces on the way."""
        if ticks not in self._steps:
            from scipy.sparse import csr_array  # few tracks hop low, and it takes a tenth of a second to import

            pairs = itertools.product(POINTS, POINTS)
            parts = [self._moved(ticks * self.tick, push, kick, a * b) for (push, a), (kick, b) in pairs]
            target, weight, bounces = (np.concatenate(column) for column in zip(*parts, strict=True))
            shape = (len(self.speed), len(self.speed))
            source = np.tile(np.arange(len(self.speed)), len(target) // len(self.speed))
            follow, counted = (csr_array((w, (source, target)), shape=shape) for w in (weight, weight * bounces))
            self._steps[ticks] = follow, counted
        return self._steps[ticks]

    def _moved(self, dt: float, push: float, kick: float, share: float) -> tuple[Index, Array, Array]:
        """Four target cells of all cells over dt s, their probabilities and bounces; push, kick: disturbances."""
        law, rests = self.law, self.speed == 0.0
        rise = self.rise + push * law.acceleration * np.sqrt(dt)
        speed = np.sqrt(rise**2 + 2.0 * law.gravity * self.height)
        since, bounces = (speed - rise) / law.gravity + dt, np.zeros(len(rise))
        while (lands := ~rests & (since >= 2.0 * speed / law.gravity)).any():
            since = np.where(lands, since - 2.0 * speed / law.gravity, since)
            scatter = np.where(bounces == 0.0, kick, 0.0) * np.interp(speed, self.grid, law.scatter)
            speed = np.where(lands, np.interp(speed, self.grid, law.rebound) + scatter, speed)
            bounces += lands
            rests |= lands & (speed < REST_SPEED)
        row = np.clip((speed - self.grid[0]) / (self.grid[1] - self.grid[0]), 0.0, SPEEDS - 1.0)
        over = np.clip(since * law.gravity / (2.0 * np.maximum(speed, REST_SPEED)), 0.0, 1.0)
        column = np.clip(over * self.phases - 0.5, 0.0, self.phases - 1.0)  # a cell holds nothing of the next hop
        first, low = np.minimum(row.astype(int), SPEEDS - 2), np.minimum(column.astype(int), self.phases - 2)
        upper, right = row - first, column - low
        corner = first * self.phases + low
        targets = [corner, corner + 1, corner + self.phases, corner + self.phases + 1]
        weights = [(1 - upper) * (1 - right), (1 - upper) * right, upper * (1 - right), upper * right]
        target = np.where(rests, len(rests) - 1, np.stack(targets))
        return target.ravel(), share * np.stack(weights).ravel(), np.tile(bounces, 4)


@dataclass(frozen=True)
class HopBelief:
    """What samples so far say of a hop, for some heights of the surface.

    Attributes:
        grid: of hops.  levels: (k,) m, heights of the surface.  said: (k,) nats, their log evidence.
        cells: (k, c) probabilities of the grid's cells at each of them.
    """

    grid: HopGrid
    levels: Array
    said: Array
    cells: Array

    def weighed(self, height: float, sigma: float) -> "HopBelief":
        """After a sample at a height in m with the noise sigma in m; levels far behind are dropped."""
        cells = self.cells * self.grid.likelihood(height - self.levels, sigma)
        total = cells.sum(axis=1)
        said = self.said + np.log(total)
        kept = said > said.max() - FAR_BEHIND
        return replace(self, levels=self.levels[kept], said=said[kept], cells=(cells / total[:, None])[kept])

    def moved(self, ticks: int) -> "HopBelief":
        """Some ticks later."""
        return replace(self, cells=self.cells @ self.grid.step(ticks)[0])

    @property
    def weights(self) -> Array:
        """(k,) probabilities of the levels."""
        weights = np.exp(self.said - self.said.max())
        return np.asarray(weights / weights.sum())

    @property
    def resting(self) -> float:
        """Probability that the ball lies still."""
        return float(self.weights @ self.cells[:, -1])

    def moving(self) -> "HopBelief":
        """What is known if the ball does not lie still."""
        moves = self.cells[:, :-1].sum(axis=1)
        kept = moves > 0.0
        cells, moves = self.cells[kept], moves[kept]
        cells[:, -1] = 0.0
        return replace(
            self, levels=self.levels[kept], said=self.said[kept] + np.log(moves), cells=cells / moves[:, None]
        )

    def moments(self) -> HopMoments:
        """The moments of one moment, averaged over the levels."""
        by_level = self.grid.moments_of(self.cells)
        each = [by_level.select(slice(k, k + 1)) for k in range(len(self.levels))]
        return averaged(each, self.levels, self.weights)


def _moments(known: Array, bounces: Array) -> HopMoments:
    """Moments from expected features (n, 9) of the cells."""
    z, v, zz, zv, vv, _, _, speed, resting = known.T
    second = np.stack((np.stack((zz, zv), axis=-1), np.stack((zv, vv), axis=-1)), axis=-2)
    return HopMoments(np.stack((z, v), axis=-1), second, known[:, 5:7], speed, resting, bounces)


def averaged(known: Sequence[HopMoments], levels: Array, weights: Array) -> HopMoments:
    """The moments averaged over (k,) m heights of the surface above a reference, with (k,) probabilities."""
    shift = np.zeros((len(levels), 1, 2))
    shift[:, 0, 0] = levels
    mean = np.stack([one.mean for one in known])
    cross = mean[..., :, None] * shift[..., None, :]
    second = np.stack([one.second for one in known]) + cross + cross.swapaxes(-1, -2)
    second += shift[..., :, None] * shift[..., None, :]
    rest = (np.stack([getattr(one, name) for one in known]) for name in ("higher", "speed", "resting", "bounces"))
    return HopMoments(*(np.tensordot(weights, part, axes=1) for part in (mean + shift, second, *rest)))
