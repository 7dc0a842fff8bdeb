"""Finds the spins of groups of tracks together with the coefficients: more numbers of the same population.

Each track's posterior of its first spin, along its launch, stands beside that of its coefficients, with their
correlation; the prior's information is removed from both. The spins of a group's tracks are draws about the group's
mean, with the group's spread along each axis (`fit_population`).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import product
from typing import Final

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.checks import listed, shown
from ballfg.dynamics.effects.generic import FUNCTIONS
from ballfg.dynamics.population import SpinGroup, SpinPopulation, launch_axes
from ballfg.dynamics.variation import Variation
from ballfg.estimation import Estimate, Settings
from ballfg.estimation.observations.sighted_dataset import SightedDataset
from ballfg.factors.loss import Loss
from ballfg.learning.calibration.coefficients import Chosen
from ballfg.learning.calibration.population import Evidence, Population, evidence, fit_population
from ballfg.learning.evaluation import Plain
from ballfg.state import SPIN, VELOCITY
from ballfg.tracks import Dataset
from ballfg.tracks.track import label_text

WIDEST: Final = 200.0
"""rad/s, standard deviation of the prior of a group's mean spin about zero; its spread begins there."""
LABEL_PRIOR: Final = 2000.0  # rad/s, the smoother's prior beside a spin label (`UNINFORMATIVE_SPIN`)
OWN: Final = "group"  # The label without which a dataset is one group of its own name
WIDTHS: Final = (0.003, 0.03, 0.1, 0.3, 0.6)
"""Standard deviations of the prior of a correction, relative to drag and lift, among which the evidence chooses: next
to none, and some per cent up to what a law that is wrong by half needs. Beyond them the evidence overfits."""
Columns = tuple[Array, Array, Array, Array]
Three = tuple[float, float, float]


class GroupSpin(Plain):
    """The spins of one group, (3,) rad/s forward, across and up; all zero before the first step."""

    mean: Three = (0.0, 0.0, 0.0)
    sigma: Three = (0.0, 0.0, 0.0)  # Standard errors of the mean
    spread: Three = (0.0, 0.0, 0.0)  # Standard deviations between tracks
    next_track: Three = (0.0, 0.0, 0.0)  # Standard deviations of a new track's spin about the mean

    def moved(self, shift: Array, factor: Array) -> "GroupSpin":
        """With another mean, and standard errors times some factors. Args: shift: (3,) rad/s.  factor: (3,)."""
        mean, sigma, wide = (np.array(values) for values in (self.mean, self.sigma, self.next_track))
        own = sigma * factor
        found = (mean + shift, own, np.sqrt(np.maximum(wide**2 - sigma**2, 0.0) + own**2))
        parts = zip(("mean", "sigma", "next_track"), (tuple(one.tolist()) for one in found), strict=True)
        return self.model_copy(update=dict(parts))

    @classmethod
    def rows(cls, mean: Array, sigma: Array, spread: Array, next_track: Array, first: int) -> "tuple[GroupSpin, ...]":
        """Of each group. Args: mean, sigma, spread, next_track: (first + 3 groups,) the coefficients come first."""
        parts = [values[first:].reshape(-1, 3).tolist() for values in (mean, sigma, spread, next_track)]
        names = ("mean", "sigma", "spread", "next_track")
        return tuple(
            cls(**dict(zip(names, (tuple(p) for p in part), strict=True))) for part in zip(*parts, strict=True)
        )


