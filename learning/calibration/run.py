"""Runs a calibration from config to results, for `ballfg-train` with the kind `calibrate`."""

import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch
from pydantic import ValidationError

from ballfg.checks import shown
from ballfg.dynamics import save_model
from ballfg.dynamics.model_file import model_to_dict
from ballfg.estimation.batch import start_early
from ballfg.files.damaged import whole_content
from ballfg.learning.calibration.auto import (
    CORRECTED,
    GROUPED,
    UNLEARNED,
    Choice,
    Fitted,
    check_enough,
    choose_candidate,
    config_of,
)
from ballfg.learning.calibration.calibrate import (
    calibrate,
    fitted_noise,
    has_ended,
    pose_correction,
    with_scores,
    with_shown_noise,
)
from ballfg.learning.calibration.picture import draw
from ballfg.learning.calibration.predicting import finished
from ballfg.learning.calibration.problem import Problem, Step, pose, score
from ballfg.learning.calibration.report import compare, outcome, report, table
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.config.config_file import AUTO
from ballfg.learning.evaluation import Plain, TrackScore, denser, summary
from ballfg.learning.run import run_folder as files
from ballfg.learning.run.record import NOT_BETTER
from ballfg.learning.start import describe
from ballfg.learning.training_data import analytic_model, open_source
from ballfg.progress import Watch
from ballfg.tracks.noise import TrackNoise

ESTIMATES: Final = 40  # Of each track that a choice takes, about


class Checkpoint(Plain):
    """The checkpoint of a calibration, from which it continues to the same numbers."""

    data: str  # Digest of the dataset's content
    model: dict[str, Any]  # Content of the model file that the run started from
    steps: tuple[Step, ...]  # Finished steps
    corrected: tuple[Step, ...] = ()  # Finished steps of the correction


def run_calibration(config: CalibrationConfig, folder: Path, *, resume: bool, jobs: int, watch: Watch) -> int:
    """Calibrate coefficients and write the folder of the run; to `resume` is to continue after the last finished step.

    Args: jobs: number of processes where the config has none.
    Returns: the exit status of `ballfg-train`, as of `status_of`; 1 if `kind: auto` keeps the nominal model.
    Raises: ValueError, FileNotFoundError: bad input. KeyboardInterrupt: after Ctrl-C; finished steps are kept.
    """
    if not isinstance(config.data, str):
        raise ValueError(
            f"one dataset is needed; got {shown(config.data)}. Give --data FOLDER, or 'data' in the config."
        )
    with files.running(folder, config, resume=resume):
        torch.set_num_threads(1)  # the batches are small: threads cost more than they gain
        dataset = open_source(config.data, config.source, config.anyway)
        model = analytic_model(config.model, dataset.info.ball)
        problem = pose(dataset, model, config, config.jobs or jobs)
        if config.kind == AUTO:
            check_enough(problem.split.fit)
            start_early(ESTIMATES * len(problem.split.fit), problem.jobs)
        if not resume:
            files.start(folder, config)
        fit, judge = len(problem.split.fit), len(problem.split.judge)
        print(f"{folder / files.CONFIG}: the config; {fit} tracks fit, {judge} judge")
        found: dict[str, Fitted] = {}
        finish = partial(_finish, folder=folder, watch=watch, proven=config.kind == AUTO)
        if config.kind == AUTO:
            chosen, found = _chosen(problem, folder, resume, watch)
            if chosen in UNLEARNED:
                save_model(model, folder / files.MODEL)
                print(f"{folder / files.MODEL}: the nominal model, which nothing beats")
                return NOT_BETTER
            problem = pose(dataset, model, config_of(config, chosen), problem.jobs)
        steps: tuple[list[Step], list[Step]] = ([], [])
        last: Problem | None = None
        if found:
            problem, last, steps = _resumed(found, chosen, problem, watch)
            write_checkpoint(folder, problem, *steps)
        else:
            steps = read_checkpoint(folder, problem) if resume else steps
            problem = with_shown_noise(problem, watch)
        calibrated, corrected = steps
        if resume:
            files.start(folder, config)
        try:
            take_steps(problem, calibrated, folder, watch)  # none are left of a candidate that was just compared
            if not problem.config.correction:
                return finish(problem, calibrated)
            last = last or pose_correction(problem, calibrated[-1], watch)
            _check_follows(corrected, last, folder / files.STEPS)
            take_steps(last, corrected, folder, watch, (problem, calibrated))
            return finish(last, [calibrated[0], *corrected])
        except KeyboardInterrupt:
            kept = len(calibrated) + len(corrected)
            print(f"{kept} steps are kept; continue with --resume {folder}", file=sys.stderr)
            raise


