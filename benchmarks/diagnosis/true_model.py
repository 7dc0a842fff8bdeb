"""Computes the best possible error of a diagnosis: the true model's, on the same halves of the tracks."""

from dataclasses import replace

import torch

from ballfg.benchmarks.diagnosis.cases import Case
from ballfg.benchmarks.diagnosis.data import actual_model, declared_model
from ballfg.benchmarks.diagnosis.effects import PLANTS
from ballfg.diagnosis.fit.fit import first_guess, fit_problem, reachable
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.fit.problem import Problem
from ballfg.diagnosis.fit.stretches import Stretches, stretches_of
from ballfg.diagnosis.result import Errors
from ballfg.diagnosis.search.evaluation import prediction_errors
from ballfg.diagnosis.search.process_noise import calibrated_model, noise_about
from ballfg.dynamics import AnalyticModel
from ballfg.dynamics.effect import Coefficient
from ballfg.estimation import Smoother, dataset_settings
from ballfg.estimation.measurement.as_measured import plainly_measured
from ballfg.state import SPIN
from ballfg.tracks import Dataset


def true_errors(case: Case, dataset: Dataset) -> Errors:
    """Errors of the true model on the held-out half, its coefficients fitted to the other half."""
    truth, declared = actual_model(case), declared_model(case, dataset.info.ball.radius)
    holdout = hold_out(dataset, declared)  # the diagnosis splits in the same way
    moving = plainly_measured(truth)
    smoother = Smoother(moving, holdout.surfaces, dataset_settings(dataset, moving))
    search = stretches_of(smoother, [part.track for part in holdout.search_tracks], holdout.launcher)
    search = reachable(truth, _with_labelled_spins(truth, search))
    problem = Problem(truth, search, {**declared_free(declared), **planted_free(case)})
    start = first_guess(problem, holdout.settings.spin_label_noise, holdout.settings.spin_prior)
    model = calibrated_model(fit_problem(problem, *start), holdout.launcher.embedding)
    model.noise = noise_about(model, holdout.search_tracks, dataset)
    return prediction_errors(model, holdout.held_out_tracks, holdout.surfaces, dataset_settings(dataset, model))


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
