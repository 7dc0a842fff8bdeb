"""Judges the models of a calibration by their forecasts within tracks."""

from collections.abc import Mapping, Sequence
from functools import partial
from itertools import chain

import numpy as np

from ballfg.dynamics import AnalyticModel
from ballfg.estimation import Estimator, Settings
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.problem import Problem
from ballfg.learning.evaluation import TrackScore, judge_track
from ballfg.learning.split import tracks_of
from ballfg.progress import Watch, unwatched
from ballfg.tracks import Track


def score(
    problem: Problem, model: AnalyticModel, settings: Settings, watch: Watch = unwatched
) -> tuple[TrackScore | None, ...]:
    """Scores of the judging tracks, in order, by a model with its settings."""
    config = problem.config
    horizon = np.inf if config.horizon is None else config.horizon
    return judged(problem, [(model, settings)], problem.split.judge, (config.observed_share,), horizon, watch)


def judged(
    problem: Problem,
    made: Sequence[tuple[AnalyticModel, Settings]],
    names: tuple[str, ...],
    shares: Sequence[float],
    horizon: float,
    watch: Watch,
) -> tuple[TrackScore | None, ...]:
    """Scores of the forecasts of some tracks from some shares of each, track after track.

    Args: made: model and settings of each fold of the tracks; one of all tracks is the fold of all.
    """
    smoothers = [make_estimator("smoother", model, problem.surfaces, settings) for model, settings in made]
    of_track = {name: smoothers[k % len(smoothers)] for k, name in enumerate(names)}
    forecasts, tracks = partial(_forecasts, of_track, shares, horizon), tracks_of(problem.dataset, names)
    scores = map_tracks(forecasts, tracks, len(names), problem.jobs)
    return tuple(chain.from_iterable(watch(scores, len(names), "tracks judged")))


def _forecasts(
    smoothers: Mapping[str, Estimator], shares: Sequence[float], horizon: float, track: Track
) -> list[TrackScore | None]:
    """Scores of one track's forecasts from each share of it, by its own smoother."""
    return [judge_track(smoothers[track.name], track, share, horizon) for share in shares]
