"""Diagnoses several rooms together, with one ball for all, and rooms and rigs of their own.

One fit holds the flights of all rooms. Coefficients of flight are shared; those of bounce and measurement have a value
for each room, tied together by their priors.
"""

import copy
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Final
from weakref import WeakKeyDictionary

import numpy as np
import torch

from ballfg.checks import check_range
from ballfg.diagnosis.diagnosis import in_order, told
from ballfg.diagnosis.fit.effects import has_effect, with_effects, without_effect
from ballfg.diagnosis.fit.fit import first_guess, fit_model, fit_problem, reachable
from ballfg.diagnosis.fit.free import LOOSE, Deviation, declared_free
from ballfg.diagnosis.fit.holdout import Holdout, hold_out
from ballfg.diagnosis.fit.patterns import DRIFT
from ballfg.diagnosis.fit.problem import Fit, Noise, Problem
from ballfg.diagnosis.fit.stretches import Stretches, joined
from ballfg.diagnosis.generic_test import LabelCheck
from ballfg.diagnosis.hypotheses.varying import Grouping, Varying
from ballfg.diagnosis.report.wording import joined as listed
from ballfg.diagnosis.residual_tests.generic import generic_tests, predicted_test
from ballfg.diagnosis.residual_tests.label_check import judged, label_evidence, label_test
from ballfg.diagnosis.result import Diagnosis, Errors, Finding
from ballfg.diagnosis.search.evaluation import calibrated_model, errors_of, fitted_model, noise_about
from ballfg.diagnosis.search.loop import NAMED, SearchLoop
from ballfg.dynamics import EFFECTS, AnalyticModel, BallModel
from ballfg.dynamics.effect import Effect
from ballfg.tracks import Dataset

ROOM: Final = "room"  # The label that identifies the rooms
MOST_TRACKS: Final = 60  # Largest number of tracks per room, evenly spread: rooms must not wait for the largest of them


@dataclass(frozen=True)
class Room:
    """One room: its name, its tracks in two halves, the noise about a fit of its own, and the place of its settings."""

    name: str
    holdout: Holdout
    noise: Noise
    settings: slice


@dataclass(frozen=True)
class JointDiagnosis:
    """Findings of several rooms; `whole.model` is the ball's, for a new room, `rooms` hold the model of each room."""

    whole: Diagnosis
    rooms: dict[str, AnalyticModel]


def diagnose_jointly(
    datasets: Sequence[Dataset],
    model: AnalyticModel,
    *,
    jobs: int = 1,
    watch: Callable[[str], None] | None = None,
    catalogue: Sequence[type[Effect]] | None = None,
    name_at: float = NAMED,
) -> JointDiagnosis:
    """Finds the effects that a model of the ball lacks in several rooms, and those of single rooms.

    Args:
        datasets: one for each room, with unique names, at least two.
        model: the analytic model to compare all tracks with.
        jobs: processes.
        watch: called with a line for each stage.
        catalogue: candidate effects; by default all registered ones.
        name_at: probability, 0 to 1, from which on an effect is named.
    Returns: the findings, the model of the ball and those of the rooms.
    Raises: ValueError: for fewer than two datasets, equal names, a dataset with wrong stamps, too few tracks, or a
        model that differs between tracks.
    """
    check_range("name_at", name_at, 0.0, 1.0)
    if model.variations:
        raise ValueError(
            f"model must be the same for all tracks of all rooms; {', '.join(model.variations)} differ between tracks. "
            "Leave its section 'variations' out."
        )
    tell = watch or (lambda line: None)
    rooms = _rooms(datasets, model, jobs, tell)
    search_half, held_out = (_together(rooms, half) for half in ("search", "held_out"))
    halves = replace(rooms[0].holdout, search=search_half, held_out=held_out, tracks=())
    tell(f"fitting the ball to {len(halves.search)} flights of {len(rooms)} rooms")
    names = {room.name: (*room.holdout.search.names, *room.holdout.held_out.names) for room in rooms}
    way = Grouping(ROOM, {room: {f"{room}/{name}": 1.0 for name in own} for room, own in names.items()})
    predicting = _Predicting(rooms, jobs)
    effects = tuple(catalogue or EFFECTS.values())
    of_ball = tuple(e for e in effects if e.belongs_to == "ball")
    asked = (halves, of_ball, predicting, predicting.judge, tell)
    loop = SearchLoop(*asked, jobs=jobs, of_some=effects, ways=lambda searched: [way], name_at=name_at)
    search = loop.run(model, _first_fit(model, halves, way))
    tell("looking at what is left")
    models = predicting.models[predicting(search.whole)]
    labels = _labels(rooms, models, model, jobs)
    of_labels = () if labels is None else (label_test(labels),)
    patterns = (test for test in generic_tests(search.fit, search.first) if test.name != DRIFT)
    searched = len(np.unique(halves.search.track))
    tests = in_order(*patterns, predicted_test(search.before, search.judged, searched), *of_labels)
    remarks = [*_of_whom(search.findings), *predicting.errors_by_room(search.declared, search.predictive)]
    together, new = ", ".join(room.name for room in rooms), _of_a_new_room(search.whole, model)
    whole = told(search, model, together, new, searched, tests, labels)
    excluded = tuple(f"{room.name}: {line}" for room in rooms for line in room.holdout.excluded)
    return JointDiagnosis(replace(whole, excluded=excluded, remarks=(*remarks, *whole.remarks)), models)


