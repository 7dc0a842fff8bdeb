"""Chains the smooth pieces of motion in one camera's candidates: what one ball did until it was lost.

Without a second camera nothing confirms a piece by itself. Two pieces belong together if straight continuations of both
meet in the gap between them, with a kink where the ball bounced or was hit. Whether a chain is a ball's flight, and
where a hit cuts it, is for its motion in space to say (`ballfg.estimation.one_camera`).
"""

from dataclasses import replace
from itertools import permutations
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.tracks.sightings import Sightings
from ballfg.vision.association.associate import AssociationSettings
from ballfg.vision.association.flights import best_pairs
from ballfg.vision.association.tracklets import MAX_TURN, find_tracklets
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import Detections

LONGEST_GAP: Final = 0.2  # s. A ball that reappears after a longer gap is a new one
ENDS: Final = 3  # Candidates at the end of a piece that its continuation is fitted to
PULL: Final = 20.0
"""rad/s^2, standard deviation of the acceleration across the view that a straight line leaves out: gravity and drag at
less than a metre."""
FLOOR: Final = 1.0  # px, standard deviation of a continuation apart from that and from noise
GATE: Final = 16.0  # Largest squared distance of two continuations, whitened: 4 sigma
STEPS: Final = 25  # Number of times in a gap at which continuations are compared


def chains(
    detections: Detections, camera: Camera, settings: AssociationSettings | None = None
) -> list[list[Sightings]]:
    """What one camera saw of each ball, as smooth pieces in order of time; the chains by their first stamps.

    Args: detections: all candidates, good and bad.  camera: of them.
    """
    least = (settings or AssociationSettings()).least_score
    counted = replace(detections, frames=detections.frames - detections.frames[:1])  # short differences of long stamps
    chosen, origin = counted.select(counted.scores >= least), detections.frames[:1]
    focal = float(np.sqrt(camera.matrix[0, 0] * camera.matrix[1, 1]))
    pieces = find_tracklets(chosen, focal)
    costs = {(i, j): _meeting(chosen, pieces[i], pieces[j], focal) for i, j in permutations(range(len(pieces)), 2)}
    following = dict(best_pairs(costs))
    found = []
    for number in sorted(set(range(len(pieces))) - set(following.values())):
        chain = [number]
        while chain[-1] in following:
            chain.append(following[chain[-1]])
        found.append([_sightings(chosen, pieces[piece], camera.name, origin) for piece in chain])
    return found


def _sightings(seen: Detections, rows: Index, camera: str, origin: Array) -> Sightings:
    times = seen.times[rows] + origin
    return Sightings((camera,), np.zeros(len(rows), dtype=np.int64), times, seen.pixels[rows], seen.covariances[rows])


def _meeting(seen: Detections, earlier: Index, later: Index, focal: float) -> float | None:
    """Squared whitened distance of two pieces' continuations in the gap between them; None if not of one ball."""
    start, end = seen.times[earlier[-1]], seen.times[later[0]]
    if not 0.0 < end - start <= LONGEST_GAP:
        return None
    times = np.linspace(start, end, STEPS)
    before, spread = _continued(seen, earlier[-ENDS:], times, focal)
    after, other_spread = _continued(seen, later[:ENDS], times, focal)
    away = np.linalg.norm(after - before, axis=1)
    square = away**2 / (spread + other_spread)
    close = (square <= GATE) & (away <= MAX_TURN * focal * (end - start))
    return float(square[close].min()) if close.any() else None


def _continued(seen: Detections, rows: Index, times: Array, focal: float) -> tuple[Array, Array]:
    """Pixels (k, 2) of a straight line through some candidates, and the variance (k,) px^2 of each coordinate."""
    middle = seen.times[rows].mean()
    solved = np.linalg.pinv(np.stack((np.ones(len(rows)), seen.times[rows] - middle), axis=1))
    weights = solved[0] + (times - middle)[:, None] * solved[1]
    variance = np.trace(seen.covariances[rows], axis1=1, axis2=2) / 2.0
    reach = np.abs(times - middle) + np.ptp(seen.times[rows]) / 2.0
    return weights @ seen.pixels[rows], weights**2 @ variance + (0.5 * PULL * focal * reach**2) ** 2 + FLOOR**2
