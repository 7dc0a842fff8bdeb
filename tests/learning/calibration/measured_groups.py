"""What calibration, groups and a correction do for predictions of measured shots: every second one trains.

`python -m tests.learning.calibration.measured_groups FOLDER... [--half 0] [--first N]` observes 0.25 s of each other
shot, predicts 0.3 s, and prints median errors and the share of coordinates in their 90 % intervals: calibrated, with
groups, with groups and a correction of drag and lift, and what `kind: auto` chooses of them. With `--tracks 5 10 20`
and `--draws 30`, so many of the training shots are drawn so often, and the mean log score of `auto` is compared with
that of `calibrate`. Where a correction could be calibrated, the processor time of an estimate with it is compared with
that of the groups alone.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.benchmarks.dynamics.measured import measured_task
from ballfg.dynamics import AnalyticModel, BallModel, load_model, nominal_model, save_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import Settings, Status, predict_tracks
from ballfg.estimation.noise.forecasts import NINETY
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.auto import (
    CALIBRATED,
    CORRECTED,
    GROUPED,
    NOMINAL,
    Fitted,
    choose_candidate,
)
from ballfg.learning.calibration.calibrate import fitted_noise
from ballfg.learning.calibration.predicting import finished as finished_calibration
from ballfg.learning.calibration.problem import Problem, pose
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import AUTO
from ballfg.learning.evaluation import log_density
from ballfg.tracks import Dataset, Track, read_dataset, write_dataset
from ballfg.tracks.info import DatasetInfo

TURNS: Final = 5  # Repetitions of a measurement of time
TIMED: Final = 12  # Tracks of it


@dataclass(frozen=True)
class Halves:
    """Shots that train, and those that judge, up to the end of what is predicted."""

    info: DatasetInfo
    train: tuple[Track, ...]
    judge: tuple[Track, ...]

    @classmethod
    def of(cls, folder: Path, half: int, first: int | None) -> Halves:
        """Of a dataset. Args: half: which one trains.  first: so many first tracks."""
        task = measured_task(read_dataset(folder), 1, first)
        train, judge = (task.train, task.validation)[:: 1 if half == 0 else -1]
        until = (shot.track.until(float(shot.track.times[shot.judged - 1])) for shot in judge)
        return cls(task.info, tuple(shot.track for shot in train), tuple(until))

    def judged(self, chosen: Sequence[int]) -> dict[str, Array]:
        """(n, 5) RMSE, mm, log score, and share in 90 % intervals by axis, %, of the judging tracks, by kind.

        Args: chosen: numbers of the training tracks.
        """
        with tempfile.TemporaryDirectory() as folder:
            dataset, model = self.written(Path(folder) / "data", chosen), nominal_model(self.info.ball)
            problem = pose(dataset, model, CalibrationConfig(split="label"))
            begun = time.process_time()
            choice, candidates = choose_candidate(problem)
            print(choice.table(), choice.verdict(), sep="\n")
            print(f"{time.process_time() - begun:.0f} s of processor time", flush=True)
            kinds: dict[str, Fitted | str] = {choice.chosen: choice.chosen} | dict(candidates)
            ready = {name: finished(problem, one) for name, one in kinds.items()}
            found = {name: errors(problem.surfaces, *one, self.judge) for name, one in ready.items()}
            if CORRECTED in ready:
                without, corrected = times(problem.surfaces, (ready[GROUPED], ready[CORRECTED]), self.judge)
                print(f"an estimate with a correction takes {corrected / without:.2f} times as long as without")
            return found | {AUTO: found[choice.chosen]}

    def written(self, folder: Path, chosen: Sequence[int]) -> Dataset:
        """A dataset of some training tracks, and the judging ones, with the label `split`."""
        parts = (("train", [self.train[k] for k in chosen]), ("test", self.judge))
        tracks = [
            replace(track, labels={**track.labels, "split": split}, name=f"{number:04}")
            for number, (split, track) in enumerate((split, track) for split, part in parts for track in part)
        ]
        write_dataset(folder, self.info, tracks)
        return read_dataset(folder)


def finished(problem: Problem, made: Fitted | str) -> tuple[AnalyticModel, Settings]:
    """The model and settings of a calibration, or of a candidate without one, with the noise that the tracks show."""
    if isinstance(made, Fitted):
        found = finished_calibration(made.problem, made.steps[-1], errors=False)
        model, settings, noise = found.model, found.settings, found.noise
    else:
        model, settings = problem.model, problem.settings
        settings = replace(settings, coefficients={}) if made == NOMINAL else settings
        noise = fitted_noise(problem, model, settings, errors=False)
    return model, settings if noise is None else noise.settings


def errors(surfaces: Surfaces, model: BallModel, settings: Settings, judged: Sequence[Track]) -> Array:
    """As `Halves.judged`."""
    estimator = make_estimator("smoother", model, surfaces, settings)
    rows = []
    for one in predict_tracks(estimator, judged, len(judged), 0.25, horizon=0.3):
        if one.status is Status.OK and len(one.times):
            away = one.positions - one.measured
            whitened = away / one.sigmas
            rmse, score = np.sqrt((away**2).sum(axis=1).mean()), log_density(whitened, one.sigmas).mean()
            rows.append([1e3 * rmse, score, *(100.0 * (np.abs(whitened) <= NINETY).mean(axis=0))])
        else:
            rows.append([np.nan] * 5)
    return np.array(rows)


def times(surfaces: Surfaces, models: Sequence[tuple[AnalyticModel, Settings]], judged: Sequence[Track]) -> Array:
    """(k,) s of processor time of estimates of some tracks by each of k models: the shortest of some turns."""
    smoothers, tracks = [], judged[:TIMED]
    for model, settings in models:
        with tempfile.TemporaryDirectory() as folder:  # as a user has it: with known weights
            save_model(model, Path(folder) / "model.yaml")
            smoothers.append(make_estimator("smoother", load_model(Path(folder) / "model.yaml"), surfaces, settings))
    taken = np.empty((TURNS, len(smoothers), len(tracks)))
    for turn in taken:
        for row, smoother in zip(turn, smoothers, strict=True):
            for k, track in enumerate(tracks):
                begun = time.process_time()
                smoother.estimate(track)
                row[k] = time.process_time() - begun
    return np.asarray(taken.min(axis=0).sum(axis=1))


def numbers_of(rows: Array) -> str:
    """What a line says of rows of `errors`."""
    held = np.nanmean(rows[:, 2:], axis=0)
    numbers = f"median {np.nanmedian(rows[:, 0]):.1f} mm, log score {np.nanmean(rows[:, 1]):.3f}"
    return f"{numbers}, held {held.mean():.0f} % ({' / '.join(f'{axis:.0f}' for axis in held)})"


def few(halves: Halves, size: int, draws: int, seed: int) -> str:
    """A line on `auto` against `calibrate` with a few training tracks, drawn several times."""
    rng, gains = np.random.default_rng([seed, size]), []
    for _ in range(draws):
        chosen = np.sort(rng.permutation(len(halves.train))[:size]).tolist()
        found = halves.judged(chosen)
        gains.append(np.nanmean(found[AUTO] - found[CALIBRATED], axis=0)[1])
        print(f"{gains[-1]:+.3f}", flush=True)
    error = np.std(gains, ddof=1) / np.sqrt(draws) if draws > 1 else np.nan
    worst = f"least {min(gains):+.3f}, largest {max(gains):+.3f}"
    return (
        f"{size} tracks, {draws} draws: auto's log score less calibrate's {np.mean(gains):+.3f} ± {error:.3f}; {worst}"
    )


def main() -> None:
    """Prints a line for each folder and kind, or for each folder and number of tracks."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--half", type=int, default=0, choices=(0, 1), help="which half trains")
    parser.add_argument("--first", type=int, default=None, help="so many first tracks")
    parser.add_argument("--tracks", nargs="+", type=int, help="numbers of training tracks to draw")
    parser.add_argument("--draws", type=int, default=30)
    parser.add_argument("--seed", type=int, default=0)
    given = parser.parse_args()
    for folder in given.folders:
        halves = Halves.of(folder, given.half, given.first)
        for size in given.tracks or ():
            print(f"{folder.name}, {few(halves, size, given.draws, given.seed)}", flush=True)
        kinds = {} if given.tracks else halves.judged(range(len(halves.train)))
        for kind, rows in kinds.items():
            print(f"{folder.name}, {kind}: {numbers_of(rows)}", flush=True)


if __name__ == "__main__":
    main()
