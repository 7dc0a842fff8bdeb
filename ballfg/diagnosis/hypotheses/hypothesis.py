"""A hypothesis is one effect, in one shape, that the model may lack."""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import cast

import numpy as np

from ballfg.diagnosis.fit.effects import has_effect, with_effects
from ballfg.diagnosis.fit.free import LOOSE, Deviation, spread
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.result import Value
from ballfg.dynamics import AnalyticModel, Coefficient
from ballfg.dynamics.effect import Effect, Scene, Vector

TWINS: Mapping[str, tuple[str, ...]] = {"gravity": ("buoyancy",)}
"""Effects that are equivalent to another one in a model: the other one is listed for both."""
LEAST_GAP = 1e-4  # s. Least distance of stamps for a speed
AROUND = 0.1  # s to each side of a contact for the speed before it: offsets of time shift it


@dataclass(frozen=True)
class Hypothesis:
    """An effect that the model may lack, by its class."""

    effect: type[Effect]
    shape: Mapping[str, float] = field(default_factory=dict)
    """Coefficients of its form (a centre, a reference), and values that are tried as a whole."""
    strengths: tuple[str, ...] = ()  # Coefficients of its size, for score tests: at their absent values nothing changes
    choices: int = 1  # Number of shapes among which this one was chosen

    @property
    def name(self) -> str:
        """Name of the effect."""
        return self.effect.name

    def deviations(self) -> dict[str, Deviation]:
        """Its unknowns that act on some tracks more than on others; none if the effect is the same for all."""
        return {}

    def reported(self, fit: Fit, values: Mapping[str, Value]) -> dict[str, Value]:
        """Coefficients for a report; values: fitted ones, by coefficient."""
        shape = {c: Value(v, 0.0, self.coefficients[c].unit) for c, v in self.shape.items() if c not in values}
        return {**values, **shape}

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """Coefficients of the effect, by name."""
        return {c.name: c for c in self.effect.coefficients}

    def parameter(self, coefficient: str) -> str:
        """Name of a coefficient among the model's parameters."""
        return f"{self.effect.kind}.{self.effect.name}.{coefficient}"

    @property
    def columns(self) -> tuple[str, ...]:
        """Parameter names of the strengths."""
        return tuple(self.parameter(c) for c in self.strengths)

    @property
    def usual(self) -> bool:
        """True for a usual effect: its nominal strength is not zero, and its absence is far from it."""
        return any(self.coefficients[n].default != self.coefficients[n].absent for n in self.strengths)

    def free(self) -> dict[str, Coefficient]:
        """Coefficients that a refit estimates in addition: strengths, and uncertain shapes."""
        listed = self.coefficients
        loose = {self.parameter(n): replace(listed[n], sigma=LOOSE * spread(listed[n])) for n in self.strengths}
        formed = {self.parameter(n): listed[n] for n in self.shape if listed[n].absent is None and listed[n].sigma > 0}
        return loose | formed

    def added_to(self, model: AnalyticModel) -> AnalyticModel:
        """The model with the effect at zero strength; the model itself if it has the effect already."""
        if has_effect(model, self.name):
            return model
        absent = {n: cast(float, self.coefficients[n].absent) for n in self.strengths}
        return with_effects(model, self.effect(**{**self.shape, **absent}))


def hypotheses(model: AnalyticModel, scene: Scene, catalogue: Iterable[type[Effect]]) -> list[Hypothesis]:
    """All effects that the model may lack and that can act in the scene of the data, in the order of the catalogue.

    A missing effect of the catalogue whose needs are met is listed in each shape for the scene. An effect of the model
    is listed with the coefficients that are declared as exact.
    """
    listed: list[Hypothesis] = []
    catalogue = tuple(catalogue)
    searched = {effect.name for effect in catalogue}
    doubled = {twin for name, twins in TWINS.items() if name in searched and has_effect(model, name) for twin in twins}
    for effect in catalogue:
        if effect.name in doubled:
            continue
        if has_effect(model, effect.name):
            exact = tuple(c.name for c in effect.coefficients if c.sigma == 0.0 and c.absent is not None)
            listed += [Hypothesis(effect, {}, exact)] if exact else []
            continue
        bounces = effect.kind != "bounce" or scene.contacts > 0
        labels = not effect.name.startswith("spin_label") or scene.labels > 0
        if bounces and labels and all(has_effect(model, needed) for needed in effect.needs):
            strengths = tuple(c.name for c in effect.coefficients if c.absent is not None)
            shapes = tuple(effect.shapes(scene))
            listed += [Hypothesis(effect, shape, strengths, len(shapes)) for shape in shapes]
    return listed


def scene_of(fit: Fit) -> Scene:
    """The extent of a fit's stretches: places in m, speeds and impacts in m/s, and the number of spin labels.

    Labels count that differ from zero by more than their noise: where all are zero, a wrong scale fits any spin.
    """
    stretches = fit.problem.stretches
    used = stretches.used.numpy()
    positions = stretches.positions.numpy()[used]
    times = fit.problem.model.true_stamps(stretches.times).detach().numpy()
    gaps = np.maximum(np.gradient(times, axis=1), LEAST_GAP)[..., None]
    velocities = np.gradient(fit.predicted.positions, axis=1) / gaps
    falls = []  # the steepest near each contact: differences across or after it are smaller
    for i, row in enumerate(fit.predicted.contacts):
        for time in row[np.isfinite(row)]:
            first, last = np.searchsorted(times[i], (time - AROUND, time + AROUND))
            before = min(first, times.shape[1] - 1)  # the last sample, of a contact just after it
            falls.append(-velocities[i, before : last + 1, 2].min())
    impacts = [fall for fall in falls if fall > 0.0]
    low, high, middle = (
        cast(Vector, tuple(place.tolist()))
        for place in (positions.min(axis=0), positions.max(axis=0), np.median(positions, axis=0))
    )
    speed = float(np.median(np.linalg.norm(velocities[used], axis=-1)))
    impact = float(np.median(impacts)) if impacts else float("nan")
    spins = np.linalg.norm(stretches.labels.numpy()[stretches.labelled], axis=1)
    return Scene(low, high, middle, speed, impact, len(impacts), int((spins > fit.noise.label).sum()))
