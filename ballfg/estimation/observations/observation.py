"""Defines the interface of an observation: measurements of one kind, with all methods that estimators call.

Estimators know this interface only. A user's own kind of measurement is a subclass and a registration
(docs/custom_factors.md); most are a `Reading`, which needs one function in torch.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, ClassVar, Self

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, Index
from ballfg.checks import check_each, shown
from ballfg.dynamics.surfaces import Surfaces
from ballfg.estimation.measurement.position_noise import MOST_SCATTER
from ballfg.estimation.observations.innovation import leave_one_out, scatter
from ballfg.estimation.segmentation.result import Segmentation
from ballfg.estimation.settings import Settings
from ballfg.factors.batch import FactorBatch, Rows, Values
from ballfg.factors.linear.covariance import Covariances
from ballfg.tracks import Track

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.model import BallModel
    from ballfg.estimation.result import Estimate


@dataclass(frozen=True)
class Unknowns:
    """Unknowns that an observation adds to those of a track, such as the time offset of a camera.

    Attributes:
        names: of q unknowns, different from those of other observations.
        means: (q,) in the unknowns' own units, of their prior, from the origins on.
        sigmas: (q,) in the unknowns' own units, standard deviations of their prior.
        origins: (q,) in the unknowns' own units, the origin of the factors' values; a minimisation starts there.
    """

    names: tuple[str, ...] = ()
    means: Array = field(default_factory=lambda: np.zeros(0))
    sigmas: Array = field(default_factory=lambda: np.zeros(0))
    origins: Array = field(default_factory=lambda: np.zeros(0))


@dataclass(frozen=True)
class Context:
    """The inputs that an observation needs to make its factors.

    Attributes:
        track: of the observation.  model: the ball.  settings: noise, losses and priors.
        sigma: (n, 3) m, standard deviation of the white error of each position of the track, including samples of bad
            quality.
        velocities: (n, 3) m/s, rough, of the ball; None if stamps are exact.
        columns: place of each unknown, by name, among the coefficients that all factors of the track share.
    """

    track: Track
    model: BallModel
    settings: Settings
    sigma: Array
    columns: Mapping[str, int] = field(default_factory=dict)
    velocities: Array | None = None


class Observation(ABC):
    """Measurements of one kind that belong to a track.

    Attributes:
        name: of the kind; a track holds one observation of a name.
        state: (m,) index of the sample of the track that each of the m measurements belongs to, ascending.
        locates: True if it measures the ball's place; the positions of such a track are computed from it.
        file: name of its table in the folder of a dataset; None without a table of its own.
        columns: of that table, beside `trajectory`, `t` (s) and `sigma`.
        largest: largest possible size of a value, in the units of the columns; larger ones are refused.
        causes: what to check if measurements lie too far from the motion.
        one_view: True if it locates the ball from one point alone, so that the depth comes from the motion.
    """

    name: ClassVar[str]
    locates: ClassVar[bool] = False
    file: ClassVar[str | None] = None
    columns: ClassVar[tuple[str, ...]] = ()
    largest: ClassVar[float] = np.inf
    causes: ClassVar[str] = "their stamps, places and sigma"
    one_view: bool = False
    state: Index

    def __len__(self) -> int:
        return len(self.state)

    def __repr__(self) -> str:
        return f"{type(self).__name__}({len(self)} of {len(np.unique(self.state))} samples)"

    @abstractmethod
    def batch(self, context: Context) -> FactorBatch:
        """The factors of all m measurements, in order, each on the state of its sample.

        If the observation has unknowns, `COEFFICIENTS` is a second variable, and `context.columns` gives their places
        in it.
        """

    @abstractmethod
    def select(self, samples: NDArray[np.bool_]) -> Self:
        """The measurements of some samples of the track; the selected samples are renumbered.

        Args: samples: (n,) bool, the selected samples of the track.
        """

    def turned(self, rotation: Tensor, shift: Tensor) -> Observation:
        """The same measurements in another frame: p -> rotation p + shift.

        Args: rotation: (3, 3) about the vertical, dimensionless.  shift: (3,) m.
        Raises: ValueError: if the observation cannot be turned.
        """
        raise ValueError(
            f"tracks with the observation '{self.name}' cannot be turned. Train without augmentation (augment: false), "
            f"or write {type(self).__name__}.turned."
        )

    def unknowns(self, settings: Settings) -> Unknowns:
        """The unknowns that the observation adds to those of the track; none by default.

        Raises: ValueError: if the settings ask for unknowns that the observation does not have.
        """
        return Unknowns()

    def innovations(self, context: Context, rows: Rows, values: Values, covariances: Covariances) -> Array:
        """(m, dim) whitened: each measurement against its prediction from all others.

        Args:
            context: of the factors.
            rows: the factors linearised at the minimum.
            values: the minimum.
            covariances: of the states there and of the coefficients.
        """
        return leave_one_out(rows, covariances)

    def retimed(self, track: Track, estimate: Estimate) -> Track | None:
        """The track with stamps corrected by the unknowns; None, the default, if its stamps stay."""
        return None

    def starts(self, track: Track, model: BallModel, surfaces: Surfaces) -> tuple[Track, ...]:
        """The track with the positions from which its estimate may start, the likely ones first; by default its own.

        Args: track: of the observation, with stamps since its first.  model: the ball.  surfaces: table and floor.
        """
        return (track,)

    def loosened(self, track: Track) -> Track | None:
        """The track with the larger noise at which a search from its start converges; None, the default: its own.

        Args: track: of the observation, one of its `starts`.
        """
        return None

    def segmentation(self) -> Segmentation | None:
        """The events that the observation itself shows; None, the default: the positions show them."""
        return None

    def priors(self) -> list[FactorBatch]:
        """Further factors that the start of a track needs; by default none."""
        return []

    def judged(self, estimate: Estimate) -> Estimate:
        """The estimate of its track, with a status that says what the observation leaves open.

        By default it gets a note where measurements, or those of one source, contradict each other and the motion by
        far more than they state.
        """
        far, parts = scatter(estimate.innovations[self.name]), self._parts(estimate)
        far = far if far > MOST_SCATTER else max(parts.values(), default=far)  # one source among good ones
        if not far > MOST_SCATTER:
            return estimate
        each = ", ".join(f"{shown(name)}: {own:.2g}" for name, own in parts.items())
        note = (
            f"the measurements '{self.name}' lie {far:.2g} times as far from the motion as they state"
            f"{f' ({each})' if each else ''}: covariances are too small. Check {self.causes}."
        )
        return estimate if note in estimate.notes else replace(estimate, notes=(*estimate.notes, note))

    def _parts(self, estimate: Estimate) -> Mapping[str, float]:
        """The same figure of each source of the measurements, by its name; by default of none."""
        return {}

    def onto(self, old: Track, new: Track) -> Observation:
        """The same measurements on a track of the same ball with other stamps.

        Args: old: track of the observation.  new: track without it.
        Raises: ValueError: if the observation cannot change its stamps.
        """
        raise ValueError(
            f"track {shown(old.name)}: the observation '{self.name}' cannot stand beside time offsets that are "
            f"estimated, because it does not know how its samples move. Write {type(self).__name__}.onto, or fix "
            "the offsets."
        )

    @classmethod
    def from_table(cls, track: Track, rows: Array) -> Self:
        """The observation of a track from its rows of the table.

        Args: track: with its stamps.  rows: (m, 2 + dim) t s, the columns and sigma in their own units.
        Raises: ValueError: if the observation has no table, or the rows do not fit the track.
        """
        raise ValueError(f"the observation '{cls.name}' has no table of its own: {cls.__name__}.file is None")

    def table(self, track: Track) -> Mapping[str, Array]:
        """The columns `t`, those of the values, and `sigma`, (m,) each, in s and their own units.

        Args: track: of the observation.
        Raises: ValueError: if the observation has no table.
        """
        raise ValueError(f"the observation '{self.name}' has no table of its own: {type(self).__name__}.file is None")

    def filter_rows(self, sample: int, since: float = -np.inf, until: float = np.inf) -> Index:
        """(k,) index of the batch's rows that a filter uses at a sample; empty if it uses positions in their place.

        Args: sample: its index.  since, until: s after its stamp; rows with a time of their own must lie within.
        """
        return np.zeros(0, dtype=np.int64) if self.locates else np.flatnonzero(self.state == sample)

    def beside_contacts(
        self, batch: FactorBatch, track: Track, spans: Mapping[int, tuple[float, float]]
    ) -> FactorBatch:
        """The batch, each factor on a state of its own side of the contacts; those with no time of their own stay.

        Args:
            batch: of `batch`.  track: of the observation.
            spans: by the interval of a contact, from when to when, s, the side is not known: of the first sample's
                side before, of the second one's after it.
        """
        return batch

    def left_out(self, batch: FactorBatch) -> int:
        """Number of measurements that a batch of `beside_contacts` does not use."""
        return 0

    def single_rows(self, batch: FactorBatch) -> Iterator[tuple[int, FactorBatch]]:
        """The measurements one by one, as on a stream: sample, and a batch of one factor on state 0."""
        for row, sample in enumerate(self.state.tolist()):
            one = batch.select(np.array([row]))
            one.variables = np.zeros_like(one.variables)
            yield sample, one


def unknowns_of(observations: tuple[Observation, ...], settings: Settings) -> Unknowns:
    """The unknowns of several observations, one after the other."""
    found = [observation.unknowns(settings) for observation in observations]
    parts = ([getattr(one, name) for one in found] for name in ("means", "sigmas", "origins"))
    return Unknowns(
        tuple(name for one in found for name in one.names), *(np.concatenate([np.zeros(0), *part]) for part in parts)
    )


def refuse_unknowns(observations: Iterable[Observation], settings: Settings, estimator: str) -> None:
    """Refuses observations whose unknowns an estimator does not estimate.

    Raises: ValueError: if one of them has unknowns.
    """
    for observation in observations:
        names = observation.unknowns(settings).names
        if names:
            raise ValueError(
                f"observations of the estimator '{estimator}' must have no unknowns; '{observation.name}' has "
                f"{', '.join(names)}. Use the smoother."
            )


class GivenFactors(Observation):
    """A batch of factors, each on one state of the track; the first variable is the index of a sample."""

    def __init__(self, factors: FactorBatch, number: int) -> None:
        self.name = f"{type(factors).__name__} {number}"  # type: ignore[misc]  # one of a name in a track
        self.factors = factors
        self.number = number
        self.state = factors.variables[:, 0]

    def batch(self, context: Context) -> FactorBatch:
        """The factors."""
        return self.factors

    def select(self, samples: NDArray[np.bool_]) -> GivenFactors:
        """The factors of some samples."""
        kept = self.factors.select(np.flatnonzero(samples[self.state]))
        kept.variables = kept.variables.copy()
        kept.variables[:, 0] = (np.cumsum(samples) - 1)[kept.variables[:, 0]]
        return GivenFactors(kept, self.number)


def given(factors: Sequence[FactorBatch]) -> list[GivenFactors]:
    """Each batch as an observation.

    Raises: ValueError: if a factor ties several states. TypeError: something else than factors.
    """
    for batch in check_each("factors", factors, FactorBatch, "Write one as docs/custom_factors.md shows."):
        if (batch.variables[:, 0] < 0).any() or (batch.variables[:, 1:] >= 0).any():
            raise ValueError(
                f"factors must be on one state each, and on the coefficients beside it at most; {type(batch).__name__} "
                "ties other variables. Add those to a TrackProblem (docs/custom_factors.md)."
            )
    return [GivenFactors(batch, number) for number, batch in enumerate(factors)]
