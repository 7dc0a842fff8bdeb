"""Finds how far a camera's sightings lie from the ball, from the flights through them.

A sighting's stated covariance has two parts: a round one, and one along the longer axis, that of a bar. Each is known
up to a factor that all sightings of a camera share. The factors are those with which the sightings are most probable,
without what the flights take over of their noise (restricted maximum likelihood, Harville 1977).
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.optimize import brentq

from ballfg.arrays import Array, Index, Mask
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.result import Estimate
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.loss import Loss
from ballfg.state import POSITION
from ballfg.tracks.track import Track
from ballfg.vision.projection import CameraBank

KNOWN: Final = 1.0
"""Degrees of freedom with which the stated covariances count."""
ROUNDS, SETTLED, KNOWN_TO = 8, 0.2, 0.02
"""Rounds of estimates in which the noise is found, and the change of its factors' logarithms that ends them: where
estimates need it, and where it is what is asked."""
NODES, LARGEST, ROUNDING = 60, 10.0, 1e-9
"""Of the quadrature over normal errors; of the ratio that is solved for; of its equation."""


@dataclass(frozen=True)
class Noise:
    """Factors of the round part of the stated covariances, and of the part along their longer axes.

    Attributes: freedom: degrees of freedom from which each is known.
    """

    around: float = 1.0
    along: float = 1.0
    freedom: tuple[float, float] = (KNOWN, KNOWN)

    @property
    def errors(self) -> tuple[float, ...]:
        """Standard deviations of the logarithms of both standard deviations, the roots of the factors."""
        return tuple(float(np.sqrt(0.5 / number)) for number in self.freedom)

    def of(self, stated: Array) -> Array:
        """(n, 2, 2) px^2, covariances for stated ones (n, 2, 2)."""
        around, along = parts(stated)
        return np.asarray(self.around * around + self.along * along)

    def changed(self, before: "Noise") -> float:
        """The larger change of a factor's logarithm."""
        return max(abs(np.log(self.around / before.around)), abs(np.log(self.along / before.along)))

    def likelier(self, stated: Array, off: Array, spread: Array, loss: Loss) -> "Noise":
        """The factors with which the sightings are likelier, if the flights were found with the factors of today.

        The distances have the covariance S - P, with that of the sightings S and that of the flights P: a part of S
        grows as much as its share in the squares of the distances exceeds its share in S - P.

        Args:
            stated: (n, 2, 2) px^2.  off: (n, 2) px, from the flights to the sightings.
            spread: (n, 2, 2) px^2, P.  loss: of a sighting, which weighs far ones less.
        """
        inverse = np.linalg.inv(self.of(stated))
        white = (inverse @ off[..., None])[..., 0]
        weight = loss.weight(np.sqrt((white * off).sum(axis=1)))
        left = inverse - inverse @ spread @ inverse
        found, known = list[float](), list[float]()
        for factor, part in zip((self.around, self.along), parts(stated), strict=True):
            square = factor**2 * (weight * np.einsum("ni,nij,nj->n", white, part, white)).sum()
            freedom = factor * np.maximum(np.einsum("nij,nji->n", part, left), 0.0).sum()
            known.append(float(freedom + KNOWN))
            found.append(float((square + KNOWN) / known[-1]))
        return Noise(found[0], found[1], (known[0], known[1]))


