"""Errors of predictions of tracks from several moments of each, as a function of numbers that the predictions rest on.

The moments are those of `moments`, and the errors of a track count together as a few independent ones: they hang
together along each axis. Predictions that miss by far count less [Huber, Robust estimation of a location parameter,
1964].
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Final, Self

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.estimation import Estimator, predict_tracks
from ballfg.estimation.batch import map_tracks
from ballfg.progress import Watch, unwatched
from ballfg.tracks import Track

NUMBERS: Final = 3.0  # What the errors of one track's predictions count as: they hang together, along each axis
FAR: Final = 2.0  # Whitened error, root mean square, from which on a prediction counts less
LEAST_PREDICTED: Final = 3  # Least number of predicted samples

Key = tuple[float, str]  # Observed share, name of the track
Prediction = tuple[Array, Array, Array]  # Errors (k, 3) and standard deviations, m; `TrackPrediction.carried`


def moments(share: float) -> tuple[float, float, float]:
    """Observed shares of a track about the one that is judged: half of it, itself, half-way from it to the end."""
    return share / 2.0, share, (1.0 + share) / 2.0


def weight(misses: Array, samples: Index, shares: int) -> Array:
    """(n,) weights of the squared errors of predictions: those of a track count as `NUMBERS`, less if they are far.

    Args: misses: (n,) root mean squared whitened errors.  samples: (n,) numbers of errors.  shares: of a track.
    """
    return np.asarray(NUMBERS / (shares * samples) * FAR / np.maximum(FAR, misses))


@dataclass(frozen=True)
class Forecasts:
    """Predictions as a function of p numbers, zero where they begin; made by `of`."""

    estimator: Callable[[Array], Estimator]  # The one with some numbers (p,)
    tracks: tuple[Track, ...]
    shares: tuple[float, ...]
    horizon: float  # s
    jobs: int
    sigmas: Mapping[Key, Array]  # (k, 3) m, of each prediction where the numbers are zero
    own: Array  # (e,) whitened errors of these; NaN where the estimate fails
    carried: Array  # (e, c) their covariances with the coefficients of the tracks, over the standard deviations

    @classmethod
    def of(
        cls,
        estimator: Callable[[Array], Estimator],
        size: int,
        tracks: Sequence[Track],
        shares: tuple[float, ...],
        horizon: float = np.inf,
        jobs: int = 1,
        watch: Watch = unwatched,
    ) -> Self:
        """Of tracks with at least `LEAST_PREDICTED` samples to predict.

        Args: size: of the estimator's argument.  horizon: s after the last observed stamp.
        """
        nothing = np.zeros(0)
        asked = cls(estimator, tuple(tracks), shares, horizon, jobs, {}, nothing, nothing)
        made = asked._made([np.zeros(size)], watch)[0]
        asked = replace(asked, sigmas={key: sigmas for key, (_, sigmas, _) in made.items()})
        rows = [(carried / sigmas[:, :, None]).reshape(sigmas.size, -1) for _, sigmas, carried in made.values()]
        return replace(asked, own=asked._whitened(made), carried=np.concatenate(rows or [np.zeros((0, 0))]))

    def errors(self, away: Sequence[Array], watch: Watch = unwatched) -> list[Array]:
        """(e,) whitened errors at each of some numbers (p,); NaN for predictions that fail there."""
        return [self._whitened(made) for made in self._made(away, watch)]

    @property
    def parts(self) -> dict[Key, slice]:
        """Where the errors of each prediction lie."""
        ends = np.cumsum([sigmas.size for sigmas in self.sigmas.values()]).tolist()
        return {key: slice(end - self.sigmas[key].size, end) for key, end in zip(self.sigmas, ends, strict=True)}

    def weights(self, errors: Array) -> Array:
        """(e,) square roots of the weights of errors; as of `weight`."""
        sizes = np.array([sigmas.size for sigmas in self.sigmas.values()])
        misses = np.sqrt([np.mean(errors[part] ** 2) for part in self.parts.values()])
        return np.repeat(np.sqrt(weight(misses, sizes, len(self.shares))), sizes)

    def _made(self, away: Sequence[Array], watch: Watch) -> list[dict[Key, Prediction]]:
        """Each prediction at each of some numbers."""
        work = partial(_predicted, [self.estimator(one) for one in away], self.shares, self.horizon)
        count = len(self.tracks)
        tracks = list(watch(map_tracks(work, self.tracks, count, self.jobs), count, "tracks predicted"))
        return [{key: one for track in tracks for key, one in track[k].items()} for k in range(len(away))]

    def _whitened(self, made: Mapping[Key, Prediction]) -> Array:
        found = [np.zeros(0)]
        for key, sigmas in self.sigmas.items():
            known = key in made and made[key][0].shape == sigmas.shape
            found.append((made[key][0] / sigmas).ravel() if known else np.full(sigmas.size, np.nan))
        return np.concatenate(found)


def _predicted(
    estimators: Sequence[Estimator], shares: Sequence[float], horizon: float, track: Track
) -> list[dict[Key, Prediction]]:
    """The predictions of one track by each estimator."""
    found: list[dict[Key, Prediction]] = [{} for _ in estimators]
    for made, estimator in zip(found, estimators, strict=True):
        for share in shares if len(track) > LEAST_PREDICTED else ():
            (one,) = predict_tracks(estimator, [track], 1, share * track.duration, horizon=horizon)
            if len(one.times) >= LEAST_PREDICTED:
                assert one.carried is not None
                made[share, one.name] = (one.positions - one.measured, one.sigmas, one.carried)
    return found
