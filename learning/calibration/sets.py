"""Calibrates several datasets, each by itself, for a model of balls and rooms that none of them shows.

Each set has its own coefficients, which are draws from a population of sets: `fit_population` finds its mean and spread
with a set in the place of a track. A track of an unknown set has the mean, and a prior as wide as both spreads, between
sets and from track to track, which its first samples narrow. Each set is judged by what the others say.
"""

import sys
from collections.abc import Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, Final

import numpy as np
import torch

from ballfg.arrays import Array
from ballfg.checks import aligned
from ballfg.dynamics import AnalyticModel, save_model
from ballfg.dynamics.domain import Domain
from ballfg.estimation import Settings
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.learning.calibration.calibrate import fitted_noise, with_shown_noise
from ballfg.learning.calibration.coefficients import Chosen, with_values
from ballfg.learning.calibration.groups import OWN
from ballfg.learning.calibration.population import Population, evidence, fit_population
from ballfg.learning.calibration.predicting import finished
from ballfg.learning.calibration.problem import Problem, Step, pose, score
from ballfg.learning.calibration.run import read_checkpoint, status_of, take_steps
from ballfg.learning.config.calibration import CalibrationConfig
from ballfg.learning.evaluation import Gain, TrackScore, denser, gain_of, summary
from ballfg.learning.run import run_folder as files
from ballfg.learning.training_data import analytic_model, check_apart, open_source
from ballfg.progress import Watch
from ballfg.tracks import Dataset
from ballfg.tracks.noise import TrackNoise

LEAST: Final = 2  # Sets that a population needs


@dataclass(frozen=True)
class OneSet:
    """A dataset and its calibration."""

    problem: Problem
    last: Step

    @property
    def name(self) -> str:
        """Of the dataset."""
        return self.problem.dataset.info.name


@dataclass(frozen=True)
class Abroad:
    """What sets have in common: the mean and spread between them of p coefficients.

    Attributes:
        chosen: the coefficients.  population: of the sets.
        sigma: (p,) standard deviations of the coefficients of a track in an unknown set.
    """

    chosen: Chosen
    population: Population
    sigma: Array

    @classmethod
    def of(cls, sets: Sequence[OneSet]) -> "Abroad":
        """Of some calibrations of the same coefficients."""
        chosen = sets[0].problem.chosen
        means = [
            evidence(np.array(one.last.mean), np.diag(np.square(one.last.sigma)), chosen.start, chosen.sigma)
            for one in sets
        ]
        found = fit_population(means, chosen.start, chosen.sigma, chosen.low, chosen.high)
        within = np.mean([np.square(one.last.spread) for one in sets], axis=0)
        return cls(chosen, found, np.sqrt(found.next_track**2 + within))

    @property
    def spreads(self) -> dict[str, float]:
        """The standard deviations by name."""
        return dict(zip(self.chosen.names, self.sigma.tolist(), strict=True))

    def model(self, model: AnalyticModel) -> AnalyticModel:
        """A copy of the model with the mean, and the standard deviations as its tracks' spread."""
        found = with_values(model, self.chosen.names, self.population.mean)
        found.noise = TrackNoise(coefficients=self.spreads)
        return found


def calibrate_sets(config: CalibrationConfig, folder: Path, *, resume: bool, jobs: int, watch: Watch) -> int:
    """Calibrate several datasets and write the folder of the run; arguments and errors as of `run_calibration`.

    Returns: the exit status of `ballfg-train`: 0 if sets are predicted better by what the others say, else 1.
    """
    with files.running(folder, config, resume=resume):
        torch.set_num_threads(1)  # as in `run_calibration`
        datasets = [open_source(path, config.source, config.anyway) for path in config.data or ()]
        _check_alike(datasets)
        model = analytic_model(config.model, datasets[0].info.ball)
        problems = [pose(dataset, model, _own(config, dataset), config.jobs or jobs) for dataset in datasets]
        files.start(folder, config)
        try:
            sets = [
                _calibrated(problem, folder / f"set_{number}", watch)
                for number, problem in enumerate(problems, start=1)
            ]
        except KeyboardInterrupt:
            print(f"the steps are kept; continue with --resume {folder}", file=sys.stderr)
            raise
        abroad = Abroad.of(sets)
        found = abroad.model(model)
        every = (track for one in datasets if isinstance(one, Dataset) for track in one)
        found.domain = Domain.of(every, [one.info.ball.radius for one in datasets if isinstance(one, Dataset)])
        pairs = {one.name: _judged(one, [other for other in sets if other is not one], watch) for one in sets}
        gain = _gain([pair for each in pairs.values() for pair in each])
        save_model(found, folder / files.MODEL)
        files.write_json(folder / files.REPORT, _report(sets, abroad, pairs, gain))
        print(f"\n{_verdict(gain)}\n\n{_table(sets, abroad, pairs)}\n")
        print(f"{folder / files.MODEL}: the model for other rooms, for the --model of other commands")
        print(f"{folder / files.REPORT}: all numbers")
        return status_of("not known" if gain is None else gain.word, proven=False)


Pairs = list[tuple[TrackScore, TrackScore]]


