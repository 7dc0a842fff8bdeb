"""Finds stretches of a track with hops too low for distinguishing single bounces, and their uncertainty.

The segmentation takes the height of every surface as uncertain by millimetres, and one arrangement of bounces as
certain. For such low hops, `HopGrid` follows all arrangements at once. It gives the number of bounces and their
intervals, and the distance of the ball from the estimate, which holds one arrangement.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, median
from ballfg.dynamics.motion.arrays import bounced
from ballfg.dynamics.motion.limits import REST_SPEED
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.result import Estimate
from ballfg.estimation.segmentation.result import Contact, Rest, Segmentation
from ballfg.estimation.settings import Settings, sample_sigmas
from ballfg.estimation.smoother.second_look.hop_grid import HopGrid, HopMoments, averaged
from ballfg.estimation.smoother.second_look.hopping_ball import HoppingBall, hop_time, most_height
from ballfg.state import VZ, Z
from ballfg.tracks import Track

if TYPE_CHECKING:
    from ballfg.dynamics.model import BallModel

UNLIKELY: Final = 1e-2
"""Share of the likelihood of the best surface height; less likely heights are left out."""
WIDEST: Final = 2.5
"""Standard deviations of the surface's height within which it is searched."""
SURE: Final = 0.95
"""Probability of rest from which no missed bounces are reported."""
UNCOUNTED: Final = (
    "from {:.2f} s after the first sample on the ball may hop lower than the noise: bounces there are not counted, "
    "covariances allow for them"
)
VERTICAL: Final = [Z, VZ]


@dataclass(frozen=True)
class LowHops:
    """A stretch of low hops.

    Attributes:
        first: sample with which it begins.  height: m, declared height of the surface.
        level: m, height of the ball's centre at contact, by the model.
        least: m/s, take-off speed of a hop as high as the noise; bounces of lower ones are not counted.
        known: moments of the ball's motion, with heights above `level`.
    """

    first: int
    height: float
    level: Array
    least: float
    known: HopMoments

    @property
    def last(self) -> int:
        """Its last sample."""
        return self.first + len(self.known.speed) - 1

    def select(self, begin: int, end: int) -> LowHops | None:
        """The part within samples begin to end - 1 of the track, renumbered from 0; None if empty."""
        first, last = max(self.first, begin), min(self.last, end - 1)
        inside = slice(first - self.first, last + 1 - self.first)
        if first > last:
            return None
        return replace(self, first=first - begin, level=self.level[inside], known=self.known.select(inside))

    def events(self, times: Array) -> tuple[list[Contact], list[Rest]]:
        """The bounces that can be counted, and the rest that replaces lower hops.

        The number of bounces is the expected one, rounded; the k-th is where the expected number reaches k - 1/2.

        Args: times: (n,) s, of the whole track.
        """
        lower = np.flatnonzero(self.known.speed < self.least)
        down = self.first + (int(lower[0]) if len(lower) else len(self.known.speed))
        so_far, contacts = np.cumsum(self.known.bounces), list[Contact]()
        for k in range(round(float(so_far[-1]))):
            interval = self.first + int(np.searchsorted(so_far, k + 0.5))
            if interval >= down:
                break
            contacts.append(Contact(interval, 0.5 * float(times[interval] + times[interval + 1]), self.height))
        return contacts, [Rest(down, self.last - 1, self.height)] if down < self.last else []


