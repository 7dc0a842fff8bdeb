"""A calibration from config to results: what `ballfg-train` does for the kind `calibrate`."""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import torch

from ballfg.dynamics import save_model
from ballfg.learning.calibration import checkpoint as checkpoints
from ballfg.learning.calibration.calibrate import Problem, Step, calibrate, has_ended, population_settings, pose, score
from ballfg.learning.calibration.coefficients import analytic_model, with_values
from ballfg.learning.calibration.picture import draw
from ballfg.learning.calibration.report import compare, report, table
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import summary
from ballfg.learning.run import run_folder as files
from ballfg.progress import Watch
from ballfg.tracks import read_dataset


def run_calibration(config: CalibrationConfig, folder: Path, *, resume: bool, jobs: int, watch: Watch) -> None:
    """Calibrate, or continue to, and write a folder.

    Args:
        config: how.
        folder: to write; that of the earlier run if it is to `resume`.
        jobs: processes where the config names none.
        watch: sees the tracks pass, for instance to show progress.

    Raises: ValueError, FileNotFoundError: what the user can mend. KeyboardInterrupt: after Ctrl-C; the steps are kept.
    """
    files.check(folder, config, resume=resume)
    problem = _pose(config, jobs)
    steps = checkpoints.read_checkpoint(folder, problem) if resume else []
    files.start(folder, config)
    print(f"{folder / files.CONFIG}: the config; {len(problem.split.fit)} tracks fit, {len(problem.split.judge)} judge")
    try:
        _steps(problem, steps, folder, watch)
        _finish(problem, steps, folder, watch)
    except KeyboardInterrupt:
        print(f"{len(steps)} steps are kept; continue with --resume {folder}", file=sys.stderr)
        raise


def _pose(config: CalibrationConfig, jobs: int) -> Problem:
    """Open dataset and model; what was repaired is said on stderr."""
    if config.data is None:
        raise ValueError("a dataset is needed; got none. Give --data FOLDER, or 'data' in the config.")
    torch.set_num_threads(1)  # the batches are small: threads cost more than they bring
    dataset = read_dataset(config.data)
    for note in dataset.notes:
        print(f"note: {note}", file=sys.stderr)
    return pose(dataset, analytic_model(config.model, dataset.info.ball.radius), config, config.jobs or jobs)


def _steps(problem: Problem, steps: list[Step], folder: Path, watch: Watch) -> None:
    """Take the steps that are left; a checkpoint and a line after each."""
    begun = time.monotonic()
    for step in calibrate(problem, tuple(steps), watch=watch):
        steps.append(step)
        checkpoints.write_checkpoint(folder, problem, steps)
        now = time.monotonic()
        left = (problem.config.max_iterations - step.number) * (now - begun)
        begun = now
        print(_line(problem, step, left), flush=True)


def _line(problem: Problem, step: Step, left: float) -> str:
    """One line on a step: coefficients, error, how long it can still take."""
    judged = summary([score for score in step.scores if score is not None])
    values = ", ".join(
        f"{name} {value:.5g}" + (f" ± {step.sigma[k]:.2g}" if step.sigma else "")
        for k, (name, value) in enumerate(zip(problem.chosen.names, step.mean, strict=True))
    )
    parts = [f"iteration {step.number}: {values}"]
    parts += [] if step.moved is None else [f"moved {step.moved:.2g} sigma"]
    parts += ["no track judged"] if judged is None else [f"median RMSE {1e3 * judged.rmse_median:.2f} mm"]
    parts += [f"{len(step.skipped)} tracks skipped"] if step.skipped else []
    if step.moved is not None and not has_ended(problem.config, step):  # step 0 fits nothing: its time says little
        parts.append(f"at most about {left:.0f} s left")
    return "; ".join(parts)


def _finish(problem: Problem, steps: Sequence[Step], folder: Path, watch: Watch) -> None:
    """Judge once more with the spread as the prior, write the results and say where they are."""
    last = steps[-1]
    mean = np.array(last.mean)
    spread = score(problem, mean, watch, population_settings(problem, last))
    comparison = compare(steps[0].scores, last.scores, spread)
    found = report(problem, last, comparison)
    save_model(with_values(problem.model, problem.chosen.names, mean), folder / files.MODEL)
    files.write_json(folder / files.REPORT, found)
    draw(problem, last, comparison, folder / files.PICTURE)
    print(f"\n{table(problem, last, comparison)}\n\n{found['verdict']}\n")
    print(f"{folder / files.MODEL}: the calibrated model, for the --model of other commands")
    print(f"{folder / files.REPORT}: all numbers\n{folder / files.PICTURE}")
