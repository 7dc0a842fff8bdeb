"""Estimates strokes with given laws, and films them again as these laws would have them.

The derivatives of a stroke's objective by common strengths, its *scores*, do not scatter about zero where depth comes
from the motion. Those of the same strokes filmed again have the same bias (docs/derivations/diagnosis.md). How far
strokes scatter about the laws is the share of the usual noise that makes their sightings most probable.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, TypeVar

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.diagnosis.fit.effects import with_coefficients
from ballfg.diagnosis.one_view.picture import NAMES, Picture, known_bounces, slopes
from ballfg.dynamics import AnalyticModel, Surfaces
from ballfg.dynamics.motion.rollout import rollout
from ballfg.estimation import Estimate, Settings, Smoother, Status
from ballfg.estimation.batch import do_all
from ballfg.estimation.observations.sightings import sighted_track, sightings_of
from ballfg.learning.calibration.population import evidence
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY, VZ
from ballfg.tracks.track import Track
from ballfg.vision.projection import CameraBank

T = TypeVar("T")

HELD: Final = 0.1
"""Prior standard deviation of a strength within one stroke, in usual sizes: so small that all strokes share a value."""
TOGETHER: Final = 10  # Strokes of one task
BOUNCED: Final = 1.0  # m/s, rise of the vertical velocity that only a bounce makes


@dataclass(frozen=True)
class Laws:
    """Laws with values of all strengths that a diagnosis asks about."""

    model: AnalyticModel  # With all effects that are asked about
    surfaces: Surfaces  # Of the estimates
    settings: Settings  # Of the estimates
    sizes: Mapping[str, float]
    """Usual size of each strength, by name: parameters of the model, or of `picture.NAMES`."""
    values: Mapping[str, float]  # Their values

    @property
    def picture(self) -> Picture:
        """Errors of clock and lens."""
        return Picture.of(self.values)

    def moved(self, values: Mapping[str, float]) -> "Laws":
        """The laws with other values of some strengths."""
        return replace(self, model=with_coefficients(self.model, values), values={**self.values, **values})

    @property
    def smoother(self) -> Smoother:
        """The smoother with these laws, which leaves the strengths where they are."""
        held = {name: HELD * size for name, size in self.sizes.items() if name not in NAMES}
        return Smoother(self.model, self.surfaces, replace(self.settings, coefficients=held))


@dataclass(frozen=True)
class Stroke:
    """A stroke."""

    track: Track  # As it was filmed
    clock: float  # Of the laws that it was estimated with
    estimate: Estimate  # With these laws, at true times
    scores: Array  # (p,) in the order of the laws' strengths, in one over their usual sizes


def estimated(laws: Laws, smoother: Smoother, filmed: Track) -> Stroke | None:
    """The estimate and the scores of a track as it was filmed; None if its place is not known well."""
    track = laws.picture.seen_by(filmed, laws.model, laws.surfaces)
    estimate = smoother.estimate(track)
    if estimate.status is not Status.OK:
        return None
    names = list(smoother.settings.coefficients)
    places = [estimate.coefficient_names.index(name) for name in names]
    about, sigmas = np.array([laws.values[name] for name in names]), np.array([HELD * laws.sizes[n] for n in names])
    covariance = estimate.coefficient_covariance[np.ix_(places, places)]
    own = evidence(estimate.coefficients[places], covariance, about, sigmas).vector
    found = dict(zip(names, own.tolist(), strict=True))
    found |= dict(zip(NAMES, slopes(track, estimate, smoother.settings.sighting_loss).tolist(), strict=True))
    scores = np.array([found[name] * size for name, size in laws.sizes.items()])
    return Stroke(filmed, laws.picture.clock, estimate, scores) if np.isfinite(scores).all() else None


def filmed_again(stroke: Stroke, laws: Laws, seed: Sequence[int]) -> Track | None:
    """The track of a stroke's sightings if one like it flew by some laws, with their clock and lens and new noise.

    Returns: None if it would leave the camera's sight.
    """
    seen, rng = sightings_of(stroke.track), np.random.default_rng(seed)
    sightings, first = seen.sightings, stroke.track.times[0]
    since = (stroke.track.times[seen.state] + seen.delay - first) / (1.0 + stroke.clock)
    slower = (1.0 + laws.picture.clock) / (1.0 + stroke.clock)
    moments, place = np.unique(np.append(0.0, since), return_inverse=True)
    path = _flown(stroke, laws, moments, rng)[place[1:]]
    bank = CameraBank(tuple(laws.picture.camera(camera) for camera in seen.cameras))
    points = sightings.from_cameras(path[:, POSITION])
    pixels, _ = bank.jacobian(points, sightings.camera)
    if not np.isfinite(pixels).all():
        return None
    noise = np.linalg.cholesky(sightings.covariances) @ rng.standard_normal((len(pixels), 2, 1))
    radii = sightings.radii
    if radii is not None:
        at = torch.from_numpy(points.copy()), torch.from_numpy(sightings.camera)
        size = bank.radius(*at, laws.model.radius)[0].numpy() + radii[:, 1] * rng.standard_normal(len(radii))
        radii = np.stack((np.where(radii[:, 0] > 0.0, np.maximum(size, radii[:, 1]), 0.0), radii[:, 1]), axis=1)
    written = sightings.times[0] + slower * (sightings.times - sightings.times[0])
    filmed = replace(sightings, pixels=pixels + noise[..., 0], times=written, radii=radii)
    bounces, name = known_bounces(seen, slower), stroke.track.name
    return sighted_track(name, filmed, seen.cameras, model=laws.model, surfaces=laws.surfaces, bounces=bounces)


def _flown(stroke: Stroke, laws: Laws, moments: Array, rng: np.random.Generator) -> Array:
    """(k, 9) states at moments (k,) s, from zero on, of a stroke that may have begun as this one did."""
    noise, found = laws.settings.for_track(stroke.track).process, stroke.estimate
    bounces = np.array([contact.time for contact in found.contacts]) - found.times[0]
    slip = float(np.hypot(noise.contact_velocity, noise.contact_tangential))
    steps = np.diff(moments)
    scatter = np.linalg.cholesky(noise.flight(steps)) @ rng.standard_normal((len(steps), STATE_DIM, 1))
    path = [found.states[0] + np.linalg.cholesky(found.covariances[0]) @ rng.standard_normal(STATE_DIM)]
    for step, end, scattered in zip(steps, moments[1:], scatter[..., 0], strict=True):
        with torch.no_grad():
            given = torch.from_numpy(path[-1][None].copy()), torch.tensor([0.0, step], dtype=torch.float64)
            state = rollout(laws.model, *given, laws.surfaces)[0, 1].numpy()
        if state[VZ] - path[-1][VZ] > BOUNCED:
            nearest = bounces[np.argmin(np.abs(bounces - end + 0.5 * step))] if len(bounces) else end - 0.5 * step
            since = np.clip(end - nearest, 0.0, step)  # s after the bounce
            kick = rng.standard_normal(3) * (slip, slip, noise.contact_velocity)
            state[VELOCITY] += kick
            state[POSITION] += since * kick
            state[SPIN] += noise.contact_spin * rng.standard_normal(3)
        path.append(state + scattered)
    return np.array(path)


def all_estimated(laws: Laws, tracks: Sequence[Track], jobs: int) -> list[Stroke]:
    """The strokes of all tracks whose place is known well."""
    found = do_all([partial(_estimates, laws, part) for part in parts_of(tracks)], jobs)
    return [one for part in found for one in part]


def scores_again(laws: Laws, flown: Sequence[tuple[Laws, int]], strokes: Sequence[Stroke], jobs: int) -> list[Array]:
    """Scores (n, p) under some laws of the strokes filmed again, for each of other laws and a seed of the noise.

    The noise of a stroke is that of its number and the seed, so that changes of laws show at once.
    """
    parts = parts_of(list(enumerate(strokes)))
    found = iter(do_all([partial(_again, laws, *others, part) for others in flown for part in parts], jobs))
    return [np.concatenate([next(found) for _ in parts]) for _ in flown]


def parts_of(items: Sequence[T]) -> list[Sequence[T]]:
    """The items in tasks of `TOGETHER`."""
    return [items[k : k + TOGETHER] for k in range(0, len(items), TOGETHER)]


def _estimates(laws: Laws, tracks: Sequence[Track]) -> list[Stroke]:
    smoother = laws.smoother
    return [stroke for track in tracks if (stroke := estimated(laws, smoother, track)) is not None]


def _again(laws: Laws, others: Laws, seed: int, strokes: Sequence[tuple[int, Stroke]]) -> Array:
    """(n, p) scores of the strokes whose place is known well this time too."""
    filmed = (filmed_again(stroke, others, (seed, number)) for number, stroke in strokes)
    found = _estimates(laws, [track for track in filmed if track is not None])
    return np.array([stroke.scores for stroke in found]).reshape(len(found), len(laws.sizes))


SHARES: Final = (1.0, 0.5, 0.25, 0.125, 0.0625)
SCALED: Final = ("acceleration", "spin", "contact_velocity", "contact_tangential", "contact_spin")


def with_share(settings: Settings, share: float) -> Settings:
    """Settings with a share of the noise of flights and bounces of one camera's tracks."""
    process = replace(settings.process, **{name: share * getattr(settings.process, name) for name in SCALED})
    return replace(settings, process=process, one_view_acceleration=share * settings.one_view_acceleration)


