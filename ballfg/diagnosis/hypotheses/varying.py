"""A varying hypothesis lets an effect differ between tracks, by group or along the recording.

Such a hypothesis is flexible: groups that differ in their spins, say, would absorb any effect that depends on spin. It
is tried only if no effect that is equal for all tracks helps.
"""

import itertools
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Final

import numpy as np

from ballfg.arrays import Index
from ballfg.diagnosis.fit.effects import has_effect, with_effects
from ballfg.diagnosis.fit.fit import covariance_of
from ballfg.diagnosis.fit.free import LOOSE, Deviation, spread
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.hypotheses.hypothesis import Hypothesis
from ballfg.diagnosis.result import Value
from ballfg.dynamics import AnalyticModel, Coefficient, Scene
from ballfg.dynamics.effect import Effect
from ballfg.dynamics.variation import TRACK, number_of, place_of
from ballfg.tracks import Track

MOST_GROUPS: Final = 8  # Largest number of values of a label that defines groups; a wheel speed or a player has more
LEAST_TRACKS: Final = 3
"""Least number of tracks on either side of a change, and in each group of either half, for their scatter."""
PARTS: Final = 8  # Number of parts of a recording after which a change is first tested; its place is then refined


@dataclass(frozen=True)
class Grouping:
    """One grouping of tracks."""

    by: str  # The label, or "track" for the place in the recording
    weights: Mapping[str, Mapping[str, float]]
    """By name of a level, the weight (by name of the track) of the level's own deviation."""
    first: str = ""  # Name of the first track, of a place in the recording
    line: bool = False  # True for a steady change along the recording

    @property
    def suffix(self) -> str:
        """Suffix of the name of a finding."""
        return "_drift" if self.by == TRACK else "_by_group"

    def named(self, level: str) -> str:
        """A level in a report: `backspin`, `from 024`, `at 099`."""
        return level if self.by != TRACK else f"{'at' if self.line else 'from'} {level}"


def groupings(tracks: Sequence[Track], searched: Sequence[str]) -> list[Grouping]:
    """All groupings of the tracks of a dataset, in the order of the recording; searched: names of the search half's."""
    found = []
    for label in sorted({name for track in tracks for name, value in track.labels.items() if isinstance(value, str)}):
        known = {track.name: str(track.labels[label]) for track in tracks if label in track.labels}
        levels = sorted(set(known.values()))
        counts = Counter(known[name] for name in set(searched) if name in known)
        if 2 <= len(levels) <= MOST_GROUPS and all(counts[level] >= 2 * LEAST_TRACKS for level in levels):
            weights = {level: {n: 1.0 for n, value in known.items() if value == level} for level in levels}
            found.append(Grouping(label, weights))
    return [*found, *_by_place([track.name for track in tracks], searched)]


def _by_place(names: Sequence[str], searched: Sequence[str]) -> list[Grouping]:
    """Steps and a line; none if names do not give the order of the recording."""
    places = [place_of(name) for name in names]
    if any(later <= earlier for earlier, later in itertools.pairwise(places)):
        return []
    begins = np.unique(np.linspace(0, len(searched), PARTS + 1).round().astype(int)[1:-1])
    inside = [b for b in begins.tolist() if LEAST_TRACKS <= b <= len(searched) - LEAST_TRACKS]
    if not inside or not names:
        return []
    found = [_step(names, searched[begin]) for begin in inside]
    numbers = [number_of(name) for name in names]
    known: Index = np.array([n for n in numbers if n is not None])
    if len(known) == len(names) and (np.diff(known) > 0).all():
        along = (known - known[0]) / (known[-1] - known[0])
        weights = dict(zip(names, along.tolist(), strict=True))
        found.append(Grouping(TRACK, {names[-1]: weights}, names[0], line=True))
    return found


def _step(names: Sequence[str], begin: str) -> Grouping:
    return Grouping(TRACK, {begin: {n: float(place_of(n) >= place_of(begin)) for n in names}}, names[0])


