"""Finds how far candidates lie from the ball, from the flights through them.

A candidate's stated covariance has two parts: a round one, and one along the longer axis, that of a bar. Each is known
up to a factor that all candidates of a recording share. The factors are those with which the chosen candidates are most
probable, without what the flights take over of their noise (restricted maximum likelihood, Harville 1977).
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.result import Estimate
from ballfg.factors.loss import Loss
from ballfg.state import POSITION
from ballfg.tracks.track import Track
from ballfg.vision.projection import CameraBank

KNOWN: Final = 1.0
"""Degrees of freedom with which the stated covariances count."""


@dataclass(frozen=True)
class Noise:
    """Factors of the round part of the stated covariances, and of the part along their longer axes."""

    around: float = 1.0
    along: float = 1.0

    def of(self, stated: Array) -> Array:
        """(n, 2, 2) px^2, covariances for stated ones (n, 2, 2)."""
        around, along = parts(stated)
        return np.asarray(self.around * around + self.along * along)

    def changed(self, before: "Noise") -> float:
        """The larger change of a factor's logarithm."""
        return max(abs(np.log(self.around / before.around)), abs(np.log(self.along / before.along)))

    def likelier(self, stated: Array, off: Array, spread: Array, loss: Loss) -> "Noise":
        """The factors with which the candidates are likelier, if the flights were found with the factors of today.

        The distances have the covariance S - P, with that of the candidates S and that of the flights P: a part of S
        grows as much as its share in the squares of the distances exceeds its share in S - P.

        Args:
            stated: (n, 2, 2) px^2.  off: (n, 2) px, from the flights to the candidates.
            spread: (n, 2, 2) px^2, P.  loss: of a candidate, which weighs far ones less.
        """
        inverse = np.linalg.inv(self.of(stated))
        white = (inverse @ off[..., None])[..., 0]
        weight = loss.weight(np.sqrt((white * off).sum(axis=1)))
        left = inverse - inverse @ spread @ inverse
        found = list[float]()
        for factor, part in zip((self.around, self.along), parts(stated), strict=True):
            square = factor**2 * (weight * np.einsum("ni,nij,nj->n", white, part, white)).sum()
            freedom = factor * np.maximum(np.einsum("nij,nji->n", part, left), 0.0).sum()
            found.append(float((square + KNOWN) / (freedom + KNOWN)))
        return Noise(*found)


def parts(stated: Array) -> tuple[Array, Array]:
    """The round part of covariances (n, 2, 2), and the rest, along their longer axes."""
    least = np.linalg.eigvalsh(stated)[:, :1, None] * np.eye(2)
    return least, stated - least


def left_over(tracks: Sequence[Track], estimates: Sequence[Estimate]) -> tuple[Array, Array]:
    """Pixels (n, 2) from the estimates of tracks to their sightings by exact cameras, and the estimates' covariances.

    Returns: (n, 2) px, and (n, 2, 2) px^2.
    """
    off, spread = list[Array](), list[Array]()
    for track, estimate in zip(tracks, estimates, strict=True):
        seen = sightings_of(track)
        points = estimate.states[seen.state, POSITION]
        pixels, slope = CameraBank(seen.cameras).jacobian(points, seen.sightings.camera)
        off.append(seen.sightings.pixels - pixels)
        spread.append(slope @ estimate.covariances[seen.state, POSITION, POSITION] @ slope.swapaxes(1, 2))
    return np.concatenate(off), np.concatenate(spread)
