"""Calibrates the model that a residual network starts from, and lets the network replace it only where it surely gains.

The training tracks choose among the candidates of `kind: auto`; the best one is the network's base. The validation
tracks then compare the two by the log score of predictions, intervals included: tens of tracks seldom tell more than a
calibration and its population hold.
"""

import copy
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

from ballfg.dynamics import AnalyticModel, load_model, save_model
from ballfg.dynamics.domain import Domain
from ballfg.dynamics.nominal import inertia_factor
from ballfg.estimation import Settings
from ballfg.estimation.configure import dataset_surfaces, fitted_settings
from ballfg.estimation.noise.estimate import NoiseEstimate
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.auto import NEAR, UNLEARNED, Choice, choose_candidate, compared
from ballfg.learning.calibration.predicting import LEAST, finished
from ballfg.learning.calibration.problem import Problem, pose
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.training import ObserveConfig, TrainConfig
from ballfg.learning.evaluation import TrackScore, judge_track
from ballfg.learning.split import tracks_of, training_split
from ballfg.learning.training_data import analytic_model, open_dataset
from ballfg.progress import Watch
from ballfg.tracks import Dataset, Track

CALIBRATED: Final = "calibrated.yaml"  # File of the calibrated model
BASE: Final = "base.yaml"
"""File of the same with one value of each coefficient for all tracks, from which the network starts."""
WITHOUT: Final = "calibrated, without network"
NETWORK: Final = "with network"


@dataclass(frozen=True)
class Start:
    """Files of a calibrated model, and the tracks of a dataset that compare a network with it."""

    calibrated: Path
    base: Path
    dataset: Dataset
    judge: tuple[str, ...]  # names of these tracks
    observe: ObserveConfig  # their observed part

    def compare(self, network: Path) -> Choice | None:
        """The calibrated model and a network's file by their predictions; None: no track could be judged by both."""
        before, after = (self._scores(path) for path in (self.calibrated, network))
        judged = any(b and a for b, a in zip(before, after, strict=True))
        return compared({WITHOUT: before, NETWORK: after}) if judged else None

    def _scores(self, path: Path) -> list[TrackScore | None]:
        ball = self.dataset.info.ball
        model = load_model(path, radius=ball.radius, inertia_factor=inertia_factor(ball))
        settings = fitted_settings(self.dataset, model)
        estimator = make_estimator("smoother", model, dataset_surfaces(self.dataset), settings)
        return [
            judge_track(estimator, track, self._opening(track) / track.duration, NEAR)
            for track in tracks_of(self.dataset, self.judge)
            if self._opening(track) < track.duration
        ]

    def _opening(self, track: Track) -> float:
        """s, duration of the observed part."""
        if self.observe.seconds is not None:
            return self.observe.seconds
        assert self.observe.samples is not None
        return float(track.since_first().seconds[min(self.observe.samples, len(track)) - 1])


def calibrated_start(config: TrainConfig, folder: Path, *, resume: bool, watch: Watch) -> Start | None:
    """Calibrate on the training tracks, as `kind: auto` does, and write both files into the folder of the run.

    Args: resume: True to take the files of the run that continues.
    Returns: None for a network that corrects nothing, several datasets, or fewer training tracks than `LEAST`.
    Raises: ValueError, FileNotFoundError: bad input.
    """
    if not config.architecture.residual or len(config.data or ()) != 1:
        return None
    (path,) = config.data or ()
    dataset = open_dataset(path)
    names = [track.name for track in dataset]
    train, validation = training_split([(0, track) for track in dataset], config.split, config.seed)
    if len(train) < LEAST or not validation:
        return None
    fit, judge = (tuple(names[k] for k in part) for part in (train, validation))
    start = Start(folder / CALIBRATED, folder / BASE, dataset, judge, config.observe)
    if not (resume and start.base.is_file()):
        model = analytic_model(config.model, dataset.info.ball)
        problem = pose(dataset, model, CalibrationConfig(kind="auto", data=path))
        problem = replace(problem, split=replace(problem.split, fit=fit, judge=judge))
        choice, found = choose_candidate(problem, watch)
        print(f"the training tracks choose what the network starts from:\n{choice.table()}\n{choice.verdict()}")
        if choice.chosen not in UNLEARNED:
            one = found[choice.chosen]
            posed, made = one.problem, finished(one.problem, one.steps[-1], watch, errors=False)
            model = made.model
            describe(model, posed, made.settings, made.noise)
        save_model(model, start.calibrated)
        base = copy.copy(model)
        base.variations = {}
        save_model(base, start.base)
    return start


def describe(model: AnalyticModel, problem: Problem, settings: Settings, noise: NoiseEstimate | None) -> None:
    """Give a calibrated model its population's spins, the noise, and the extent of the fitted tracks, for a file."""
    model.noise, model.spins = None if noise is None else noise.noise, settings.spins
    if isinstance(problem.dataset, Dataset):
        fitted = (track for track in problem.dataset if track.name in problem.split.fit)
        model.domain = Domain.of(fitted, [problem.dataset.info.ball.radius])
