"""Makes the data of a case, the declared model and the true one, and computes the best possible error."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
import torch

from ballfg.benchmarks.diagnosis.cases import LABEL_NOISE, PLANTS, STATED_NOISE, Case
from ballfg.benchmarks.diagnosis.changes import CHANGES
from ballfg.diagnosis.fit.effects import has_effect, with_effects, without_effect
from ballfg.diagnosis.fit.fit import first_guess, fit_problem, reachable
from ballfg.diagnosis.fit.free import declared_free
from ballfg.diagnosis.fit.holdout import hold_out
from ballfg.diagnosis.fit.problem import Problem
from ballfg.diagnosis.fit.stretches import Stretches, stretches_of
from ballfg.diagnosis.result import Errors
from ballfg.diagnosis.search.evaluation import errors_of, predictive_model
from ballfg.dynamics import AnalyticModel, nominal_model
from ballfg.dynamics.effect import Coefficient
from ballfg.estimation import Smoother, dataset_settings
from ballfg.estimation.measurement.as_measured import plainly_measured
from ballfg.estimation.noise.estimate import spread_over
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate, table_tennis
from ballfg.simulation.motion import true_model
from ballfg.simulation.synthetic import dataset_info
from ballfg.state import SPIN
from ballfg.tracks import Dataset, read_dataset, write_dataset
from ballfg.tracks.dataset import dataset_in_memory


def make_dataset(case: Case, folder: Path) -> Dataset:
    """Simulate a case's tracks, session after session, into a folder that does not exist yet, and open it."""
    configs = [_simulation(case, number) for number in range(len(case.sessions))]
    info = replace(dataset_info(configs[0]), name=case.name, position_noise=STATED_NOISE)
    if case.recording.labels:
        info = replace(info, spin_noise=LABEL_NOISE)
    simulated = ((session, one.track) for session, config in enumerate(configs) for one in simulate(config))
    tracks = (replace(track, name=f"{session}-{track.name}") for session, track in simulated)
    write_dataset(folder, info, tracks, "parquet")
    return read_dataset(folder)


def measured_dataset(case: Case, folder: Path) -> tuple[Dataset, Mapping[str, float]]:
    """Measured tracks in a folder as a case wants them, and the strength of their change by coefficient."""
    dataset = read_dataset(folder)
    if not case.change and case.most is None:
        return dataset, {}
    tracks, strengths = spread_over(dataset, len(dataset), case.most or len(dataset)), dict[str, float]()
    if case.change:
        part = dataset_in_memory(dataset.info, tracks)
        changed = CHANGES[case.change](part, tracks, np.random.default_rng(case.stream))
        tracks, strengths = list(changed.tracks), dict(changed.strengths)
    return dataset_in_memory(dataset.info, tracks), strengths


def declared_model(case: Case, radius: float) -> AnalyticModel:
    """The declared model of a diagnosis: the nominal one for a radius (m), without the effects left out."""
    model = with_effects(nominal_model(radius))
    for name in case.left_out:
        if has_effect(model, name):  # effects that need one go with it
            model = without_effect(model, name)
    return model


def actual_model(case: Case) -> AnalyticModel:
    """The truth of a case's first session."""
    return with_effects(true_model(table_tennis().model, parse_effects(case.sessions[0])))


def _simulation(case: Case, session: int) -> SimulationConfig:
    taken = case.recording
    return SimulationConfig(
        tracks=taken.tracks // len(case.sessions),
        rate=taken.rate,
        seed=case.stream + session,
        settings=dict(taken.levels),
        noise=MeasurementNoise(
            position=taken.position,
            dropout=taken.dropout,
            jitter=taken.jitter,
            outliers=taken.outliers,
            spin=taken.spin,
        ),
        undeclared=parse_effects(case.sessions[session]),
        spin_labels=taken.labels,
    )


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
    return errors_of(predictive_model(holdout, 1, fit_problem(problem, *start)), holdout, holdout.held_out_tracks, 1)


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