def share_of(settings: Settings) -> float:
    """The share of the usual noise that settings have."""
    return settings.one_view_acceleration / Settings.one_view_acceleration


def with_likeliest_noise(laws: Laws, tracks: Sequence[Track], jobs: int) -> Laws:
    """The laws with the share of their settings' noise that makes the sightings of tracks most probable."""
    offered = [replace(laws, settings=with_share(laws.settings, share)) for share in SHARES]
    found = do_all([partial(_densities, one, part) for one in offered for part in parts_of(tracks)], jobs)
    densities = np.concatenate(found).reshape(len(SHARES), len(tracks))
    densities += -np.log(SHARES)[:, None] * [[STATE_DIM * (len(track) - 1) for track in tracks]]
    known = np.isfinite(densities).all(axis=0)
    return offered[int(np.argmax(densities[:, known].sum(axis=1)))]


def _densities(laws: Laws, tracks: Sequence[Track]) -> list[float]:
    """Logarithm of the density of each track's sightings, but for that of the noise's size; NaN without a minimum."""
    smoother, found = laws.smoother, list[float]()
    for filmed in tracks:
        track = smoother.prepared(laws.picture.seen_by(filmed, laws.model, laws.surfaces))
        problem, solution = smoother.solved(track.since_first())
        step, error = solution.minimum.step, smoother.result(problem, solution).error
        found.append(float("nan") if step is None else -error - step.root.log_determinant)
    return found