def settled(
    smoother: Smoother,
    tracks_of: Callable[[list[Noise]], list[Track]],
    stated: Array,
    camera: Index,
    counted: Mask,
    most: float = SETTLED,
) -> list[Noise]:
    """The noise of each camera, from estimates with the noise of the round before.

    Args:
        tracks_of: gives the tracks whose sightings have a noise, seen by exact cameras.
        stated: (n, 2, 2) px^2, of the sightings of all tracks in order.  camera: (n,) numbers of their cameras.
        counted: (n,) sightings that tell the noise.  most: change of a factor's logarithm that ends the rounds.
    """
    noises, loss = [Noise() for _ in range(int(camera.max(initial=-1)) + 1)], smoother.settings.sighting_loss
    for _ in range(ROUNDS):
        tracks = tracks_of(noises)
        found = [smoother.estimate(track) for track in tracks]
        fine = np.repeat([not one.status.failed for one in found], [len(sightings_of(t).sightings) for t in tracks])
        off, spread = left_over(tracks, found)
        before, noises = noises, list[Noise]()
        for number, noise in enumerate(before):
            used = counted & fine & (camera == number)
            noises.append(noise.likelier(stated[used], off[used], spread[used], loss))
        if max((one.changed(old) for one, old in zip(noises, before, strict=True)), default=0.0) < most:
            break
    return noises


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
        points = seen.sightings.from_cameras(estimate.states[seen.state, POSITION])
        pixels, slope = CameraBank(seen.cameras).jacobian(points, seen.sightings.camera)
        off.append(seen.sightings.pixels - pixels)
        spread.append(slope @ estimate.covariances[seen.state, POSITION, POSITION] @ slope.swapaxes(1, 2))
    return np.concatenate(off), np.concatenate(spread)


@dataclass(frozen=True)
class PixelNoise:
    """The noise of a camera's sightings.

    Attributes:
        camera: its name.  count: of its sightings.
        stated: px, medians of the stated standard deviations: of the round part, and of the rest along streaks.
        sigmas: px, the same as the flights show them.  errors: of their logarithms.
    """

    camera: str
    count: int
    stated: tuple[float, float]
    sigmas: tuple[float, float]
    errors: tuple[float, ...]


def noise_of_sightings(smoother: Smoother, tracks: Sequence[Track]) -> list[PixelNoise]:
    """The noise of each camera that saw the ball in some tracks, all of the same cameras.

    An error of a camera moves a whole flight: it hardly shows in what is left of single sightings.
    """
    seen = [sightings_of(track) for track in tracks]
    stated = np.concatenate([one.sightings.covariances for one in seen])
    camera = np.concatenate([one.sightings.camera for one in seen])
    ends = np.cumsum([len(one.sightings) for one in seen])[:-1]

    def tracks_of(noises: list[Noise]) -> list[Track]:
        spread = np.stack([noise.of(stated) for noise in noises])[camera, np.arange(len(camera))]
        return [
            one.with_noise(track, own) for one, track, own in zip(seen, tracks, np.split(spread, ends), strict=True)
        ]

    noises = settled(smoother, tracks_of, stated, camera, np.ones(len(camera), dtype=bool), KNOWN_TO)
    normal = _of_normal_errors(smoother.settings.sighting_loss)
    around, along = (np.trace(part, axis1=1, axis2=2) for part in parts(stated))
    found = list[PixelNoise]()
    for number, noise in enumerate(noises):
        own = camera == number
        if own.any():
            usual = float(np.sqrt(0.5 * np.median(around[own]))), float(np.sqrt(np.median(along[own])))
            roots = normal * float(np.sqrt(noise.around)), normal * float(np.sqrt(noise.along))
            sigmas = usual[0] * roots[0], usual[1] * roots[1]
            found.append(PixelNoise(seen[0].cameras[number].name, int(own.sum()), usual, sigmas, noise.errors))
    return found


def _of_normal_errors(loss: Loss) -> float:
    """Standard deviation of normal errors over the one with which they are most probable under a loss.

    A loss that weighs far errors less counts normal ones as smaller: their weighted squares must have the mean 2.
    """
    halves, weights = np.polynomial.laguerre.laggauss(NODES)  # half the square of two normal numbers is exponential

    def lacking(ratio: float) -> float:
        norm = ratio * np.sqrt(2.0 * halves)
        return float((weights * loss.weight(norm) * norm**2).sum()) - 2.0

    return float(brentq(lacking, 1.0, LARGEST)) if lacking(1.0) < -ROUNDING else 1.0
