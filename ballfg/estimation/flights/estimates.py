"""Estimates the flights of a track, and leaves what is no flight as it was measured."""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace
from typing import Final, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.estimation.estimator import Estimator
from ballfg.estimation.flights.labels import SHORTEST, Labels, label_samples
from ballfg.estimation.measurement.position_noise import estimate_position_noise
from ballfg.estimation.plausible import measured_only
from ballfg.estimation.result import Estimate, Label, Status
from ballfg.estimation.segmentation.physics import physics_of
from ballfg.estimation.settings import Settings, sample_sigmas
from ballfg.state import STATE_DIM
from ballfg.tracks import Track

UNKNOWN_SPEED: Final = 5.0  # m/s. Standard deviation of the velocity of a ball that does not fly, per axis


@dataclass(frozen=True, eq=False)
class Seen:
    """A track with its labels, and first and last sample of each part that an estimator explains: it holds a flight."""

    track: Track
    labels: Labels
    parts: list[tuple[int, int]]

    @classmethod
    def of(cls, estimator: Estimator, track: Track) -> Self:
        """A track as an estimator may explain it: flights, and rolling and rest on its surfaces."""
        estimator.prepared(track)  # refuses what is no track before anything looks at it
        levels = [height + estimator.model.radius for height in estimator.surfaces.heights()]
        labels = label_samples(track, physics_of(estimator.model), levels)
        known = labels.estimable(track.positions[:, 2], levels)
        if known.all():
            return cls(track, labels, [(0, len(track) - 1)])
        ends = np.flatnonzero(np.diff(known, prepend=False, append=False)).reshape(-1, 2)
        flying = labels.values == Label.FLIGHT
        parts = [(int(a), int(b) - 1) for a, b in ends if flying[a:b].sum() >= SHORTEST]
        return cls(track, labels, parts)

    @property
    def whole(self) -> bool:
        """True if nothing but the ball's flight is in the track."""
        return self.parts == [(0, len(self.track) - 1)]

    def labelled(self, estimate: Estimate, begin: int = 0) -> Estimate:
        """An estimate of samples from `begin` on, with their labels."""
        return replace(estimate, labels=self.labels.values[begin : begin + len(estimate)])

    def estimated(self, estimator: Estimator) -> Estimate:
        """The estimate of the parts; the rest stays as measured."""
        cut = (self.track.between(*self.track.times[[first, last]].tolist()) for first, last in self.parts)
        return _assembled(estimator, self.track, self.labels, self.parts, [estimator.estimate(part) for part in cut])


def estimated(estimator: Estimator, track: Track) -> Estimate:
    """The estimate of a track with its labels; a track that only flies is estimated as a whole."""
    seen = Seen.of(estimator, track)
    return seen.labelled(estimator.estimate(track)) if seen.whole else seen.estimated(estimator)


def with_shown_noise(estimator: Estimator, track: Track) -> Settings:
    """The settings of an estimator, with the noise of positions that the scatter of a track's flights shows.

    As they are for positions whose noise is known. Raises: as `Estimator.prepared`.
    """
    if track.sigmas is not None or track.rough or estimator.model.states_position_noise:
        return estimator.settings
    labels = Seen.of(estimator, track).labels
    flying = labels.values == Label.FLIGHT  # not at rest, where the noise may be another one, nor outliers
    runs = (first + np.flatnonzero(flying[first : last + 1]) for first, last in labels.stretches(Label.FLIGHT))
    flights = [Track(track.times[run], track.positions[run]) for run in runs]
    x, y, z = estimate_position_noise(flights or [track]).tolist()
    return replace(estimator.settings, position_noise=(x, y, z))


def in_sections(estimator: Estimator, track: Track) -> Iterator[Estimate]:
    """`estimated` in consecutive parts, where the estimator has them and nothing holds the ball."""
    seen = Seen.of(estimator, track)
    if not seen.whole:
        yield seen.estimated(estimator)
        return
    begin = 0
    for part in estimator.in_sections(track):
        yield seen.labelled(part, begin)
        begin += len(part)


def _assembled(
    estimator: Estimator, track: Track, labels: Labels, parts: list[tuple[int, int]], found: list[Estimate]
) -> Estimate:
    """One estimate of a track from those of its parts; coefficients are those of the last part."""
    n, settings = len(track), estimator.settings
    slow = replace(settings, velocity_prior=UNKNOWN_SPEED)
    states, covariances = measured_only(track.positions, sample_sigmas(settings, n, track.sigmas), slow)
    quality, sides = np.zeros(n, np.int8), np.zeros((n, STATE_DIM, STATE_DIM))
    hits, contacts, innovations = list[int](), [], dict[str, list[Array]]()
    for (first, last), one in zip(parts, found, strict=True):
        own = slice(first, last + 1)
        states[own], covariances[own] = one.states, one.covariances
        quality[own] = one.quality if len(one.quality) else 0
        sides[own] = one.other_sides if len(one.other_sides) else 0.0
        hits += (one.hits + first).tolist()
        contacts += [replace(contact, interval=contact.interval + first) for contact in one.contacts]
        for name, values in one.innovations.items():
            innovations.setdefault(name, []).append(values)
    share = float(np.mean(labels.values == Label.FLIGHT))
    notes = (f"{int(100 * share)} % of the samples are flight, in {len(parts)} parts; the rest is as measured",)
    whole = Estimate(track.name, track.times, states, covariances, _status(found), notes=notes, labels=labels.values)
    if not found:
        return replace(whole, innovations={"position": np.full((n, 3), np.nan)}, quality=quality)
    final = found[-1]
    cross = np.zeros((n, STATE_DIM, len(final.coefficients)))
    if final.cross_covariances.size:
        cross[parts[-1][0] : parts[-1][1] + 1] = final.cross_covariances
    return replace(
        whole,
        innovations={name: np.concatenate(parts) for name, parts in innovations.items()},
        coefficient_names=final.coefficient_names,
        coefficients=final.coefficients,
        coefficient_covariance=final.coefficient_covariance,
        cross_covariances=cross,
        contacts=tuple(contacts),
        hits=np.array(hits, dtype=np.int64),
        quality=quality,
        error=sum(one.error for one in found),
        iterations=sum(one.iterations for one in found),
        world=final.world,
        other_sides=sides,
        struck={parts[-1][0] + k: share for k, share in final.struck.items()},
    )


def _status(found: list[Estimate]) -> Status:
    """That of most samples of the flights."""
    counts = Counter[Status]()
    for one in found:
        counts[one.status] += len(one)
    return counts.most_common(1)[0][0] if counts else Status.NO_FLIGHT
