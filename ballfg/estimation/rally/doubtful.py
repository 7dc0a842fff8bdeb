"""Tells the strokes of a ball from those of other things, which move as smoothly as a ball does, and fall less.

Bounces that show in the picture make a stroke a ball's for sure. What these say of the errors of radii and of the usual
spin decides about the others: a ball's radius and its fall tell how far away it is. Soft edges and compression make all
balls of a recording larger by about the same share; light and what lies behind change that from flight to flight.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Final

import numpy as np
import torch

from ballfg.arrays import MAD_TO_SIGMA, Array
from ballfg.estimation.observations.sightings import sightings_of
from ballfg.estimation.rally.sequence import BEGINS, Chosen
from ballfg.estimation.rally.strokes import track_of
from ballfg.estimation.result import Estimate, Status
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.progress import Watch, unwatched
from ballfg.state import POSITION, SPIN, VELOCITY
from ballfg.tracks.track import Track
from ballfg.vision.camera import Camera
from ballfg.vision.detection.detections import UNKNOWN_RADIUS, Detections
from ballfg.vision.projection import CameraBank

ANY_SPIN: Final = 1000.0
"""rad/s, the largest that a flight needs which goes through the candidates of something that does not fall."""
LEVEL: Final = 1e-6
"""m/s, at least, along the ground: the axis across a flight straight up is none."""
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


def kept_of(chosen: Chosen, keep: Sequence[bool]) -> Chosen:
    """Those of the chosen strokes that are kept, joined where both of a pair are."""
    kept = [number for number, one in enumerate(keep) if one]
    joined = tuple(chosen.joined[number] and keep[number - 1] for number in kept)
    return Chosen(tuple(chosen.strokes[number] for number in kept), chosen.probabilities[kept], joined)


def balls(
    smoother: Smoother,
    seen: Detections,
    radii: Array,
    camera: Camera,
    chosen: Chosen,
    sure: Sequence[bool],
    watch: Watch = unwatched,
) -> tuple[Chosen, Detections]:
    """The strokes that are a ball's, and the candidates with the true radii of these.

    What shows a bounce has an estimate at a depth with which its radii agree. All else is taken without a bounce, if
    its fall and its radii tell how far away it is, and its spin is one of a ball. A stroke's own candidates must make
    it likelier than clutter, not just the hits that would join it to others.

    Args: seen: candidates without radii.  radii: (n, 2) px, theirs as measured.  sure: of the strokes, True for
            those that are surely a ball's.
    """
    strokes, off, spins = list(chosen.strokes), dict[int, Array](), [smoother.settings.one_view_spin[1]]
    likely = [number for number, stroke in enumerate(strokes) if stroke.score > BEGINS]
    bounced = [number for number in likely if sure[number]]
    ball = np.zeros(len(strokes), dtype=bool)
    for number in watch(bounced, len(bounced), "flights with a bounce estimated"):
        own = radii[strokes[number].rows]
        track = track_of(strokes[number], seen, camera, smoother.model, smoother.surfaces)
        found = smoother.estimate(track)
        ball[number] = not found.status.failed
        spins += [_spin_across(found)[0]] if found.status is Status.OK else []
        if ball[number] and (own[:, 0] > 0.0).any():
            off[number] = too_large(track, found, own, smoother.model.radius)
    errors, usual = RadiusNoise.of(list(off.values())), float(np.sqrt(np.mean(np.square(spins))))
    ball[[number for number, one in off.items() if not errors.agrees(one)]] = False
    true = np.tile(UNKNOWN_RADIUS, (len(seen), 1))
    for stroke in strokes:
        true[stroke.rows] = errors.corrected(radii[stroke.rows])
    sized, doubtful = replace(seen, radii=true), [number for number in likely if not ball[number]]
    for number in watch(doubtful, len(doubtful), "flights without a bounce estimated"):
        strokes[number] = replace(strokes[number], bounces=())
        found = smoother.estimate(track_of(strokes[number], sized, camera, smoother.model, smoother.surfaces))
        ball[number] = found.status is Status.OK and _spins(found, usual)
    for number in np.flatnonzero(~ball).tolist():
        true[strokes[number].rows] = UNKNOWN_RADIUS
    return kept_of(replace(chosen, strokes=tuple(strokes)), ball.tolist()), replace(seen, radii=true)


def _spin_across(estimate: Estimate) -> tuple[float, float]:
    """rad/s, first spin of an estimate about the level axis across its flight, and its standard deviation."""
    vx, vy, _ = estimate.states[0, VELOCITY]
    across = np.array([-vy, vx, 0.0]) / max(float(np.hypot(vx, vy)), LEVEL)
    sigma = np.sqrt(across @ estimate.covariances[0, SPIN, SPIN] @ across)
    return float(across @ estimate.states[0, SPIN]), float(sigma)


def _spins(estimate: Estimate, usual: float) -> bool:
    """True if its spin is likelier one of balls that spin so, rad/s, than just what carries a thing that hardly falls.

    Any spin up to `ANY_SPIN` is as likely there.
    """
    spin, sigma = _spin_across(estimate)
    variance = usual**2 + sigma**2
    return bool(-0.5 * (spin**2 / variance + np.log(2.0 * np.pi * variance)) > -np.log(2.0 * ANY_SPIN))