def low_hops(
    track: Track, events: Segmentation, model: BallModel, surfaces: Surfaces, settings: Settings
) -> tuple[LowHops, ...]:
    """The stretches of a track in which the ball hops low.

    A ball in flight stays below a height no longer than a hop of that height takes: if samples stay there longer, it
    hops or lies still. Hits, the ends of rests and intervals as long as such a hop end stretches.
    """
    if len(track) < 2:
        return ()
    sigma, ball, found = _height_sigmas(track, settings), HoppingBall(model, settings), list[LowHops]()
    most = most_height(float(median(sigma)))
    unseen = np.diff(track.times) > hop_time(most, ball.gravity(track.positions[0]))
    for number, height in enumerate(surfaces.heights()):
        gap = ball.gap(track.positions, height)
        low = np.abs(gap) < most
        if number == 0:
            low &= surfaces.over_table(track.positions)
        for first, last in _runs(low, events, unseen):
            if first == last:
                continue
            position, inside = track.positions[first], slice(first, last + 1)
            if track.times[last] - track.times[first] <= hop_time(most, ball.gravity(position)):
                continue
            grid, spread = ball.grid(position, most, sigma[inside]), ball.level_spread(position, height)
            known = _known(grid, track.times[inside], gap[inside], np.maximum(sigma[inside], grid.finest), spread)
            least = float(np.sqrt(2.0 * grid.law.gravity * np.median(sigma[inside])))
            found.append(LowHops(first, height, track.positions[inside, Z] - gap[inside], least, known))
    return tuple(found)


def counted(events: Segmentation, hops: Sequence[LowHops], times: Array) -> Segmentation:
    """The events of a track; within stretches of low hops, those expected over all arrangements of bounces."""
    for one in hops:
        contacts, rests = one.events(times)
        contacts += [c for c in events.contacts if not one.first <= c.interval < one.last]
        rests += [rest for rest in events.rests if rest.last < one.first or rest.first >= one.last]
        met, lying = sorted(contacts, key=lambda c: c.time), sorted(rests, key=lambda r: r.first)
        events = replace(events, contacts=tuple(met), rests=tuple(lying))
    return events


def with_low_hops(estimate: Estimate, hops: Sequence[LowHops], model: BallModel) -> Estimate:
    """An estimate with covariances for all arrangements of bounces.

    Height and vertical velocity then vary about the estimate at least as much as over all arrangements. The variance of
    the velocity is that of the normal distribution with the same fourth moment: a ball that with a probability of 1 %
    is on the other side of a bounce would else be ten standard deviations away once in 100 times. Where the vertical
    velocity may differ because a bounce came earlier or later, the other velocities and the spin may differ by the
    effect of friction at that bounce.
    """
    if estimate.status.failed or not hops:
        return estimate
    covariances = estimate.covariances.copy()
    for one in hops:
        inside = slice(one.first, one.last + 1)
        states, own = estimate.states[inside], covariances[inside][:, VERTICAL][:, :, VERTICAL]
        about = states[:, VERTICAL] - np.stack((one.level, np.zeros(len(states))), axis=-1)
        spread = one.known.spread(about)
        more, jump = _beyond(spread, own), _jumps(estimate, one, model)
        jump[:, VERTICAL] = 0.0
        added = more[:, 1, 1, None, None] * jump[:, :, None] * jump[:, None, :]
        rows, columns = np.ix_(VERTICAL, VERTICAL)
        added[:, rows, columns] = more
        covariances[inside] += added
    return replace(estimate, covariances=covariances)


def _jumps(estimate: Estimate, hops: LowHops, model: BallModel) -> Array:
    """(n, 9) change per m/s of vertical velocity, for a bounce, the nearest one, that came earlier or later."""
    jumps = bounce_jumps(estimate.states[hops.first : hops.last + 1], hops.known.speed, model)
    at = np.array([c.interval for c in estimate.contacts if hops.first <= c.interval < hops.last], dtype=np.int64)
    if len(at):
        counted = estimate.states[at + 1] - estimate.states[at]
        own, samples = counted[:, VZ] > REST_SPEED, np.arange(hops.first, hops.last + 1)
        nearest = np.abs(samples[:, None] - 0.5 - at).argmin(axis=1)
        used = own[nearest] & (hops.known.speed >= hops.least)
        jumps[used] = (counted / counted[:, [VZ]])[nearest][used]
    return jumps


