"""The hypothesis that an effect is not the same for all tracks: it differs by group or along the recording.

Such a hypothesis is flexible: groups that differ in their spins, say, would have it take in any effect that depends on
spin. It is tried only where no effect that is the same for all tracks helps.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np

from ballfg.diagnosis.fit.fit import covariance_of
from ballfg.diagnosis.fit.problem import Deviation, Fit
from ballfg.diagnosis.result import Value
from ballfg.diagnosis.search.grouping import Grouping, steps_between, steps_near
from ballfg.diagnosis.search.hypothesis import LOOSE, Hypothesis, has_effect, spread, with_effects
from ballfg.dynamics import AnalyticModel, Coefficient, Effect, Scene
from ballfg.dynamics.variation import TRACK


@dataclass(frozen=True)
class Varying(Hypothesis):
    """An effect whose coefficients may differ between tracks.

    Attributes:
        effect, shape: as of `Hypothesis`.
        strengths: the deviations, `e[backspin]`: of each coefficient that varies, for each level.
        grouping: how tracks differ.
    """

    grouping: Grouping = field(kw_only=True)

    @classmethod
    def of(cls, effect: type[Effect], coefficients: Sequence[str], grouping: Grouping) -> "Varying":
        """The hypothesis that some coefficients of an effect differ."""
        strengths = tuple(f"{c}[{grouping.named(level)}]" for c in coefficients for level in grouping.weights)
        return cls(effect, {}, strengths, grouping=grouping)

    @property
    def name(self) -> str:
        """Name of the effect, and how it varies: `restitution_drift`, `table_tilt_by_group`."""
        return self.effect.name + self.grouping.suffix

    @property
    def sentence(self) -> str:
        """Its meaning in words."""
        if self.grouping.by == TRACK:
            return f"The coefficients of {self.effect.name} change along the recording: another ball, table or day."
        return f"The coefficients of {self.effect.name} differ between the tracks' values of '{self.grouping.by}'."

    @property
    def decide(self) -> str:
        """The measurement that would decide."""
        if self.grouping.by == TRACK:
            return "Repeat shots of the first part at the end of the recording."
        return "Shoot the groups in turns, with the same ball and in the same place."

    @cached_property
    def coefficients(self) -> dict[str, Coefficient]:
        """The deviations as coefficients, by name."""
        listed = {c.name: c for c in self.effect.coefficients}
        return {s: replace(listed[_varied(s)], name=s, default=0.0, absent=0.0) for s in self.strengths}

    def known_as(self, coefficient: str) -> str:
        """The coefficient whose plausible range holds for a level."""
        return f"{self.effect.name}.{_varied(coefficient)}"

    def parameter(self, coefficient: str) -> str:
        """Its name among the unknowns of a fit."""
        return f"{self.effect.kind}.{self.effect.name}.{coefficient}"

    @property
    def usual(self) -> bool:
        """No ball usually differs from track to track."""
        return False

    def free(self) -> dict[str, Coefficient]:
        """The deviations; only the sum of a coefficient and its deviations has bounds."""
        listed = {c.name: LOOSE * spread(c) for c in self.effect.coefficients}
        return {
            self.parameter(n): replace(c, sigma=listed[_varied(n)], low=c.low - c.high, high=c.high - c.low)
            for n, c in self.coefficients.items()
        }

    def deviations(self) -> dict[str, Deviation]:
        """The deviations of the fit, by name of the unknown."""
        way, found = self.grouping, {}
        for strength in self.strengths:
            level = self._levels[_level(strength)]
            found[self.parameter(strength)] = Deviation(
                self._coefficient(strength), way.weights[level], way.by, level, way.first, way.line
            )
        return found

    @property
    def _levels(self) -> dict[str, str]:
        """Levels by their names in a report."""
        return {self.grouping.named(level): level for level in self.grouping.weights}

    def _coefficient(self, strength: str) -> str:
        return f"{self.effect.kind}.{self.effect.name}.{_varied(strength)}"

    def added_to(self, model: AnalyticModel) -> AnalyticModel:
        """The model with the effect in it, absent for all tracks alike; the model itself where it has the effect."""
        if has_effect(model, self.effect.name):
            return model
        absent = {c.name: c.absent for c in self.effect.coefficients if c.absent is not None}
        return with_effects(model, self.effect(**absent))

    def told(self, fit: Fit, values: Mapping[str, Value]) -> dict[str, Value]:
        """The coefficients at each level, for a report; values: deviations as fitted, by strength."""
        variations, told = fit.variations(), dict[str, Value]()
        for strength, deviation in values.items():
            name = self._coefficient(strength)
            known, summed = variations[name].values, [self.parameter(strength)]
            if name in fit.problem.free:
                summed.append(name)
                if first := self.grouping.first:
                    begin = f"{_varied(strength)}[{self.grouping.named(first)}]"
                    sigma = float(np.sqrt(covariance_of(fit, [name])[0, 0]))
                    told.setdefault(begin, Value(known[first], sigma, deviation.unit))
            sigma = float(np.sqrt(covariance_of(fit, summed).sum()))
            told[strength] = replace(deviation, value=known[self._levels[_level(strength)]], sigma=sigma)
        return told


def varying_hypotheses(
    model: AnalyticModel, scene: Scene, catalogue: Iterable[type[Effect]], free: Iterable[str], ways: Sequence[Grouping]
) -> list[Varying]:
    """Effects of which each may differ between tracks in each way.

    Of an effect in the model those coefficients may that a fit estimates (`free`, parameter names), and that do not
    vary yet; of an absent one all, if it has one shape only and does not act on spins.
    """
    free, listed = set(free), []
    for effect in catalogue:
        if has_effect(model, effect.name):
            names = tuple(c.name for c in effect.coefficients if f"{effect.kind}.{effect.name}.{c.name}" in free)
            taken = any(name.startswith(f"{effect.kind}.{effect.name}.") and "[" in name for name in free)
            names = () if taken else names
        else:
            single = tuple(effect.shapes(scene)) == ({},) and not effect.multiplies_spin
            formed = any(c.absent is None for c in effect.coefficients)
            usual = any(c.default != c.absent for c in effect.coefficients)
            acts = all(has_effect(model, needed) for needed in effect.needs)
            acts &= effect.kind != "bounce" or scene.contacts > 0
            acts &= not effect.name.startswith("spin_label")
            names = tuple(c.name for c in effect.coefficients) if single and acts and not (formed or usual) else ()
        listed += [Varying.of(effect, names, way) for way in ways if names]
    return listed


def near(hypothesis: Varying, searched: Sequence[str], names: Sequence[str]) -> list[Varying]:
    """The hypothesis with its step at every place near by; itself where it has no step."""
    coefficients = tuple(dict.fromkeys(_varied(s) for s in hypothesis.strengths))
    ways = steps_near(hypothesis.grouping, searched, names)
    return [Varying.of(hypothesis.effect, coefficients, way) for way in ways]


def between(hypothesis: Varying, searched: Sequence[str], names: Sequence[str]) -> list[Varying]:
    """The hypothesis with its step before each track that lies between two of the search half."""
    coefficients = tuple(dict.fromkeys(_varied(s) for s in hypothesis.strengths))
    ways = steps_between(hypothesis.grouping, searched, names)
    return [Varying.of(hypothesis.effect, coefficients, way) for way in ways]


def _varied(strength: str) -> str:
    return strength.partition("[")[0]


def _level(strength: str) -> str:
    return strength.partition("[")[2].removesuffix("]")