def _labels(
    rooms: Sequence[Room], models: Mapping[str, AnalyticModel], declared: AnalyticModel, jobs: int
) -> LabelCheck | None:
    """The verdicts on the spin labels of all rooms; each is compared with its flight in its own room."""
    found = []
    for room in rooms:
        flights = label_evidence(models[room.name], declared, room.holdout, jobs=jobs)
        found += [replace(flight, name=f"{room.name}/{flight.name}") for flight in flights]
    return judged(found)


def _rooms(datasets: Sequence[Dataset], model: AnalyticModel, jobs: int, tell: Callable[[str], None]) -> list[Room]:
    names = [dataset.info.name for dataset in datasets]
    if len(names) < 2 or len(set(names)) < len(names):
        raise ValueError(
            f"datasets must be two or more, each with a name of its own; got {', '.join(names)}. Correct 'name' in "
            "dataset.yaml."
        )
    rooms, column = [], 0
    for name, dataset in zip(names, datasets, strict=True):
        tell(f"room {name}")
        holdout = hold_out(dataset, model, jobs, tell, most_tracks=MOST_TRACKS)
        if holdout.stamps.found:
            raise ValueError(
                f"stamps of {name} must be times; they show {' and '.join(holdout.stamps.found)}. Diagnose it by "
                "itself, correct its stamps, and come back."
            )
        place = slice(column, column := column + holdout.search.settings.shape[1])
        rooms.append(Room(name, holdout, fit_model(model, holdout.search, holdout.settings).noise, place))
    return rooms


def _together(rooms: Sequence[Room], half: str) -> Stretches:
    """The stretches of all rooms, each with the noise about its own fit and its launcher's own settings."""
    parts, track = [], 0
    for room in rooms:
        own: Stretches = getattr(room.holdout, half)
        settings = np.zeros((len(own), rooms[-1].settings.stop))
        settings[:, room.settings] = own.settings
        names = tuple(f"{room.name}/{name}" for name in own.names)
        sigmas = own.sigmas * torch.from_numpy(room.noise.position)
        parts.append(replace(own, names=names, track=own.track + track, settings=settings, sigmas=sigmas))
        track = int(parts[-1].track.max()) + 1
    return joined(parts)


def _first_fit(model: AnalyticModel, halves: Holdout, way: Grouping) -> Fit:
    """The fit of the declared model; coefficients of bounce and measurement may differ within their priors."""
    model = copy.deepcopy(model).requires_grad_(False)
    problem = Problem(model, reachable(model, halves.search), declared_free(model))
    free, deviations = dict(problem.free), dict[str, Deviation]()
    for effect in (e for e in model.effects if e.kind != "flight"):
        names = [c.name for c in effect.coefficients if f"{effect.kind}.{effect.name}.{c.name}" in problem.free]
        varying = Varying.of(type(effect), names, way)
        free |= {name: replace(c, sigma=c.sigma / LOOSE) for name, c in varying.free().items()}
        deviations |= varying.deviations()
    problem = replace(problem, free=free, deviations=deviations)
    unknowns, noise = first_guess(problem, halves.settings.spin_label_noise, halves.settings.spin_prior)
    return fit_problem(problem, unknowns, noise)