def _check_alike(datasets: Sequence[Dataset | SightedDataset]) -> None:
    names, radii = [one.info.name for one in datasets], {one.info.ball.radius for one in datasets}
    if len(set(names)) < max(len(names), LEAST):
        raise ValueError(f"datasets must have names that differ; got {', '.join(names)}. Rename one in dataset.yaml.")
    if any(one.one_view for one in datasets):
        raise ValueError(
            "several datasets need positions, or two cameras; one camera shows no spins. Calibrate it alone."
        )
    if len(radii) > 1:
        raise ValueError(f"data must be of one kind of ball; got radii {sorted(radii)} m. Calibrate each kind apart.")
    measured = [(number, one) for number, one in enumerate(datasets) if isinstance(one, Dataset)]
    check_apart(datasets, ((number, track) for number, one in measured for track in one))


def _own(config: CalibrationConfig, dataset: Dataset | SightedDataset) -> CalibrationConfig:
    """The config of one set: with spins of its groups, or of all as one, which would else change its drag."""
    groups = config.groups if config.groups in dataset.label_names else OWN
    return config.model_copy(update={"data": str(dataset.path), "groups": groups})


def _calibrated(problem: Problem, place: Path, watch: Watch) -> OneSet:
    """The calibration of one set, after the steps that its folder holds."""
    problem = with_shown_noise(problem, watch)
    fitting = replace(problem, split=replace(problem.split, judge=()))
    steps, _ = read_checkpoint(place, fitting)
    place.mkdir(exist_ok=True)
    print(f"{problem.dataset.info.name}: {len(problem.split.fit)} tracks fit, {len(problem.split.judge)} judge")
    take_steps(fitting, steps, place, watch)
    return OneSet(problem, finished(fitting, steps[-1], watch, errors=False).step)


def _judged(one: OneSet, others: Sequence[OneSet], watch: Watch) -> Pairs:
    """Scores of a set's judging tracks with the first model and with what the others say."""
    problem, abroad = one.problem, Abroad.of(others)
    found = abroad.model(problem.model)
    given = {**problem.settings.coefficients, **abroad.spreads}
    before = _scores(problem, problem.model, problem.settings, watch)
    after = _scores(problem, found, replace(problem.settings, coefficients=given), watch)
    return [(b, a) for b, a in zip(before, after, strict=True) if b is not None and a is not None]


def _scores(problem: Problem, model: AnalyticModel, settings: Settings, watch: Watch) -> tuple[TrackScore | None, ...]:
    """With the noise that the set's fitted tracks show about the model."""
    noise = fitted_noise(problem, model, settings, watch, errors=False)
    return score(problem, model, settings if noise is None else noise.settings, watch)


def _gain(pairs: Pairs) -> Gain | None:
    before, after = np.array([(b.rmse, a.rmse) for b, a in pairs]).reshape(-1, 2).T
    found = gain_of(before, after)
    if found is None:
        return None
    return replace(found, density=denser(*np.array([(b.log_score, a.log_score) for b, a in pairs]).T))


def _verdict(gain: Gain | None) -> str:
    if gain is None:
        return "Too few tracks could be judged: whether the sets help each other is not known."
    return f"In a set that it does not know, the model of the others predicts {gain.word}: {gain}."


def _report(sets: Sequence[OneSet], abroad: Abroad, pairs: dict[str, Pairs], gain: Gain | None) -> dict[str, Any]:
    """The content of `report.json`, without times and paths: the same run writes the same bytes."""
    chosen, found = abroad.chosen, abroad.population
    rows = {
        name: {
            "unit": chosen.units[k],
            "before": float(chosen.start[k]),
            "after": float(found.mean[k]),
            "sigma": float(found.sigma[k]),
            "spread_between_sets": float(found.spread[k]),
            "next_track_sigma": float(abroad.sigma[k]),
            "sets": {one.name: {"mean": one.last.mean[k], "sigma": one.last.sigma[k]} for one in sets},
        }
        for k, name in chosen.listed
    }
    judged = {
        name: {when: None if (s := summary(list(part))) is None else s.model_dump() for when, part in _sides(each)}
        for name, each in pairs.items()
    }
    change = None if gain is None else asdict(gain)
    outcome = "not known" if gain is None else gain.word
    return {"coefficients": rows, "judged": judged, "outcome": outcome, "change": change, "verdict": _verdict(gain)}


def _sides(pairs: Pairs) -> list[tuple[str, list[TrackScore]]]:
    return [("before", [before for before, _ in pairs]), ("after", [after for _, after in pairs])]


def _table(sets: Sequence[OneSet], abroad: Abroad, pairs: dict[str, Pairs]) -> str:
    """Coefficients of the sets, their mean and spread, and errors, as plain text."""
    names = [one.name for one in sets]
    rows: list[tuple[str, ...]] = [("", "unit", *names, "mean", "sigma", "spread between sets", "of a track")]
    found = abroad.population
    for k, name in abroad.chosen.listed:
        numbers = (*(one.last.mean[k] for one in sets), found.mean[k], found.sigma[k], found.spread[k], abroad.sigma[k])
        rows.append((name, abroad.chosen.units[k], *(f"{number:.4g}" for number in numbers)))
    errors: list[tuple[str, ...]] = [("judged by the others", "tracks", "median RMSE, mm", "90 % hold, %")]
    for name, each in pairs.items():
        both = [summary(part) for _, part in _sides(each)]
        medians = " -> ".join("-" if s is None else f"{1e3 * s.rmse_median:.1f}" for s in both)
        held = " -> ".join("-" if s is None else f"{100 * s.coverage_90:.0f}" for s in both)
        errors.append((name, str(len(each)), medians, held))
    return "\n\n".join("\n".join(aligned(part)) for part in (rows, errors))