def _chosen(problem: Problem, folder: Path, resume: bool, watch: Watch) -> tuple[str, dict[str, Fitted]]:
    """Name of the candidate that `kind: auto` chooses or, in the run that is resumed, chose; those just calibrated."""
    path = folder / files.CHOICE
    candidates: dict[str, Fitted] = {}
    if resume and path.is_file():
        choice = Choice.model_validate_json(whole_content(path))
    else:
        choice, candidates = choose_candidate(problem, watch)
        files.write_json(path, choice.model_dump(mode="json"))
    print(f"\n{choice.table()}\n\n{choice.verdict()}\n", flush=True)
    return choice.chosen, candidates


def _resumed(
    found: Mapping[str, Fitted], chosen: str, problem: Problem, watch: Watch
) -> tuple[Problem, Problem, tuple[list[Step], list[Step]]]:
    """The problems of a chosen candidate and of a correction, with judging tracks, and the steps of both."""
    base = found[GROUPED if chosen == CORRECTED else chosen]
    correction = found.get(CORRECTED, base)
    last = replace(correction.problem, split=problem.split)
    problem = replace(base.problem, split=problem.split, config=problem.config)
    first, *between, end = base.steps
    calibrated = [with_scores(problem, first, watch), *between, with_scores(problem, end, watch)]
    return problem, last, (calibrated, list(correction.steps) if chosen == CORRECTED else [])


def take_steps(
    problem: Problem, steps: list[Step], folder: Path, watch: Watch, first: tuple[Problem, Sequence[Step]] | None = None
) -> None:
    """Take the steps that are left, with a checkpoint and a line of text after each.

    Args: first: the calibration before a correction, and its steps.
    """
    begun = time.monotonic()
    if first is not None:  # a correction is judged with its spins, at the end
        problem = replace(problem, split=replace(problem.split, judge=()))
    for step in calibrate(problem, tuple(steps), watch=watch):
        steps.append(step)
        if first is None:
            write_checkpoint(folder, problem, steps)
        else:
            write_checkpoint(folder, *first, steps)
        now = time.monotonic()
        left = (problem.config.max_iterations - step.number) * (now - begun)
        begun = now
        print(_line(problem, step, left), flush=True)


def _line(problem: Problem, step: Step, left: float) -> str:
    """One line on a step: coefficients, error, time left."""
    judged = summary([score for score in step.scores if score is not None])
    values = ", ".join(
        f"{name} {value:.5g}" + (f" ± {step.sigma[k]:.2g}" if step.sigma else "")
        for k, name in problem.chosen.listed
        for value in [step.mean[k]]
    )
    parts = [f"iteration {step.number}: {values}"]
    parts += [] if step.moved is None else [f"moved {step.moved:.2g} sigma"]
    if step.scores:  # tracks are judged before the first step and after the last
        parts += ["no track judged"] if judged is None else [f"median RMSE {1e3 * judged.rmse_median:.2f} mm"]
    parts += [f"{len(step.skipped)} tracks skipped"] if step.skipped else []
    if step.moved is not None and not has_ended(problem.config, step):  # step 0 fits nothing: its time says little
        parts.append(f"at most about {left:.0f} s left")
    return "; ".join(parts)


def status_of(word: str, *, proven: bool) -> int:
    """The exit status: 0 for a model that predicts the judging tracks better than the one before, else 1.

    Args: word: as of `outcome`.  proven: True if the fitted tracks chose the model, which is then 0 unless it is worse.
    """
    return 0 if word == "better" or (proven and word != "worse") else NOT_BETTER