@dataclass(frozen=True)
class Varying(Hypothesis):
    """An effect whose coefficients may differ between tracks, as their grouping says.

    Its strengths are the deviations, `e[backspin]`: of each varying coefficient, for each level.
    """

    grouping: Grouping = field(kw_only=True)

    @classmethod
    def of(cls, effect: type[Effect], coefficients: Sequence[str], grouping: Grouping) -> "Varying":
        """The hypothesis that some coefficients of an effect differ."""
        strengths = tuple(f"{c}[{grouping.named(level)}]" for c in coefficients for level in grouping.weights)
        return cls(effect, {}, strengths, PARTS if grouping.by == TRACK else 1, grouping=grouping)

    @property
    def name(self) -> str:
        """Name of the effect with its variation: `restitution_drift`, `table_tilt_by_group`."""
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
        return {s: replace(listed[varied(s)], name=s, default=0.0, absent=0.0) for s in self.strengths}

    @property
    def usual(self) -> bool:
        """False: no ball usually differs from track to track."""
        return False

    def free(self) -> dict[str, Coefficient]:
        """The deviations; bounds apply only to the sum of a coefficient and its deviations."""
        listed = {c.name: LOOSE * spread(c) for c in self.effect.coefficients}
        return {
            self.parameter(n): replace(c, sigma=listed[varied(n)], low=c.low - c.high, high=c.high - c.low)
            for n, c in self.coefficients.items()
        }

    def deviations(self) -> dict[str, Deviation]:
        """The deviations of the fit, by name of the unknown."""
        way, found = self.grouping, {}
        for strength in self.strengths:
            level, coefficient = self._levels[_level(strength)], self.parameter(varied(strength))
            weights = way.weights[level]
            found[self.parameter(strength)] = Deviation(coefficient, weights, way.by, level, way.first, way.line)
        return found

    @property
    def _levels(self) -> dict[str, str]:
        """Levels by their names in a report."""
        return {self.grouping.named(level): level for level in self.grouping.weights}

    def added_to(self, model: AnalyticModel) -> AnalyticModel:
        """The model with the effect at zero strength for all tracks; the model itself if it has the effect."""
        if has_effect(model, self.effect.name):
            return model
        absent = {c.name: c.absent for c in self.effect.coefficients if c.absent is not None}
        return with_effects(model, self.effect(**absent))

    def reported(self, fit: Fit, values: Mapping[str, Value]) -> dict[str, Value]:
        """The coefficients at each level, for a report; values: fitted deviations, by strength."""
        variations, told = fit.variations(), dict[str, Value]()
        for strength, deviation in values.items():
            name = self.parameter(varied(strength))
            known, summed = variations[name].values, [self.parameter(strength)]
            if name in fit.problem.free:
                summed.append(name)
                if first := self.grouping.first:
                    begin = f"{varied(strength)}[{self.grouping.named(first)}]"
                    sigma = float(np.sqrt(covariance_of(fit, [name])[0, 0]))
                    told.setdefault(begin, Value(known[first], sigma, deviation.unit))
            sigma = float(np.sqrt(covariance_of(fit, summed).sum()))
            told[strength] = replace(deviation, value=known[self._levels[_level(strength)]], sigma=sigma)
        return told


def varying_hypotheses(
    model: AnalyticModel, scene: Scene, catalogue: Iterable[type[Effect]], free: Iterable[str], ways: Sequence[Grouping]
) -> list[Varying]:
    """Hypotheses that each effect differs between tracks in each way.

    For an effect of the model, its estimated coefficients (`free`, parameter names) without a variation; for an absent
    one all, if it has one shape only and does not act on spins.
    """
    free, listed = set(free), []
    for effect in catalogue:
        if has_effect(model, effect.name):
            begin = f"{effect.kind}.{effect.name}."
            taken = any(name.startswith(begin) and "[" in name for name in free)
            names = tuple(c.name for c in effect.coefficients if begin + c.name in free and not taken)
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
    """The hypothesis with its step at every nearby track of the search half; itself without a step."""
    grouping, coefficients = hypothesis.grouping, tuple(dict.fromkeys(varied(s) for s in hypothesis.strengths))
    if grouping.by != TRACK or grouping.line:
        return [hypothesis]
    reach, at = max(1, len(searched) // PARTS), searched.index(next(iter(grouping.weights)))
    begins = range(max(LEAST_TRACKS, at - reach), min(len(searched) - LEAST_TRACKS, at + reach) + 1)
    return [Varying.of(hypothesis.effect, coefficients, _step(names, searched[begin])) for begin in begins]


def varied(strength: str) -> str:
    """The coefficient of a strength, `e` of `e[backspin]`."""
    return strength.partition("[")[0]


def _level(strength: str) -> str:
    return strength.partition("[")[2].removesuffix("]")