@dataclass(frozen=True)
class Groups:
    """The groups of a calibration."""

    by: str  # the label that names them
    names: tuple[str, ...]  # of the fitted tracks' groups, sorted
    tracks: Mapping[str, str]  # the group of each fitted track, by the track's name
    labelled: frozenset[str]  # names of the fitted tracks with a spin label, which takes the place of the group's prior
    own: str  # the group of tracks without the label

    @classmethod
    def of(cls, dataset: Dataset | SightedDataset, by: str, fit: Sequence[str]) -> "Groups":
        """The groups of a dataset's fitted tracks. Raises: ValueError: if no track has the label."""
        if by not in dataset.label_names and by != OWN:
            known = listed(dataset.label_names) if dataset.label_names else "none"
            raise ValueError(
                f"groups must be a label of {dataset.path}, which has {known}; got {shown(by)}. Add the column to "
                f"labels.csv, or give '{OWN}' for one group of all tracks."
            )
        own, wanted = dataset.info.name, set(fit)
        fitted = [track for track in dataset if track.name in wanted]
        tracks = {track.name: label_text(track.labels.get(by, own)) for track in fitted}
        labelled = frozenset(track.name for track in fitted if track.spin_label is not None)
        return cls(by, tuple(sorted(set(tracks.values()))), tracks, labelled, own)

    @property
    def start(self) -> tuple[GroupSpin, ...]:
        """Before the first step."""
        return (GroupSpin(),) * len(self.names)

    def population(self, spins: Sequence[GroupSpin]) -> SpinPopulation:
        """The population for a model file. Args: spins: of each group, in the order of the names."""
        return self._population([(spin.mean, spin.next_track) for spin in spins])

    def settings(self, settings: Settings, population: SpinPopulation) -> Settings:
        """Settings with a population, in which a track without the label is of the dataset's own group."""
        return replace(settings, spins=population, group=self.own if self.own in population.groups else None)

    def wide(self, settings: Settings, spins: Sequence[GroupSpin]) -> Settings:
        """Settings with a wide Gaussian prior about each group's last mean, which `evidence` removes again."""
        sigma = (settings.spin_prior,) * 3
        about = self._population([(spin.mean, sigma) for spin in spins])
        return replace(self.settings(settings, about), spin_loss=Loss("squared"))

    def evidence(
        self, estimate: Estimate, chosen: Chosen, about: Array, spins: Sequence[GroupSpin], spin_prior: float
    ) -> Evidence:
        """The likelihood of one track's coefficients and first spin, (p + 3) numbers.

        Args:
            estimate: with the settings of `wide`.
            chosen: the coefficients.
            about: (p,) those of its model.
            spins: as for `wide`.
            spin_prior: rad/s, the width of `wide`.
        Raises: ValueError: if the covariance is not positive definite.
        """
        columns, size = [estimate.coefficient_names.index(name) for name in chosen.names], len(chosen.names)
        axes = launch_axes(estimate.states[0, VELOCITY])
        covariance = np.zeros((size + 3, size + 3))
        covariance[:size, :size] = estimate.coefficient_covariance[np.ix_(columns, columns)]
        covariance[size:, size:] = axes @ estimate.covariances[0][SPIN, SPIN] @ axes.T
        covariance[size:, :size] = axes @ estimate.cross_covariances[0][SPIN][:, columns]
        covariance[:size, size:] = covariance[size:, :size].T
        mean = np.concatenate((estimate.coefficients[columns], axes @ estimate.states[0, SPIN]))
        labelled = estimate.name in self.labelled
        before = np.zeros(3) if labelled else np.array(spins[self._number(estimate.name)].mean)
        sigma = np.full(3, LABEL_PRIOR if labelled else spin_prior)
        return evidence(mean, covariance, np.concatenate((about, before)), np.concatenate((chosen.sigma, sigma)))

    def fit(
        self, evidences: Sequence[Evidence], tracks: Sequence[str], chosen: Chosen
    ) -> tuple[Population, dict[str, tuple[float, ...]], tuple[GroupSpin, ...], Array]:
        """The population of all tracks, and what differs between groups.

        A coefficient gets a mean and a spread for each group if that raises the log likelihood by more than half the
        logarithm of the number of tracks for each further number (G. Schwarz, "Estimating the dimension of a model",
        Ann. Statist. 6, 1978).

        Args: evidences: of the tracks.  tracks: their names.  chosen: the coefficients.
        Returns: the population with coefficients shared by all groups; means by group of those that differ; spins;
            (p,) standard deviations of a new track's coefficients about the mean of its group.
        """
        columns, numbers, size = self.beside(chosen), self.numbers(tracks, chosen), len(chosen.names)
        columns, best = _widest(evidences, columns, numbers, chosen.alike, chosen.without_spread)
        shared = best
        own = np.array([self._number(name) for name in tracks])
        apart: dict[str, int] = {}
        varied = [pair for pair in chosen.listed if pair[1] not in chosen.steady]
        for k, name in varied if len(self.names) > 1 else ():
            first = len(columns[0])
            split = numbers.copy()
            split[:, k] = first + own
            start, sigma, low, high = (np.append(values, np.full(len(self.names), values[k])) for values in columns)
            wider = (start, sigma, low, high)
            found = fit_population(evidences, *wider, split, chosen.without_spread)
            if found.log_likelihood - best.log_likelihood > (len(self.names) - 1) * np.log(len(tracks)):
                best, columns, numbers, apart[name] = found, wider, split, first
        next_track = np.sqrt((best.next_track[numbers[:, :size]] ** 2).mean(axis=0))
        values = {name: tuple(best.mean[k : k + len(self.names)].tolist()) for name, k in apart.items()}
        every = (best.mean, best.sigma, best.spread, best.next_track)
        mean, sigma, spread, next_spin = (numbers_of[: size + 3 * len(self.names)] for numbers_of in every)
        return shared, values, GroupSpin.rows(mean, sigma, spread, next_spin, size), next_track

    def variations(self, by_group: Mapping[str, Sequence[float]]) -> dict[str, Variation]:
        """The entries of a model file. Args: by_group: means in the order of the names, by coefficient."""
        return {
            name: Variation(self.by, dict(zip(self.names, values, strict=True))) for name, values in by_group.items()
        }

    def beside(self, chosen: Chosen) -> Columns:
        """Start, sigma and both bounds of all means: (p + 3 groups,) each, the coefficients first."""
        count = 3 * len(self.names)
        further = (np.zeros(count), np.full(count, WIDEST), np.full(count, -np.inf), np.full(count, np.inf))
        own = (chosen.start, chosen.sigma, chosen.low, chosen.high)
        start, sigma, low, high = (np.concatenate(pair) for pair in zip(own, further, strict=True))
        return start, sigma, low, high

    def numbers(self, tracks: Sequence[str], chosen: Chosen) -> Index:
        """(n, p + 3) which of the means of `beside` the numbers of each track, by its name, are draws about."""
        size = len(chosen.names)
        firsts = size + 3 * np.array([self._number(name) for name in tracks])
        shared = np.tile(np.arange(size), (len(tracks), 1))
        return np.concatenate((shared, firsts[:, None] + np.arange(3)), axis=1)

    def _number(self, track: str) -> int:
        return self.names.index(self.tracks[track])

    def _population(self, spins: Sequence[tuple[Three, Three]]) -> SpinPopulation:
        counts = list(self.tracks.values())
        rows = zip(self.names, spins, strict=True)
        return SpinPopulation(self.by, {name: SpinGroup(*spin, counts.count(name)) for name, spin in rows})


