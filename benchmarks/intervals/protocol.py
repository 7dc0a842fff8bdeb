"""Predicts 0.3 s after the first 0.25 s of every judged track, with noise from elsewhere.

Every second track is judged, then the others, so that a figure is of all tracks of a set. The noise "as usual" is the
package's constants with the scatter of the samples. "From observed parts" it comes from the observed parts of the
judged tracks, "from other tracks" from whole tracks of the other half.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np

from ballfg.arrays import Array
from ballfg.dynamics import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Settings, Smoother, Status, estimate_noise, predict_tracks
from ballfg.estimation.noise.estimate import spread_over
from ballfg.tracks import Track

OBSERVED: Final = 0.25  # s, observed part of a judged track
HORIZON: Final = 0.3  # s, predicted part
USUAL: Final = "usual noise"
OBSERVED_PARTS: Final = "noise from observed parts"
OTHER_TRACKS: Final = "noise from other tracks"
METHODS: Final = (USUAL, OBSERVED_PARTS, OTHER_TRACKS)


@dataclass(frozen=True)
class Judged:
    """Predictions of some tracks against what was measured.

    Attributes:
        errors: (n, 3) m, of all predicted samples.  sigmas: (n, 3) m.  tracks: (n,) number of the track of each.
        failed: number of tracks without an estimate.
    """

    errors: Array
    sigmas: Array
    tracks: Array
    failed: int

    @property
    def nis(self) -> Array:
        """(n,) squared errors in standard deviations, x, y and z added; the median of right ones is 2.37."""
        return np.asarray(((self.errors / self.sigmas) ** 2).sum(axis=1))

    def rmse_by_track(self) -> Array:
        """(t,) m, root mean square error of each track."""
        numbers = np.unique(self.tracks)
        squares = (self.errors**2).sum(axis=1)
        return np.sqrt([squares[self.tracks == number].mean() for number in numbers])


def judge(
    model: BallModel, surfaces: Surfaces, settings: Settings, tracks: Sequence[Track], jobs: int, first: int = 0
) -> Judged:
    """Predictions of tracks, numbered from `first` on; tracks that end before are left out."""
    errors, sigmas, numbers, failed = [np.zeros((0, 3))], [np.zeros((0, 3))], [np.zeros(0)], 0
    smoother = Smoother(model, surfaces, settings)
    results = predict_tracks(smoother, tracks, len(tracks), OBSERVED, horizon=HORIZON, jobs=jobs)
    for number, result in enumerate(results, start=first):
        if result.status is Status.FAILED:
            failed += 1
        elif len(result.times):
            errors.append(result.measured - result.positions)
            sigmas.append(result.sigmas)
            numbers.append(np.full(len(result.times), float(number)))
    return Judged(np.concatenate(errors), np.concatenate(sigmas), np.concatenate(numbers), failed)


def judged_both_ways(
    method: str,
    model: BallModel,
    surfaces: Surfaces,
    settings: Settings,
    tracks: Sequence[Track],
    jobs: int,
    position_known: bool = False,
) -> Judged:
    """All tracks judged, each half with noise that knows nothing of its later parts.

    Args: method: of `METHODS`.  settings: as usual.  position_known: whether the noise of positions is stated.
    """
    halves = tracks[0::2], tracks[1::2]
    parts = []
    for number, (judged, others) in enumerate((halves, halves[::-1])):
        shown = {
            USUAL: [],
            OBSERVED_PARTS: [track.opening(OBSERVED) for track in judged],
            OTHER_TRACKS: list(others),
        }[method]
        asked = spread_over(shown, len(shown))
        found = estimate_noise(model, surfaces, settings, asked, position_known=position_known, errors=False)
        own = settings if found is None else found.settings
        parts.append(judge(model, surfaces, own, judged, jobs, number * len(tracks)))
    return Judged(
        np.concatenate([part.errors for part in parts]),
        np.concatenate([part.sigmas for part in parts]),
        np.concatenate([part.tracks for part in parts]),
        sum(part.failed for part in parts),
    )