def _of_a_new_room(fit: Fit, declared: AnalyticModel) -> AnalyticModel:
    """The ball's model: the shared coefficients and effects of all rooms."""
    model = fitted_model(fit)
    for deviation in fit.problem.deviations.values():
        name = deviation.coefficient.split(".")[1]
        if not has_effect(declared, name) and deviation.coefficient not in fit.problem.free:
            model = without_effect(model, name)
    return model


class _Predicting:
    """Makes the models of all rooms from a fit, and evaluates them on their held-out halves."""

    def __init__(self, rooms: Sequence[Room], jobs: int) -> None:
        self.rooms, self.jobs = rooms, jobs
        self.models: WeakKeyDictionary[BallModel, dict[str, AnalyticModel]] = WeakKeyDictionary()
        self._judged: WeakKeyDictionary[BallModel, dict[str, Errors]] = WeakKeyDictionary()

    def __call__(self, fit: Fit) -> AnalyticModel:
        models = {room.name: self._model(fit, room) for room in self.rooms}
        model = with_effects(fit.problem.model)
        self.models[model] = models
        return model

    def judge(self, model: BallModel) -> Errors:
        """The errors on the judging halves of all rooms."""
        if model not in self._judged:
            self._judged[model] = self._errors(self.models[model])
        return _pooled(self._judged[model])

    def errors_by_room(self, declared: BallModel, corrected: BallModel) -> list[str]:
        """A sentence on each room's error of prediction before and after."""
        before, after = self._judged[declared], self._judged[corrected]
        return [
            f"Room {room.name}: prediction RMSE {before[room.name].prediction_rmse_mm:.1f} mm before, "
            f"{after[room.name].prediction_rmse_mm:.1f} mm after."
            for room in self.rooms
        ]

    def _model(self, fit: Fit, room: Room) -> AnalyticModel:
        rows = np.array([name.startswith(f"{room.name}/") for name in fit.problem.stretches.names])
        stretches = fit.problem.stretches.take(rows)
        stretches = replace(stretches, settings=stretches.settings[:, room.settings])
        found = fit.problem.by_stretch(fit.unknowns.values, stretches)
        values = {name: float(np.ravel(value)[0]) for name, value in found.items()}
        noise = replace(fit.noise, position=fit.noise.position * room.noise.position)
        own, holdout = replace(fit.problem, stretches=stretches, deviations={}), room.holdout
        unknowns = replace(fit.unknowns, values=values, launcher=fit.unknowns.launcher[room.settings])
        model = calibrated_model(Fit(own, unknowns, noise, fit.predicted), holdout.launcher.embedding)
        model.noise = noise_about(model, holdout.search_tracks, holdout.dataset, jobs=self.jobs)
        return model

    def _errors(self, models: dict[str, AnalyticModel]) -> dict[str, Errors]:
        found = {}
        for room in self.rooms:
            model, holdout = models[room.name], room.holdout
            found[room.name] = errors_of(model, holdout, holdout.held_out_tracks, self.jobs)
        return found


def _pooled(by_room: dict[str, Errors]) -> Errors:
    """Errors of all rooms with equal weights: geometric means of lengths, means of the rest."""
    every = list(by_room.values())

    def middle(name: str) -> float:
        return float(np.mean([getattr(one, name) for one in every]))

    def typical(name: str) -> float:
        return float(np.exp(np.nanmean(np.log([getattr(one, name) for one in every]))))

    return Errors(
        typical("prediction_rmse_mm"),
        typical("apex_rmse_mm"),
        middle("nis"),
        middle("log_likelihood"),
        np.concatenate([one.by_track for one in every]),
        middle("intervals_held"),
        middle("nis_median"),
        tuple(replace(path, name=f"{room}/{path.name}") for room, one in by_room.items() for path in one.paths),
        float(np.sqrt(np.square([one.nis_error for one in every]).sum()) / len(every)),
    )


def _of_whom(findings: Sequence[Finding]) -> list[str]:
    """The effects of the ball, and those of single rooms."""
    names = [finding.name for finding in findings]
    own = tuple(n for n in names if n.endswith("_by_group"))
    shared = tuple(n for n in names if n not in own)
    texts = [f"{listed(shared)}: of the ball, wanted alike in all rooms."] if shared else []
    return [*texts, f"{listed(own)}: of single rooms."] if own else texts
