"""What balls do in space: they fall. Says which tracks do, and which of them are parts of one flight.

Between bounces a ball's acceleration is gravity, drag and lift; a waved arm's is not. Two tracks belong together where
the flight out of the first meets the flight into the second: at once where the ball was hidden, with a kink where it
bounced or was hit.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.state import STANDARD_GRAVITY
from ballfg.vision.association.paths import Path

Array = NDArray[np.float64]

LONGEST_GAP: Final = 0.3
"""s, after which a ball that was not seen is a new one."""
LONGEST_HIT_GAP: Final = 0.1
"""s, up to which a ball that comes back with any velocity is the same one, hit meanwhile; later it may have bounced."""
FASTEST: Final = 80.0
"""m/s, no ball that is struck by hand is faster: the fastest served tennis balls have 73."""
LEAST_WAY: Final = 0.05
"""m, extent of the track of something that moves."""
GRAVITY: Final = np.array([0.0, 0.0, -STANDARD_GRAVITY])
"""m/s^2"""
_SLACK: Final = 3.0
"""m/s^2, by which a slow ball's acceleration may differ from gravity: calibration, lift of a fast spin."""
_AIR: Final = 0.25
"""1/m, by how much more with the square of the speed: drag of 0.13 and as much lift."""
_WINDOWS: Final = (0.15, 0.3, 0.6)
"""s, over which an acceleration is measured: short against a flight, and longer where the noise asks for it."""
_LEAST_IN_WINDOW: Final = 5
"""Points of such a window: three make the parabola."""
_TELLING: Final = 2.0
"""m/s^2, standard deviation of a measured acceleration beyond which a window says nothing about gravity: something
that hovers must not pass with all that is granted."""
_SIGMAS: Final = 3.0
"""Of a measured acceleration, that are granted."""
_FALLING: Final = 0.5
"""Least share of the telling windows in which a ball falls; it may be held, hit or at rest in the others."""
_END: Final = 0.08
"""s, of a track's end that is continued."""
_STEADY: Final = 10.0
"""m/s^2, drag and lift that the continuation does not know of."""
_FLOOR: Final = 0.01
"""m, how far apart the ends of one flight may lie however well they are known."""
_FARTHEST: Final = 0.15
"""m, and how far however badly: two balls are told apart at that distance."""
_GATE: Final = 16.0
"""Squared distance of two continuations in their covariance: 4 sigma."""
_FRICTION: Final = 0.5
"""Share of its horizontal velocity that a bounce may change."""
_LEAST_CHANGE: Final = 1.0
"""m/s, by which the horizontal velocity may change however slow it is: spin drives a ball that drops."""
_STEPS: Final = 25
"""Times tried in a gap."""


def is_ball(track: Path) -> bool:
    """Whether what moved along a track in space (d = 3) moved as a ball does: far enough, not too fast, and falling."""
    if np.ptp(track.values, axis=0).max() < LEAST_WAY:
        return False
    for length in _WINDOWS:
        falling = _falling(track, length)
        if falling:
            return float(np.mean(falling)) >= _FALLING
    return False


def _falling(track: Path, length: float) -> list[bool]:
    """For each window of a length (s) that tells, whether the motion in it is a free ball's."""
    found = []
    for number in range(int(track.parts[-1]) + 1):
        rows = np.flatnonzero(track.parts == number)
        for start in np.arange(track.times[rows[0]], track.times[rows[-1]] + 0.5 * length, 0.5 * length):
            window = rows[(track.times[rows] >= start) & (track.times[rows] <= start + length)]
            if len(window) >= _LEAST_IN_WINDOW:
                falls = _falls(track, window)
                found += [falls] if falls is not None else []
    return found


