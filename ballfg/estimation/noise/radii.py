"""Finds by how much radii in pictures are measured too large, and how they scatter, from flights of known depth.

Soft edges and compression make all balls of a recording larger by about the same share; light and what lies behind
change that from flight to flight. Flights whose bounces tell how far away the ball was show both, and the radius then
tells it of those without a bounce.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.estimation.measurement.position_noise import MAD_TO_SIGMA
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.result import Estimate
from ballfg.state import POSITION
from ballfg.tracks.track import Track
from ballfg.vision.projection import CameraBank

UNKNOWN: Final = 0.1
"""Prior standard deviation of the logarithm of the factor by which radii are too large; counts as one flight."""
SHARPEST: Final = 0.02
"""Least scatter of the logarithms of radii within a flight."""
AGREE: Final = 4.0
"""Standard deviations by which the radii of a flight differ, in the middle, from those that its depth foretells, at
most."""


@dataclass(frozen=True)
class RadiusNoise:
    """The errors of the logarithms of radii.

    Attributes: large: their mean.  scatter: their standard deviation within a flight.
        common: standard deviation of the error that all radii of a flight share.
    """

    large: float = 0.0
    scatter: float = SHARPEST
    common: float = UNKNOWN

    @classmethod
    def of(cls, off: Sequence[Array]) -> "RadiusNoise":
        """The errors that flights show. Args: off: logarithms (n,) of measured over true radii of each; n is not 0."""
        if not off:
            return cls()
        middles, count = np.array([np.median(one) for one in off]), len(off)
        scatter = MAD_TO_SIGMA * float(np.median(np.abs(np.concatenate([one - np.median(one) for one in off]))))
        middle = float(np.median(middles))
        apart = MAD_TO_SIGMA * float(np.median(np.abs(middles - middle)))
        common = float(np.sqrt((UNKNOWN**2 + count * apart**2) / (1.0 + count)))
        return cls(middle * UNKNOWN**2 / (UNKNOWN**2 + common**2 / count), max(scatter, SHARPEST), common)

    def agrees(self, off: Array) -> bool:
        """True if a flight of such logarithms (n,) of measured over foretold radii is at the depth that foretells."""
        sigma = np.hypot(self.common, self.scatter / np.sqrt(len(off)))
        return bool(np.abs(np.median(off) - self.large) < AGREE * sigma)

    def corrected(self, stated: Array) -> Array:
        """(n, 2) px, true radii and standard deviations of a flight for stated ones; 0 stays unknown.

        The error that all share widens each, so that their mean is known no better than it.
        """
        radius, sigma = stated.T
        known = radius > 0.0
        share = np.divide(sigma, radius, out=np.zeros_like(radius), where=known)
        true = radius * np.exp(-self.large)
        spread = np.sqrt(share**2 + self.scatter**2 + np.count_nonzero(known) * self.common**2)
        return np.stack((true, np.where(known, true * spread, sigma)), axis=1)


def too_large(track: Track, found: Estimate, radii: Array, ball: float) -> Array:
    """(k,) logarithms of those of radii (n, 2) px that are known over those that an estimate foretells.

    Args: track: of n sightings of one camera, at least one of known radius.  found: its estimate.  ball: m, its radius.
    """
    seen = sightings_of(track)
    (known,) = np.nonzero(radii[:, 0] > 0.0)
    places = seen.sightings.select(known).from_cameras(found.states[seen.state[known], POSITION])
    own = torch.from_numpy(places), torch.zeros(len(known), dtype=torch.long)
    return np.asarray(np.log(radii[known, 0] / CameraBank(seen.cameras).radius(*own, ball)[0].numpy()))