def _finish(problem: Problem, steps: Sequence[Step], folder: Path, watch: Watch, proven: bool) -> int:
    """Judge once more with the spread as the prior and with the noise, write the results and print their paths.

    Returns: the exit status. Args: proven: as of `status_of`.
    """
    made = finished(problem, steps[-1], watch)
    model, population, noise = made.model, made.settings, made.noise
    last = made.step if made.step is steps[-1] else with_scores(problem, made.step, watch)
    spread = score(problem, model, population, watch)
    shown = spread if noise is None else score(problem, model, noise.settings, watch)
    after = last.scores if problem.correction is None else spread  # a correction goes with its spins
    comparison = compare(steps[0].scores, after, spread, shown)
    if comparison.gain is not None and comparison.gain.word == "no different" and noise is not None:
        comparison = replace(comparison, density=_density(problem, shown, watch))
    found = report(problem, last, comparison, noise)
    describe(model, problem, population, noise)
    if problem.dataset.one_view:  # its tracks cannot correct a drag: the model file states how sure it is
        model.noise = TrackNoise(coefficients={name: last.next_track[k] for k, name in problem.chosen.listed})
    save_model(model, folder / files.MODEL)
    files.write_json(folder / files.REPORT, found)
    draw(problem, last, comparison, folder / files.PICTURE)
    print(f"\n{found['verdict']}\n\n{table(problem, last, comparison)}\n")
    print(f"{folder / files.MODEL}: the calibrated model, for the --model of other commands")
    print(f"{folder / files.REPORT}: all numbers\n{folder / files.PICTURE}")
    return status_of(outcome(comparison), proven=proven)


def _density(problem: Problem, written: Sequence[TrackScore | None], watch: Watch) -> tuple[float, float] | None:
    """The rise of the density from the model before, with the noise that tracks show about it, to the written one."""
    noise = fitted_noise(problem, problem.model, problem.settings, watch, errors=False)
    if noise is None:
        return None
    before = score(problem, problem.model, noise.settings, watch)
    pairs = [(b.log_score, a.log_score) for b, a in zip(before, written, strict=True) if b and a]
    return denser(*np.array(pairs).T) if len(pairs) > 1 else None


def write_checkpoint(folder: Path, problem: Problem, steps: Sequence[Step], corrected: Sequence[Step] = ()) -> None:
    """Replace the checkpoint of a run: its steps, and those of its correction."""
    model = model_to_dict(problem.model)
    checkpoint = Checkpoint(data=problem.split.digest, model=model, steps=tuple(steps), corrected=tuple(corrected))
    files.write_json(folder / files.STEPS, checkpoint.model_dump(mode="json"))


def read_checkpoint(folder: Path, problem: Problem) -> tuple[list[Step], list[Step]]:
    """The steps of an earlier run and those of its correction; none if it stopped before the first.

    Raises: ValueError: a damaged checkpoint, or one of another dataset, another model.
    """
    path = folder / files.STEPS
    if not path.is_file():
        return [], []
    try:
        checkpoint = Checkpoint.model_validate_json(whole_content(path))
    except ValidationError as error:
        first = error.errors()[0]
        raise ValueError(f"{path}: not a checkpoint ({first['msg']}). Start a new run.") from None
    if checkpoint.data != problem.split.digest:
        raise ValueError(f"{path}: was made from another dataset than {problem.dataset.path}. Give the same --data.")
    if checkpoint.model != model_to_dict(problem.model):
        raise ValueError(f"{path}: was started from another model. Give the same model.")
    _check_follows(checkpoint.steps, problem, path)
    return list(checkpoint.steps), list(checkpoint.corrected)


def _check_follows(steps: Sequence[Step], problem: Problem, path: Path) -> None:
    """Refuses steps that do not fit a problem: they are numbered from 0, with its coefficients and its tracks."""
    size, tracks, judged = len(problem.chosen.names), set(problem.split.fit), len(problem.split.judge)
    for number, step in enumerate(steps):
        rows = [step.mean]
        if number:
            rows += [step.sigma, step.spread, step.next_track]
            rows += [values for fit in step.fits for values in (fit.values, fit.sigmas)]
        names = {fit.name for fit in step.fits} | {name for name, _ in step.skipped}
        groups = 0 if problem.groups is None or not number else len(problem.groups.names)
        fit = all(len(row) == size for row in rows) and names <= tracks and len(step.scores) in (0, judged)
        fit = fit and len(step.spins) == groups and set(step.by_group) <= set(problem.chosen.names)
        fit = fit and all(len(row) == groups for row in step.by_group.values())
        if not fit or step.number != number or (step.moved is None) != (number == 0):
            raise ValueError(f"{path}: not a checkpoint (its steps are not those of this run). Start a new run.")
