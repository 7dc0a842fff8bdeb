"""Defines the command `ballfg-train` and its entry point.

Heavy libraries are imported inside functions: `ballfg-train --help` must not wait for torch or GTSAM.
"""

import shlex
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from ballfg.cli import inputs
from ballfg.cli.start import guarded, start
from ballfg.machine import usable_cores
from ballfg.progress import alive, announce, idle, progress

if TYPE_CHECKING:
    from ballfg.learning.config.training import TrainConfig

OwnFiles = tuple[list[Path], list[Path]]  # Those that define effects of one's own, and observations
app = typer.Typer(name="ballfg-train", add_completion=False, pretty_exceptions_enable=False)


@app.command()
def train(
    config: Annotated[
        Path, typer.Argument(metavar="CONFIG.yaml", help="Config file (YAML); docs/train.md lists its keys.")
    ],
    overrides: Annotated[
        list[str] | None, typer.Argument(metavar="[KEY=VALUE]...", help="Config keys to override.")
    ] = None,
    data: Annotated[
        list[str] | None, typer.Option("--data", help="Dataset folder; repeat to train one model on several.")
    ] = None,
    out: Annotated[str | None, typer.Option("--out", help="Output folder; must not hold an earlier run.")] = None,
    resume: Annotated[str | None, typer.Option("--resume", help="Folder of an earlier run to continue.")] = None,
    effects_file: inputs.EffectsFiles = None,
    observations_file: inputs.ObservationsFiles = None,
) -> None:
    """Train a model of the ball on a dataset: a network, or the coefficients of the analytic model.

    The key `kind` of the config selects the model. kind: calibrate estimates the drag of the ball and the restitution
    of the table, with error bars. kind: auto compares the nominal model, the calibrated one, one with the spins of
    groups and one with a learned correction of drag and lift, and writes the best.

    The exit status is 1 if no epoch predicts the validation tracks better than the model before the first step, a
    calibrated model does not predict the judging tracks better than the one before, or kind: auto keeps that one
    or chooses one that predicts them worse. After Ctrl-C the best model so far is written.

    Example: ballfg-train train.yaml --data data/ballgun --out ballgun-model kind=mnn+gs optimizer.epochs=30
    """
    from ballfg.learning.config.calibration import CalibrationConfig
    from ballfg.learning.config.config_file import read_config

    if resume is not None and out not in (None, resume):
        raise ValueError(f"--out and --resume must name one folder; got {out} and {resume}. Leave --out away.")
    options: dict[str, Any] = {"data": data[0] if data and len(data) == 1 else data, "out": resume or out}
    settings = read_config(config, overrides or (), {key: value for key, value in options.items() if value})
    if not settings.data:
        raise ValueError("a dataset is needed; got none. Give --data FOLDER, or 'data' in the config.")
    folder, own = Path(settings.out), (effects_file or [], observations_file or [])
    inputs.know(*own)
    if isinstance(settings, CalibrationConfig):
        if isinstance(settings.data, str):
            from ballfg.learning.calibration.run import run_calibration as calibrate
        else:
            from ballfg.learning.calibration.sets import calibrate_sets as calibrate
        status = calibrate(settings, folder, resume=resume is not None, jobs=usable_cores(), watch=progress)
    else:
        given: dict[str, Any] = {"--data": data, "--out": out and [out], "--resume": resume and [resume]}
        given |= dict(zip(("--effects-file", "--observations-file"), own, strict=True))
        words = [word for option, values in given.items() for value in values or () for word in (option, str(value))]
        typed = shlex.join(["ballfg-train", str(config), *(overrides or ()), *words])
        status = _train(settings, folder, resume is not None, typed, own)
    if status:
        raise SystemExit(status)


def _train(config: "TrainConfig", folder: Path, resume: bool, typed: str, own: OwnFiles) -> int:
    """Train in this process if a launcher has started it or one is enough, else in new processes.

    Returns: the exit status.
    """
    from ballfg.learning.run.ranks import launch, started_by_launcher
    from ballfg.learning.run.run_folder import check

    jobs = config.jobs or usable_cores()
    if jobs == 1 or started_by_launcher():
        return _train_here(config, folder, resume, typed)
    check(folder, config, resume=resume)  # refuse a bad folder before the processes start
    announce(f"starting {jobs} processes")
    with idle():  # the first of the processes speaks, and prints the reason of its status
        return launch(jobs, _train_guarded, config, folder, resume, typed, own)


def _train_here(config: "TrainConfig", folder: Path, resume: bool, typed: str) -> int:
    from ballfg.learning.run.training import run_training

    return run_training(config, folder, resume=resume, watch=progress, command=typed)


def _train_guarded(config: "TrainConfig", folder: Path, resume: bool, typed: str, own: OwnFiles) -> int:
    """The work of each process that this command starts. Returns: its exit status; none where it was interrupted."""
    from ballfg.learning.run.ranks import NO_STATUS

    def work() -> int:
        try:
            with alive("ballfg-train"):
                inputs.know(*own)
                return _train_here(config, folder, resume, typed)
        except KeyboardInterrupt:  # this command says so
            return NO_STATUS

    return guarded(work)


def run(arguments: Sequence[str] | None = None) -> None:
    """Run `ballfg-train` with the given arguments, by default those of the command line, and exit.

    Raises: SystemExit: always; status 0, 1 if the trained or calibrated model is not better than before,
        2 on bad input, 130 after Ctrl-C.
    """
    start(app, "ballfg-train", arguments)
