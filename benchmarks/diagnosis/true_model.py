"""The error that a diagnosis could reach: that of the true model, on the same halves of the tracks."""

from __future__ import annotations

from dataclasses import replace

import torch

from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.diagnosis.data import actual_model, declared_model
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.diagnosis.fit.fit import fit, followed, start_from
from ballfg.diagnosis.fit.holdout import halves_of
from ballfg.diagnosis.fit.problem import Problem
from ballfg.diagnosis.fit.process_noise import with_process_noise
from ballfg.diagnosis.fit.stretches import Stretches, stretches_of
from ballfg.diagnosis.result import Errors
from ballfg.diagnosis.search.calibrated import calibrated_model
from ballfg.diagnosis.search.evaluation import prediction_errors
from ballfg.diagnosis.search.hypothesis import declared_free
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effect import Coefficient
from ballfg.estimation import Smoother, dataset_settings
from ballfg.estimation.measurement.as_measured import plainly_measured
from ballfg.state import SPIN
from ballfg.tracks import Dataset


def true_errors(case: Case, dataset: Dataset) -> Errors:
    """Errors on the judging half of the true model, its coefficients fitted to the finding half.

    Args: case: with planted effects of the catalogue and one session.  dataset: its tracks.
    """
    truth, declared = actual_model(case), declared_model(case, dataset.info.ball.radius)
    halves = halves_of(dataset, declared, 1, lambda line: None)  # the diagnosis splits in the same way
    moving = plainly_measured(truth)
    smoother = Smoother(moving, halves.surfaces, dataset_settings(dataset, moving))
    finding = stretches_of(smoother, [part.track for part in halves.found_on], halves.launcher)
    finding = followed(truth, _with_labelled_spins(truth, finding))
    problem = Problem(truth, finding, {**declared_free(declared), **planted_free(case)})
    start = start_from(problem, halves.settings.spin_label_noise, halves.settings.spin_prior)
    fitted = calibrated_model(fit(problem, *start), halves.launcher.embedding)
    model = with_process_noise(fitted, halves.found_on, dataset, 1).model
    return prediction_errors(model, halves.judged, halves.surfaces, dataset_settings(dataset, model), 1)


def planted_free(case: Case) -> dict[str, Coefficient]:
    """The coefficients of the planted effects that a fit estimates beside the declared ones, by parameter name."""
    free: dict[str, Coefficient] = {}
    for name in case.planted:
        free |= PLANTS[name].hypothesis().free()
    return free


def _with_labelled_spins(model: AnalyticModel, stretches: Stretches) -> Stretches:
    """Stretches whose first guess of a labelled spin is what the label means to a model."""
    with torch.no_grad():
        offset = model.labelled(torch.zeros(3, dtype=torch.float64))
        turn = model.labelled(torch.eye(3, dtype=torch.float64)) - offset  # labels are affine: rows M e_i
        spins = torch.linalg.solve(turn.T, (stretches.labels - offset).T).T
    starts = stretches.starts.clone()
    labelled = torch.from_numpy(stretches.labelled)
    starts[labelled, SPIN] = spins[labelled]
    return replace(stretches, starts=starts)
