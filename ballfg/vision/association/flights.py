"""Selects tracks in space that fall as a ball does, and joins tracks of one flight.

Between bounces a ball's acceleration is gravity, drag and lift; a waved arm's is not. Two tracks belong together if the
continuation of the first meets that of the second in the gap, with a kink where the ball bounced or was hit.
"""

from collections.abc import Sequence
from itertools import permutations
from typing import Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.state import STANDARD_GRAVITY
from ballfg.vision.association.paths import Path

LONGEST_GAP: Final = 0.3  # s. A ball that reappears after a longer gap is a new one.
LONGEST_HIT_GAP: Final = 0.1  # s; in a gap so long a ball may have been hit, in a longer one it may only have bounced
FASTEST: Final = 80.0  # m/s, no ball that is struck by hand is faster: the fastest served tennis balls have 73
LEAST_WAY: Final = 0.05  # m, least extent of a ball's track
GRAVITY: Final = np.array([0.0, 0.0, -STANDARD_GRAVITY])  # m/s^2
_SLACK: Final = 3.0  # m/s^2 about gravity for a slow ball: error of the calibration, lift of a fast spin
_AIR: Final = 0.25  # 1/m, growth of that tolerance with the square of the speed: drag of 0.13 and as much lift
_WINDOWS: Final = (0.15, 0.3, 0.6)  # s, for an acceleration: short against a flight; the longer ones serve noisy tracks
_LEAST_IN_WINDOW: Final = 5  # points of such a window: three make the parabola
_TELLING: Final = 2.0  # m/s^2, largest standard deviation of an acceleration; with more, a hovering object would pass
_SIGMAS: Final = 3.0  # tolerance in standard deviations of a measured acceleration
_FALLING: Final = 0.5  # least share of informative windows in which a ball falls; else it is held, hit, at rest
_END: Final = 0.08  # s, length of a track's end that is extrapolated
_STEADY: Final = 10.0  # m/s^2, standard deviation for drag and lift, which the extrapolation leaves out
_FLOOR: Final = 0.01  # m, standard deviation of an extrapolated position apart from noise
_FARTHEST: Final = 0.15  # m, greatest distance between the ends of one flight, whatever their covariance
_GATE: Final = 16.0  # largest squared distance of two continuations, whitened: 4 sigma
_FRICTION: Final = 0.5  # largest relative change of the horizontal velocity in a bounce
_LEAST_CHANGE: Final = 1.0  # m/s, always allowed change of the horizontal velocity: spin accelerates a dropped ball
_STEPS: Final = 25  # number of times in a gap at which continuations are compared


def is_ball(track: Path) -> bool:
    """True for a track in space (d = 3) of a ball: long enough, not too fast, and falling."""
    if np.ptp(track.values, axis=0).max() < LEAST_WAY:
        return False
    found = (_falling(track, length) for length in _WINDOWS)
    first = next((falling for falling in found if falling), [False])
    return float(np.mean(first)) >= _FALLING


def _falling(track: Path, length: float) -> list[bool]:
    """(w,) True for each informative window of a length (s) with a free ball's motion."""
    found = []
    for number in range(int(track.parts[-1]) + 1):
        rows = np.flatnonzero(track.parts == number)
        for start in np.arange(track.times[rows[0]], track.times[rows[-1]] + 0.5 * length, 0.5 * length):
            window = rows[(track.times[rows] >= start) & (track.times[rows] <= start + length)]
            if len(window) >= _LEAST_IN_WINDOW:
                found.append(_falls(track, window))
    return [falls for falls in found if falls is not None]


def _falls(track: Path, window: NDArray[np.intp]) -> bool | None:
    """True if the motion in a window is a free ball's; None if the noise hides it."""
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
    """Squared whitened distance of two tracks' continuations in the gap between them; None if not of one flight."""
    start, end = float(earlier.times[-1]), float(later.times[0])
    if end < start or end - start > LONGEST_GAP or min(len(earlier.times), len(later.times)) < 2:
        return None
    times = np.linspace(start, end, _STEPS)
    before, spread, velocity = _continued(earlier, times, last=True)
    after, other_spread, other_velocity = _continued(later, times, last=False)
    change, speed = np.linalg.norm((other_velocity - velocity)[:2]), np.linalg.norm(velocity[:2])
    if end - start > LONGEST_HIT_GAP and change > _FRICTION * speed + _LEAST_CHANGE:  # more than a bounce
        return None
    apart = after - before
    away = np.linalg.norm(apart, axis=1)
    square = np.einsum("ni,ni->n", apart, np.linalg.solve(spread + other_spread, apart[..., None])[..., 0])
    close = (away <= _FARTHEST) & (square <= _GATE)
    return float(square[close].min()) if close.any() else None


def _continued(track: Path, times: Array, last: bool) -> tuple[Array, Array, Array]:
    """Positions (k, 3), covariances (k, 3, 3) and velocity (3,) of a track's last or first part in free fall."""
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
    """Pairs (earlier, later) of tracks of one flight, best first; no track is twice on the same side."""
    costs = {(i, j): meeting(tracks[i], tracks[j]) for i, j in permutations(range(len(tracks)), 2)}
    pairs: list[tuple[int, int]] = []
    for _, (i, j) in sorted((cost, pair) for pair, cost in costs.items() if cost is not None):
        if all(i != earlier and j != later for earlier, later in pairs):
            pairs.append((i, j))
    return pairs
