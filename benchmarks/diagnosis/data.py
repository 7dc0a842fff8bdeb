"""Makes the data of a case: simulated tracks in a folder, or measured ones; the declared model, and the true one."""

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np

from ballfg.benchmarks.diagnosis.cases import LABEL_NOISE, STATED_NOISE, Case
from ballfg.benchmarks.diagnosis.changes import CHANGES
from ballfg.diagnosis.hypotheses.hypothesis import has_effect, with_effects, without_effect
from ballfg.dynamics import AnalyticModel, nominal_model
from ballfg.estimation.noise.estimate import spread_over
from ballfg.simulation import MeasurementNoise, SimulationConfig, parse_effects, simulate, table_tennis
from ballfg.simulation.motion import true_model
from ballfg.simulation.synthetic import dataset_info
from ballfg.tracks import Dataset, read_dataset, write_dataset
from ballfg.tracks.memory import dataset_in_memory


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
    """One session; the tracks are shared out evenly."""
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