def _widest(
    evidences: Sequence[Evidence], columns: Columns, numbers: Index, alike: Index, without_spread: Index
) -> tuple[Columns, Population]:
    """The population, and its columns with the priors of the shared coefficients that have the largest evidence.

    The weights of each force have a width of their own: lift may saturate where drag is nearly as declared. Mean and
    covariance are those over all widths, each as probable as its evidence says.
    """
    if not len(alike):
        return columns, fit_population(evidences, *columns, numbers)
    start, sigma, low, high = columns
    forces, tried = alike.reshape(-1, len(FUNCTIONS)), []
    for widths in product(WIDTHS, repeat=len(forces)):
        own = sigma.copy()
        own[forces] = np.array(widths)[:, None]
        tried.append(
            ((start, own, low, high), fit_population(evidences, start, own, low, high, numbers, without_spread))
        )
    evidence_of = np.array([found.log_evidence for _, found in tried])
    share = np.exp(evidence_of - evidence_of.max())
    share /= share.sum()
    means = np.array([found.mean for _, found in tried])
    mean = share @ means
    away = (means - mean) * np.sqrt(share)[:, None]
    covariance = np.tensordot(share, np.array([found.covariance for _, found in tried]), 1) + away.T @ away
    wide, best = tried[int(share.argmax())]
    return wide, replace(best, mean=mean, covariance=covariance)