def _falls(track: Path, window: NDArray[np.intp]) -> bool | None:
    """Whether the motion in a window is a free ball's; None where the noise hides it."""
    time = track.times[window] - track.times[window].mean()
    solved = np.linalg.pinv(np.stack((np.ones_like(time), time, 0.5 * time**2), axis=1))
    _, velocity, acceleration = solved @ track.values[window]
    spread = np.einsum("w,wij->ij", solved[2] ** 2, track.covariances[window])
    away = acceleration - GRAVITY
    distance = float(np.linalg.norm(away))
    sigma = float(np.sqrt(away @ spread @ away)) / distance if distance > 0.0 else 0.0
    speed = float(np.linalg.norm(velocity))
    if speed > FASTEST:
        return False
    if np.sqrt(np.trace(spread) / 3.0) > _TELLING:
        return None
    return distance <= _SLACK + _AIR * speed**2 + _SIGMAS * sigma


def meeting(earlier: Path, later: Path) -> float | None:
    """How well a track goes on in another: squared distance of the two continuations in the gap, whitened.

    None where it does not: the gap is too long, or the continuations pass each other.
    """
    start, end = float(earlier.times[-1]), float(later.times[0])
    if end < start or end - start > LONGEST_GAP or min(len(earlier.times), len(later.times)) < 2:
        return None
    times = np.linspace(start, end, _STEPS)
    before, spread, velocity = _continued(earlier, times, last=True)
    after, other_spread, other_velocity = _continued(later, times, last=False)
    if end - start > LONGEST_HIT_GAP and not _only_bounced(velocity, other_velocity):
        return None
    apart = after - before
    away = np.linalg.norm(apart, axis=1)
    square = np.einsum("ni,ni->n", apart, np.linalg.solve(spread + other_spread, apart[..., None])[..., 0])
    close = (away <= _FARTHEST) & (square <= _GATE)
    return float(square[close].min()) if close.any() else None


def _only_bounced(before: Array, after: Array) -> bool:
    """Whether velocities (3,) before and after a gap are those of one flight, through a bounce at most."""
    change, speed = np.linalg.norm((after - before)[:2]), np.linalg.norm(before[:2])
    return bool(change <= _FRICTION * speed + _LEAST_CHANGE)


def _continued(track: Path, times: Array, last: bool) -> tuple[Array, Array, Array]:
    """A track's last or first part as it would fall on: positions (k, 3), covariances (k, 3, 3), velocity (3,)."""
    rows = np.flatnonzero(track.parts == track.parts[-1 if last else 0])
    end = track.times[rows[-1 if last else 0]]
    rows = rows[np.abs(track.times[rows] - end) <= _END]
    if len(rows) < 2:
        rows = np.arange(len(track.times))[-2:] if last else np.arange(2)
    since = track.times[rows] - end
    level = track.values[rows] - 0.5 * GRAVITY * since[:, None] ** 2
    solved = np.linalg.pinv(np.stack((np.ones_like(since), since), axis=1))
    ahead = times - end
    weights = solved[0] + ahead[:, None] * solved[1]
    positions = weights @ level + 0.5 * GRAVITY * ahead[:, None] ** 2
    covariances = np.einsum("kw,wij->kij", weights**2, track.covariances[rows])
    reach = np.abs(ahead) + np.ptp(since)
    unknown = (0.5 * _STEADY * reach**2) ** 2 + _FLOOR**2
    return positions, covariances + unknown[:, None, None] * np.eye(3), solved[1] @ level


def successions(tracks: Sequence[Path]) -> list[tuple[int, int]]:
    """Which track goes on in which: pairs (earlier, later), no track in two pairs on the same side, best first."""
    found = []
    for i, earlier in enumerate(tracks):
        for j, later in enumerate(tracks):
            cost = meeting(earlier, later) if i != j else None
            if cost is not None:
                found.append((cost, i, j))
    pairs: list[tuple[int, int]] = []
    for _, i, j in sorted(found):
        if all(i != earlier and j != later for earlier, later in pairs):
            pairs.append((i, j))
    return pairs
