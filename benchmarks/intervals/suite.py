"""Measures the coverage of 90 % intervals, on measured datasets and on simulated ones with memory and jitter.

Of every judged track 0.25 s are seen and 0.3 s predicted, with noise from elsewhere. Every second track is judged, then
the others, so that a figure is of all tracks of a set. The noise "as usual" is the package's constants with the scatter
of the samples. "From observed parts" it comes from the observed parts of the judged tracks, "from other tracks" from
whole tracks of the other half.
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Final

import numpy as np

from ballfg.benchmarks.estimators.measured import HORIZON, OBSERVE, prediction_rmse
from ballfg.benchmarks.metrics import inside
from ballfg.benchmarks.results import Results
from ballfg.diagnosis import diagnose
from ballfg.dynamics import BallModel, load_model, nominal_model
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation import (
    Settings,
    Smoother,
    Status,
    dataset_settings,
    dataset_surfaces,
    estimate_noise,
    predict_tracks,
)
from ballfg.estimation.noise.estimate import spread_over
from ballfg.estimation.track_prediction import TrackPrediction
from ballfg.progress import progress
from ballfg.simulation import MeasurementNoise, SimulationConfig, write_simulation
from ballfg.tracks import Dataset, Track, read_dataset

USUAL: Final = "usual noise"
OBSERVED_PARTS: Final = "noise from observed parts"
OTHER_TRACKS: Final = "noise from other tracks"
METHODS: Final = (USUAL, OBSERVED_PARTS, OTHER_TRACKS)


def judge(
    model: BallModel, surfaces: Surfaces, settings: Settings, tracks: Sequence[Track], jobs: int
) -> list[TrackPrediction]:
    """Predictions of tracks; those that end before are left out."""
    smoother = Smoother(model, surfaces, settings)
    results = predict_tracks(smoother, tracks, len(tracks), OBSERVE, horizon=HORIZON, jobs=jobs)
    return [one for one in results if one.status is Status.FAILED or len(one.times)]


def judged_both_ways(
    method: str,
    model: BallModel,
    surfaces: Surfaces,
    settings: Settings,
    tracks: Sequence[Track],
    jobs: int,
    position_known: bool = False,
) -> list[TrackPrediction]:
    """All tracks judged, each half with noise that knows nothing of its later parts.

    Args: method: of `METHODS`.  settings: as usual.  position_known: whether the noise of positions is stated.
    """
    halves, made = (tracks[0::2], tracks[1::2]), list[TrackPrediction]()
    for judged, others in (halves, halves[::-1]):
        shown = {
            USUAL: [],
            OBSERVED_PARTS: [track.opening(OBSERVE) for track in judged],
            OTHER_TRACKS: list(others),
        }[method]
        asked = spread_over(shown, len(shown))
        found = estimate_noise(model, surfaces, settings, asked, position_known=position_known, errors=False)
        made += judge(model, surfaces, settings if found is None else found.settings, judged, jobs)
    return made


LEVEL: Final = 0.9
RATES: Final = (60.0, 90.0, 120.0, 180.0, 240.0)
MEMORY_TIMES: Final = (0.0, 0.005, 0.01, 0.02, 0.03)
JITTERS: Final = (0.0, 0.0005, 0.001, 0.002)
MOST_JITTER: Final = 0.15  # Share of a frame; the simulator refuses more, because stamps would change places
DROPS: Final = (0.0, 0.05, 0.2)
OTHER_SEED: Final = 1000  # Added to a setting's seed: tracks that its diagnosis has not seen
PLANTED_SEED: Final = 500
DIAGNOSED: Final = "model from diagnose"


@dataclass(frozen=True)
class Plan:
    """Amount of computation: simulated settings, tracks in each, diagnoses of each planted tracker."""

    settings: int
    tracks: int
    planted: int


FULL: Final = Plan(settings=20, tracks=50, planted=3)
QUICK: Final = Plan(settings=2, tracks=16, planted=0)
PLANTED: Final = (
    MeasurementNoise(position=0.002, memory=0.002, memory_time=0.005),
    MeasurementNoise(position=0.002, memory=0.002, memory_time=0.01),
    MeasurementNoise(position=0.002, memory=0.002, memory_time=0.02),
    MeasurementNoise(position=0.002, jitter=0.0005),
    MeasurementNoise(position=0.002, jitter=0.001),
    MeasurementNoise(position=0.002, jitter=0.002),
)
"""Trackers that a diagnosis should name: one memory, or one jitter."""
PLANTED_RATE: Final = 120.0


def run_intervals(
    results: Results,
    datasets: Sequence[Dataset],
    plan: Plan,
    jobs: int,
    first: int | None = None,
    diagnosed: bool = False,
) -> None:
    """Rows for measured datasets, or for simulated ones where there are none.

    Args:
        first: how many tracks of a measured dataset are used, the first ones; None for all.
        diagnosed: True to predict simulated tracks with the model of a diagnosis of others.
    """
    if datasets:
        work = [(dataset, method) for dataset in datasets for method in METHODS]
        for dataset, method in progress(work, len(work), "sets judged"):
            model, known = nominal_model(dataset.ball), dataset.info.position_noise is not None
            settings, tracks = dataset_settings(dataset, model), list(dataset)[:first]
            judged = judged_both_ways(method, model, known_surfaces(dataset), settings, tracks, jobs, known)
            add_judged(results, dataset.info.name, method, judged)
        return
    configs = [simulated_config(results.seed, number, plan.tracks) for number in range(plan.settings)]
    if diagnosed:
        repeats = range(len(PLANTED) * plan.planted)
        configs += [planted_config(results.seed, number, plan.tracks) for number in repeats]
    for config in progress(configs, len(configs), "simulated settings judged"):
        (_diagnosed if diagnosed else _simulated)(results, config, jobs)


def known_surfaces(dataset: Dataset) -> Surfaces:
    """The table, with its ends only where they are stated: others would come from the predicted parts."""
    stated = dataset.info.table_extent is not None
    return dataset_surfaces(dataset) if stated else Surfaces.table_tennis(dataset.table)


def _simulated(results: Results, config: SimulationConfig, jobs: int) -> None:
    with TemporaryDirectory() as folder:
        dataset, model = _written(Path(folder) / "shots", config)
        settings, surfaces = dataset_settings(dataset, model), dataset_surfaces(dataset)
        for method in (USUAL, OTHER_TRACKS):
            judged = judged_both_ways(method, model, surfaces, settings, list(dataset), jobs, position_known=True)
            add_judged(results, _case(config), method, judged)


def _diagnosed(results: Results, config: SimulationConfig, jobs: int) -> None:
    """New tracks, predicted with the model that a diagnosis of as many others has written; and the names it found."""
    case = f"{_case(config)}, seed {config.seed}"
    with TemporaryDirectory() as folder:
        dataset, model = _written(Path(folder) / "shots", config)
        others, _ = _written(Path(folder) / "others", replace(config, seed=config.seed + OTHER_SEED))
        diagnosis = diagnose(dataset, model, jobs=jobs)
        found, surfaces = diagnosis.model, dataset_surfaces(others)
        judged = judge(found, surfaces, dataset_settings(others, found), list(others), jobs)
    add_judged(results, case, DIAGNOSED, judged)
    named = {finding.name: finding for finding in diagnosis.findings}
    planted = {"tracker_memory": config.noise.memory_time if config.noise.memory else 0.0}
    planted["stamp_jitter"] = config.noise.jitter
    for name, truth in planted.items():
        results.add(case, DIAGNOSED, f"{name}_planted", "ms", 1e3 * truth, 1)
        value = named[name].parameters["time" if name == "tracker_memory" else "sigma"].value if name in named else 0.0
        results.add(case, DIAGNOSED, f"{name}_found", "ms", 1e3 * value, 1)
    results.add(case, DIAGNOSED, "false_names", "1", len(set(named) - set(planted)), 1)


def _written(path: Path, config: SimulationConfig) -> tuple[Dataset, BallModel]:
    write_simulation(path, config)
    dataset = read_dataset(path)
    return dataset, load_model(path / "model.yaml", radius=dataset.ball.radius)


def _case(config: SimulationConfig) -> str:
    noise = config.noise
    return (
        f"{config.rate:g} Hz, {1e3 * noise.position:.1f} mm, memory {1e3 * noise.memory:.1f} mm "
        f"{1e3 * noise.memory_time:g} ms, jitter {1e3 * noise.jitter:.2f} ms, {100 * noise.dropout:g} % dropped"
        f"{', labels' if config.spin_labels else ''}"
    )


def simulated_config(seed: int, number: int, tracks: int) -> SimulationConfig:
    """One of the simulated settings: rate, noise, memory, jitter, drops and labels drawn by its number."""
    rng = np.random.default_rng([seed, number])
    rate, memory_time = float(rng.choice(RATES)), float(rng.choice(MEMORY_TIMES))
    noise = MeasurementNoise(
        position=float(rng.uniform(0.001, 0.006)),
        dropout=float(rng.choice(DROPS)),
        jitter=min(float(rng.choice(JITTERS)), MOST_JITTER / rate),
        memory=float(rng.uniform(0.001, 0.004)) if memory_time else 0.0,
        memory_time=memory_time or 0.015,
    )
    return SimulationConfig(
        tracks=tracks, rate=rate, seed=seed + number, noise=noise, spin_labels=bool(rng.integers(2))
    )


def planted_config(seed: int, number: int, tracks: int) -> SimulationConfig:
    """One of the planted trackers, at a rate at which its jitter leaves the stamps in order; again with other shots."""
    noise = PLANTED[number % len(PLANTED)]
    rate = min(PLANTED_RATE, MOST_JITTER / noise.jitter) if noise.jitter else PLANTED_RATE
    labels = number // len(PLANTED) % 2 == 0
    return SimulationConfig(
        tracks=tracks, rate=rate, seed=seed + PLANTED_SEED + number, noise=noise, spin_labels=labels
    )


def estimated(judged: Sequence[TrackPrediction]) -> list[TrackPrediction]:
    """The predictions of tracks with an estimate."""
    return [one for one in judged if one.status is not Status.FAILED]


def median_rmse(judged: Sequence[TrackPrediction]) -> float:
    """m, median over tracks of the root mean square error."""
    return float(np.median([prediction_rmse(one) for one in estimated(judged)]))


def add_judged(results: Results, case: str, method: str, judged: Sequence[TrackPrediction], whole: bool = True) -> None:
    """Coverage, error and failures; `whole`: coverage by axis and the NIS too."""
    good = estimated(judged)
    errors = np.concatenate([np.zeros((0, 3)), *(one.measured - one.positions for one in good)])
    sigmas = np.concatenate([np.zeros((0, 3)), *(one.sigmas for one in good)])
    held, add, count = inside(errors, sigmas, LEVEL), partial(results.add, case, method), len(good)
    add("coverage_90", "%", 100.0 * float(held.mean()), count)
    if whole:
        for axis, share in zip("xyz", held.mean(axis=0).tolist(), strict=True):
            add(f"coverage_90_{axis}", "%", 100.0 * share, count)
        nis = ((errors / sigmas) ** 2).sum(axis=1)  # the median of right ones is 2.37
        add("nis_median", "1", float(np.median(nis)), count)
    add("prediction_rmse_median", "mm", 1e3 * median_rmse(judged), count)
    add("failed", "1", len(judged) - count, count)