def bounce_jumps(states: Array, speed: Array, model: BallModel) -> Array:
    """(n, 9) change of states (n, 9) per m/s of vertical velocity, at a bounce with a speed (n,) in m/s."""
    before = states.copy()
    before[:, VZ] = -np.maximum(speed, REST_SPEED)
    jumps = bounced(model, before) - before
    return np.asarray(jumps / jumps[:, [VZ]])


def uncounted_note(hops: Sequence[LowHops], times: Array) -> tuple[str, ...]:
    """A note on when bounces become too low to count.

    Args: hops: of the track or a part of it.  times: (n,) s, of the same samples since the first one of the track.
    """
    lower = ((one.first, (one.known.speed < one.least) & (one.known.resting < SURE)) for one in hops)
    unclear = [first + int(np.argmax(low)) for first, low in lower if low.any()]
    return (UNCOUNTED.format(float(times[min(unclear)])),) if unclear else ()


def _height_sigmas(track: Track, settings: Settings) -> Array:
    """(n,) m, noise of the heights."""
    settings = settings.for_track(track)
    white = sample_sigmas(settings, len(track), track.sigmas)[:, 2]
    return as_white(white, float(np.median(np.diff(track.times))), settings)


def as_white(sigma: Array, dt: float, settings: Settings) -> Array:
    """m, noise of heights every dt s: lasting errors are replaced by white ones with equal information on a mean."""
    fading = np.exp(-dt / settings.memory_time)
    return np.asarray(np.sqrt(sigma**2 + settings.memory[2] ** 2 * (1.0 + fading) / (1.0 - fading)))


def _runs(low: NDArray[np.bool_], events: Segmentation, unseen: NDArray[np.bool_]) -> list[tuple[int, int]]:
    """First and last samples of runs of low samples without a hit, a gap, an end of a rest or an unseen interval."""
    ends = [rest.last + 1 for rest in events.rests]
    broken = np.zeros(len(low) + 1, dtype=bool)
    gaps_between = [*events.hits.tolist(), *events.restarts.tolist(), *np.flatnonzero(unseen).tolist()]
    broken[np.array([*gaps_between, *ends], dtype=np.int64) + 1] = True
    starts = low & ~np.concatenate(([False], low[:-1])) | low & broken[:-1]
    stops = low & ~np.concatenate((low[1:], [False])) | low & broken[1:]
    return list(zip(np.flatnonzero(starts).tolist(), np.flatnonzero(stops).tolist(), strict=True))


def _known(grid: HopGrid, times: Array, gap: Array, sigma: Array, spread: float) -> HopMoments:
    """Moments of the ball's motion, averaged over the heights of the surface, which has a `spread` in m."""
    levels = levels_within(spread, float(np.median(sigma)))
    said = grid.evidence(times, gap, sigma, levels) - 0.5 * (levels / spread) ** 2
    weights = np.exp(said - said.max())
    levels, weights = levels[weights > UNLIKELY], weights[weights > UNLIKELY]
    return averaged([grid.moments(times, gap - level, sigma) for level in levels], levels, weights / weights.sum())


def levels_within(spread: float, sigma: float) -> Array:
    """(k,) m, heights of a surface about its declared one, for its `spread` and the noise of samples in m."""
    count = int(np.ceil(WIDEST * spread / (0.5 * sigma)))
    return np.linspace(-WIDEST * spread, WIDEST * spread, 2 * count + 1)


def _beyond(larger: Array, own: Array) -> Array:
    """(n, 2, 2) the positive part of the difference of some matrices and others, as covariances."""
    root = np.linalg.cholesky(own)
    inverse = np.linalg.inv(root)
    values, vectors = np.linalg.eigh(inverse @ (larger - own) @ inverse.swapaxes(1, 2))
    turned = root @ vectors
    return np.asarray((turned * np.maximum(values, 0.0)[:, None, :]) @ turned.swapaxes(1, 2))
