"""Cuts tracks into shots for learning: an observed part, a part to predict, and the events."""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ballfg.dynamics.model import BallModel
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Settings, Smoother
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.tracks import Track

LEAST_OBSERVED = 5  # Samples that an estimate needs
LEAST_PREDICTED = 3  # Samples that a prediction is judged on


@dataclass(frozen=True)
class TrainingShot:
    """One track, cut into an observed part and a part to predict."""

    track: Track  # the undisturbed part of the flight, up to the first hit
    observed: int  # number of samples that the estimate sees; they come first
    usable: NDArray[np.bool_]  # (n,) bool, samples that measure the ball
    segmentation: Segmentation  # events of the observed part
    settings: Settings  # of the estimator, before anything is learned
    surfaces: Surfaces
    room: str = ""  # name of the dataset

    @property
    def name(self) -> str:
        """The track's name."""
        return self.track.name

    @property
    def seen(self) -> Track:
        """The observed part."""
        return part(self.track, self.observed)


def part(track: Track, count: int) -> Track:
    """The first samples of a track."""
    return track.until(float(track.times[count - 1]))


def shots_of(
    tracks: Iterable[Track],
    model: BallModel,
    surfaces: Surfaces,
    settings: Settings,
    *,
    samples: int | None,
    seconds: float | None,
) -> Iterator[tuple[Track, TrainingShot | str]]:
    """Each track with its shot, or the reason why it gives none. Observed are so many samples, or seconds.

    The model finds the events; an analytic one will do.
    """
    smoother = Smoother(model, surfaces, settings)
    for given in tracks:
        track = given.since_first()
        whole = smoother.segment(track)
        end = int(whole.hits[0]) + 1 if len(whole.hits) else len(track)
        track, usable = part(track, end), whole.usable[:end]
        observed = samples if seconds is None else len(track.opening(seconds))
        assert observed is not None
        if observed < LEAST_OBSERVED or usable[:observed].sum() < LEAST_OBSERVED:
            yield given, f"fewer than {LEAST_OBSERVED} usable samples are observed"
        elif usable[observed:].sum() < LEAST_PREDICTED:
            least = f"fewer than {LEAST_PREDICTED} usable samples"
            yield given, f"{least} follow the observed part before the ball is hit"
        else:
            events = smoother.segment(part(track, observed))
            yield given, TrainingShot(track, observed, usable, events, smoother.settings, smoother.surfaces)
