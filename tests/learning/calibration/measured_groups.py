"""What groups and a correction do for predictions of measured shots: every second one calibrates, the others judge.

`python -m tests.learning.calibration.measured_groups FOLDER... [--half 0] [--first N]` observes 0.25 s of each shot,
predicts 0.3 s, and prints median errors and the share of coordinates in their 90 % intervals: calibrated, with groups,
with groups and a correction of drag and lift, and what `kind: auto` chooses of them.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ballfg.benchmarks.dynamics.measured import measured_task
from ballfg.dynamics import nominal_model
from ballfg.estimation import Status, predict_tracks
from ballfg.estimation.registry import make_estimator
from ballfg.learning.calibration.auto import CALIBRATED, CORRECTED, GROUPED, NOMINAL, choose_candidate, config_of
from ballfg.learning.calibration.calibrate import (
    calibrate,
    fitted_noise,
    population_model,
    population_settings,
    pose,
    pose_correction,
)
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import AUTO
from ballfg.learning.evaluation import NINETY
from ballfg.tracks import Track, read_dataset, write_dataset


def measure(folder: Path, half: int, first: int | None, kind: str) -> tuple[float, float, tuple[float, ...]]:
    """Median RMSE, mm, share of coordinates in their 90 % intervals, %, and the same for each axis."""
    task = measured_task(read_dataset(folder), 1, first)
    parts = (task.train, task.validation) if half == 0 else (task.validation, task.train)
    tracks = [
        replace(shot.track, labels={**shot.track.labels, "split": split})
        for split, part in zip(("train", "test"), parts, strict=True)
        for shot in part
    ]
    judged = [shot.track.until(float(shot.track.times[shot.judged - 1])) for shot in parts[1]]
    with tempfile.TemporaryDirectory() as written:
        write_dataset(Path(written) / "data", task.info, tracks)
        dataset, model = read_dataset(Path(written) / "data"), nominal_model(task.info.ball)
        begun = time.monotonic()
        config = CalibrationConfig(split="label")
        if kind == AUTO:
            choice = choose_candidate(pose(dataset, model, config))
            print(choice.table(), choice.verdict(), sep="\n")
            kind = choice.chosen
        problem = pose(dataset, model, config_of(config, kind))
        settings, noise = problem.settings, None
        if kind != NOMINAL:
            *_, last = calibrate(problem)
            if kind == CORRECTED:
                problem = pose_correction(problem, last)
                *_, last = calibrate(problem)
            model, settings = population_model(problem, last), population_settings(problem, last)
        noise = fitted_noise(problem, model, settings)
        print(f"{time.monotonic() - begun:.0f} s")
    found = settings if noise is None else noise.settings
    return errors(make_estimator("smoother", model, problem.surfaces, found), judged)


def errors(estimator: object, judged: Sequence[Track]) -> tuple[float, float, tuple[float, ...]]:
    """As `measure`."""
    rmse, held = [], []
    for one in predict_tracks(estimator, judged, len(judged), 0.25, horizon=0.3):  # type: ignore[arg-type]
        if one.status is Status.OK and len(one.times):
            away = one.positions - one.measured
            rmse.append(float(np.sqrt((away**2).sum(axis=1).mean())))
            held.append((np.abs(away / one.sigmas) <= NINETY).mean(axis=0))
    axes = 100.0 * np.mean(held, axis=0)
    return 1e3 * float(np.median(rmse)), float(axes.mean()), tuple(axes.tolist())


def main() -> None:
    """Prints a line for each folder and kind."""
    torch.set_num_threads(1)
    parser = argparse.ArgumentParser()
    parser.add_argument("folders", nargs="+", type=Path)
    parser.add_argument("--half", type=int, default=0, choices=(0, 1), help="which half calibrates")
    parser.add_argument("--first", type=int, default=None, help="so many first tracks")
    kinds = (CALIBRATED, GROUPED, CORRECTED, AUTO)
    parser.add_argument("--kinds", nargs="+", choices=kinds, default=kinds)
    given = parser.parse_args()
    for folder in given.folders:
        for kind in given.kinds:
            median, held, axes = measure(folder, given.half, given.first, kind)
            shown = " / ".join(f"{axis:.0f}" for axis in axes)
            print(f"{folder.name}, {kind}: median {median:.1f} mm, held {held:.0f} % ({shown})", flush=True)


if __name__ == "__main__":
    main()
