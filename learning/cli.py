"""The command `ballfg-train` and its entry point.

The heavy libraries are imported inside: `ballfg-train --help` must not wait for torch or GTSAM.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ballfg.cli.errors import guarded
from ballfg.cli.inputs import default_jobs
from ballfg.cli.progress import progress

if TYPE_CHECKING:
    from ballfg.learning.calibrate import Problem, Step
    from ballfg.learning.config import CalibrationConfig

app = typer.Typer(name="ballfg-train", add_completion=False, pretty_exceptions_enable=False)


@app.command()
def train(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG.yaml", help="YAML file of what to do; docs/train.md lists its keys.")
    ],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Keys of the config, given here instead.")
    ] = None,
    data: Annotated[str | None, typer.Option("--data", help="Folder of the dataset.")] = None,
    out: Annotated[str | None, typer.Option("--out", help="Folder to write: new, or without an earlier run.")] = None,
    resume: Annotated[str | None, typer.Option("--resume", help="Folder of an earlier run: continue it.")] = None,
) -> None:
    """Calibrate the coefficients of the analytic model on a dataset: how bouncy is my table, how draggy my ball.

    Half of the tracks are fitted; the others show whether the calibrated model predicts better.

    Example: ballfg-train calibrate.yaml --data data/ballgun --out ballgun-model seed=1
    """
    from ballfg.learning import folder as files
    from ballfg.learning.config import read_config

    if resume is not None and out not in (None, resume):
        raise ValueError(f"--out and --resume must name one folder; got {out} and {resume}. Leave --out away.")
    target = resume if resume is not None else out
    given = {"data": data, "out": target}
    settings = read_config(config, overrides or (), {key: value for key, value in given.items() if value is not None})
    folder = Path(settings.out)
    if resume is None:
        files.check_new(folder)
    else:
        files.check_resumable(folder, settings)
    problem = _pose(settings)
    steps = [] if resume is None else files.read_checkpoint(folder, problem)
    files.start(folder, settings)
    print(f"{folder / files.CONFIG}: the config; {len(problem.split.fit)} tracks fit, {len(problem.split.judge)} judge")
    try:
        _steps(problem, steps, folder)
        _finish(problem, steps, folder)
    except KeyboardInterrupt:
        print(f"{len(steps)} steps are kept; continue with --resume {folder}", file=sys.stderr)
        raise


def _pose(config: CalibrationConfig) -> Problem:
    """Open dataset and model; what was repaired is said on stderr."""
    import torch

    from ballfg.dynamics import load_model, nominal_model
    from ballfg.learning.calibrate import pose
    from ballfg.tracks import read_dataset

    if config.data is None:
        raise ValueError("a dataset is needed; got none. Give --data FOLDER, or 'data' in the config.")
    torch.set_num_threads(1)  # the batches are small: threads cost more than they bring
    dataset = read_dataset(config.data)
    for note in dataset.notes:
        print(f"note: {note}", file=sys.stderr)
    radius = dataset.info.ball.radius
    model = nominal_model(radius) if config.model is None else load_model(config.model, radius=radius)
    return pose(dataset, model, config, config.jobs or default_jobs())


def _steps(problem: Problem, steps: list[Step], folder: Path) -> None:
    """Take the steps that are left; a checkpoint and a line after each."""
    from ballfg.learning.calibrate import calibrate
    from ballfg.learning.folder import write_checkpoint

    begun = time.monotonic()
    for step in calibrate(problem, tuple(steps), watch=progress):
        steps.append(step)
        write_checkpoint(folder, problem, steps)
        now = time.monotonic()
        left = (problem.config.max_iterations - step.number) * (now - begun)
        begun = now
        print(_line(problem, step, left), flush=True)


def _line(problem: Problem, step: Step, left: float) -> str:
    """One line on a step: coefficients, error, how long it can still take."""
    from ballfg.learning.calibrate import has_ended
    from ballfg.learning.judge import summary

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


def _finish(problem: Problem, steps: Sequence[Step], folder: Path) -> None:
    """Judge once more with the spread as the prior, write the results and say where they are."""
    import numpy as np

    from ballfg.dynamics import save_model
    from ballfg.learning import folder as files
    from ballfg.learning.calibrate import population_settings, score
    from ballfg.learning.coefficients import with_values
    from ballfg.learning.picture import draw
    from ballfg.learning.report import compare, report, table

    last = steps[-1]
    mean = np.array(last.mean)
    spread = score(problem, mean, progress, population_settings(problem, last))
    comparison = compare(steps[0].scores, last.scores, spread)
    found = report(problem, last, comparison)
    save_model(with_values(problem.model, problem.chosen.names, mean), folder / files.MODEL)
    files.write_json(folder / files.REPORT, found)
    draw(problem, last, comparison, folder / files.PICTURE)
    print(f"\n{table(problem, last, comparison)}\n\n{found['verdict']}\n")
    print(f"{folder / files.MODEL}: the calibrated model, for the --model of other commands")
    print(f"{folder / files.REPORT}: all numbers\n{folder / files.PICTURE}")


def run(arguments: Sequence[str] | None = None) -> None:
    """Runs `ballfg-train` with the given arguments, by default the command line's, and exits.

    Raises: SystemExit: always; status 0, 2 on bad input, 130 after Ctrl-C.
    """
    command = typer.main.get_command(app)
    given = sys.argv[1:] if arguments is None else list(arguments)
    sys.exit(guarded(lambda: command.main(given, prog_name="ballfg-train", standalone_mode=False)))
