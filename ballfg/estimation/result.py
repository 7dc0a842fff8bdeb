"""An estimate holds the states of a track with covariances, and a status that says how far to trust them."""

import enum
import operator
from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array, frame_of
from ballfg.checks import check_instance
from ballfg.estimation.segmentation.result import Contact
from ballfg.factors.linear.definite import joint_covariance
from ballfg.prediction.forecast import Forecast
from ballfg.prediction.state import BallState, World
from ballfg.state import CORRELATIONS, SIGMA_NAMES, STATE_DIM, STATE_NAMES, VZ

if TYPE_CHECKING:
    import gtsam
    from matplotlib.figure import Figure
    from pandas import DataFrame

    from ballfg.estimation.smoother.track_graph import TrackGraph


class Label(enum.IntEnum):
    """What a sample of a track shows, by its number in `Estimate.labels`; the name is the word in tables."""

    FLIGHT = 0
    """A ball that flies, bounces or is struck."""
    HELD = 1
    """A ball in a hand, that holds, carries, pushes, throws or catches it."""
    ROLLING = 2
    """A ball that rolls on something level."""
    RESTING = 3
    """A ball that lies on something."""
    LOST = 4
    """Something else than the ball."""


class Status(enum.Enum):
    """The end of an estimation; the value is a sentence with a remedy."""

    OK = "converged"
    NOT_CONVERGED = (
        "no estimate explains the samples; the states are the best that was reached. Check the table height and the "
        "noise settings, or look at the track for events that the model cannot explain"
    )
    NO_VELOCITY = (
        "there are too few samples to tell a velocity, or too long gaps between them: the states are the measured "
        "positions and the priors. Observe at least three samples of each flight, and check the unit of the stamps"
    )
    FAILED = (
        "the objective is not finite at the start; the states are the measured positions and the priors. Check the "
        "table height: the ball seems to be far below a surface that it bounces on"
    )
    IMPLAUSIBLE = (
        "no ball moves as the estimate does: some of its states were faster than 200 m/s, spun faster than 2000 rad/s, "
        "or were no numbers; in their place stand the measured positions and the priors. Check the unit of the stamps, "
        "and look at the track for jumps"
    )

    NO_FLIGHT = (
        "nothing in the track flies like a ball: the states are the measured positions. Check the units and the up "
        "axis, or give recordings in which the ball is thrown, dropped or struck"
    )
    DEPTH_UNCERTAIN = (
        "one camera saw the ball, and its motion does not show how far away it was: the covariances are wide along the "
        "rays. Observe it together with a bounce, from higher above the table, or with a second camera"
    )

    @property
    def failed(self) -> bool:
        """True if states are not estimated: they are measured positions and priors, with wide covariances."""
        return self in (Status.FAILED, Status.IMPLAUSIBLE)


@dataclass(frozen=True, eq=False)
class Estimate:
    """The states of one track.

    Attributes:
        name: of the track.
        times: (n,) s, the track's stamps.
        states: (n, 9) position m, velocity m/s, spin rad/s.
        covariances: (n, 9, 9) in the products of those units.
        other_sides: (n, 9, 9) in the same units, the share of the covariances for the chance that the ball is on the
            other side of a near contact.
        struck: (9 + p, 9 + p) in the same units and those of the coefficients, by sample: the share of the covariance
            of last samples that contradict the flight, for the chance that the ball was hit before them.
        status: how the estimation ended.
        innovations: whitened innovations by name of the observation, (m, dim) each. For a filter: measured minus
            predicted; for a smoother: measured minus its prediction from all other measurements. Each divided by its
            standard deviation: standard normal if model and noise are right. NaN for a method without innovations
            and for a measurement that is not used. The observation that locates the ball comes first: "position"
            (n, 3), or "sighting" (m, 2) in pixels.
        coefficient_names: of the p model parameters that were estimated with the track.
        coefficients: (p,) in their own units.
        coefficient_covariance: (p, p) in the products of those units.
        cross_covariances: (n, 9, p) between each state and the coefficients.
        unknown_names: of the q unknowns that observations added, such as time offsets of cameras.
        unknowns: (q,) in their own units.
        unknown_covariance: (q, q) in the products of those units.
        contacts: with a surface, in order.
        hits: (h,) intervals (between samples i and i+1) in which something hit the ball; indices.
        quality: (n,) index of `segmentation.Quality`, of each sample.
        error: objective at the minimum; NaN for methods without one.
        iterations: linear solutions of a minimisation, 0 for methods without one.
        world: model, surfaces and process noise of the estimate; predictions use them.
        notes: doubts about the track: an axis that does not fall, bounces where no surface is declared.
        labels: (n,) numbers of what samples show, as in `Label` (docs/import.md);
            empty for an estimator that is called by itself. What is no flight has its measured position.

    Raises: ValueError: states or covariances of another shape.
    """

    name: str
    times: Array
    states: Array
    covariances: Array
    status: Status
    innovations: Mapping[str, Array] = field(default_factory=dict)
    coefficient_names: tuple[str, ...] = ()
    coefficients: Array = field(default_factory=lambda: np.zeros(0))
    coefficient_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    cross_covariances: Array = field(default_factory=lambda: np.zeros((0, 9, 0)))
    unknown_names: tuple[str, ...] = ()
    unknowns: Array = field(default_factory=lambda: np.zeros(0))
    unknown_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    contacts: tuple[Contact, ...] = ()
    hits: NDArray[np.int64] = field(default_factory=lambda: np.zeros(0, dtype=np.int64))
    quality: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, dtype=np.int8))
    error: float = np.nan
    iterations: int = 0
    world: World | None = None
    notes: tuple[str, ...] = ()
    other_sides: Array = field(default_factory=lambda: np.zeros((0, 9, 9)))
    labels: NDArray[np.int8] = field(default_factory=lambda: np.zeros(0, dtype=np.int8))
    struck: Mapping[int, Array] = field(default_factory=dict)

    def __post_init__(self) -> None:
        n = len(self.times)
        for name, shape in (("states", (n, STATE_DIM)), ("covariances", (n, STATE_DIM, STATE_DIM))):
            if np.shape(getattr(self, name)) != shape:
                got = np.shape(getattr(self, name))
                raise ValueError(f"{name} of an Estimate must have shape {shape}; got {got}. Give one a stamp.")

    @property
    def falls(self) -> Array:
        """(c,) m/s, how fast the ball falls at the last sample before each contact."""
        return -self.states[[contact.interval for contact in self.contacts], VZ]

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        speed = float(np.linalg.norm(self.states[:, 3:6], axis=1).max())
        status = self.status.name.lower().replace("_", " ")
        return (
            f"Estimate({self.name!r}, {len(self)} states over {self.times[-1] - self.times[0]:.3f} s, {status};\n"
            f"    {len(self.contacts)} contacts, {len(self.hits)} hits, up to {speed:.2f} m/s"
            + "".join(f"\n    note: {note}" for note in self.notes)
            + ")"
        )

    def __getitem__(self, sample: int) -> BallState:
        """The state at a sample, with the coefficients and their covariances.

        Args: sample: its index; a negative one counts from the end.
        Raises: IndexError: a sample that the track does not have. TypeError: a slice, or anything else that is no
            index; `states` and `covariances` hold several samples.
        """
        sample = operator.index(sample)
        joint = self.covariances[sample].copy()
        if self.coefficient_names:
            joint = joint_covariance(joint, self.cross_covariances[sample], self.coefficient_covariance)
        mean = np.concatenate((self.states[sample], self.coefficients))
        other_side = self.other_sides[sample] if len(self.other_sides) else None
        struck = self.struck.get(sample % len(self))
        return BallState(
            float(self.times[sample]), mean, joint, self.coefficient_names, self.world, self.name, other_side, struck
        )

    @classmethod
    def from_gtsam(cls, graph: "TrackGraph", values: "gtsam.Values") -> "Estimate":
        """The estimate of a track at values from GTSAM, with the marginals of all factors of the graph.

        Unlike `bf.estimate` it takes one side of a contact near the track's end, the one at the values.

        Args: graph: from `bf.graph`, with further factors or without.  values: of all variables of the factors.
        Raises:
            TypeError: another graph, or values that are none of GTSAM's.  ValueError: values without a variable.
            RuntimeError: GTSAM's, if the factors leave a variable undetermined.
        """
        from ballfg.estimation.smoother.track_graph import TrackGraph

        return check_instance("graph", graph, TrackGraph, "Take bf.graph(track).").estimate(values)

    @property
    def last(self) -> BallState:
        """The state at the last sample."""
        return self[-1]

    @property
    def whitened(self) -> Array:
        """(m, dim) whitened innovations of the observation that locates the ball; NaN (n, 3) without any."""
        return next(iter(self.innovations.values()), np.full((len(self), 3), np.nan))

    @property
    def sigmas(self) -> Array:
        """(n, 9) standard deviations of the states, m, m/s and rad/s."""
        return np.sqrt(np.diagonal(self.covariances, axis1=-2, axis2=-1))

    @property
    def nis(self) -> Array:
        """(m,) squared length of `whitened`, dimensionless: chi-square with `dim` degrees of freedom."""
        return np.asarray((self.whitened**2).sum(axis=-1))

    def dated(self, times: Array, origin: float | None = None) -> "Estimate":
        """The estimate with the stamps of the data; estimators count stamps from a track's first.

        Args: times: (n,) s, the original stamps.  origin: s, the first stamp of the whole track, if these are a part.
        """
        origin = float(times[0]) if origin is None else origin
        if origin == 0.0:
            return self
        contacts = tuple(replace(c, time=origin + c.time) for c in self.contacts)
        return replace(self, times=times, contacts=contacts)

    def predict(self, horizon: float, step: float = 0.01) -> Forecast:
        """The path of the ball from the last sample on; arguments and errors as those of `BallState.predict`."""
        return self.last.predict(horizon, step)

    def to_frame(self) -> "DataFrame":
        """A pandas table with the columns of `ballfg estimate`: t, the state, its standard deviations, the label.

        Raises: ImportError: without pandas.
        """
        return frame_of(self.columns)

    @property
    def columns(self) -> dict[str, NDArray[Any]]:
        """The columns of `ballfg estimate`, (n,) each: t (s), the state, its standard deviations, what samples show."""
        states = dict(zip(STATE_NAMES, self.states.T, strict=True))
        sigmas = dict(zip(SIGMA_NAMES, self.sigmas.T, strict=True))
        words = np.array([label.name.lower() for label in Label], dtype=object)
        shown = words[self.labels if len(self.labels) else np.zeros(len(self), np.int8)]
        return {"t": self.times, **states, **sigmas, "label": shown}

    @property
    def correlations(self) -> dict[str, Array]:
        """Further columns where cameras saw the ball, (n,) each, dimensionless: those of x and y, x and z, y and z.

        Along the ray of a single camera the place is less sure than across it.
        """
        sigmas, pairs = self.sigmas, CORRELATIONS.items()
        return {name: self.covariances[:, i, j] / (sigmas[:, i] * sigmas[:, j]) for name, (i, j) in pairs}

    def plot(self) -> "Figure":
        """A picture of position, velocity and spin over time, each with a band of two standard deviations."""
        from ballfg.estimation.picture import picture

        return picture(self)


def opening(estimate: Estimate, count: int) -> Estimate:
    """The first states of an estimate, so many, and the events up to the next one."""
    by_sample = ("times", "states", "covariances", "other_sides", "cross_covariances", "quality")
    contacts = tuple(contact for contact in estimate.contacts if contact.interval < count)
    first: dict[str, Any] = {name: getattr(estimate, name)[:count] for name in by_sample}
    struck = {k: share for k, share in estimate.struck.items() if k < count}
    return replace(estimate, **first, contacts=contacts, hits=estimate.hits[estimate.hits < count], struck=struck)


def joined(
    whole: Estimate, times: Array, parts: Iterable[Estimate], status_after: Callable[[Status, Status], Status]
) -> Estimate:
    """An estimate over (n,) s with the states and events of consecutive parts; all else is that of `whole`.

    Args: status_after: that of some parts and the next one.
    """
    n, p = len(times), whole.cross_covariances.shape[2]
    states, covariances, cross = np.empty((n, STATE_DIM)), np.empty((n, STATE_DIM, STATE_DIM)), np.empty((n, 9, p))
    others = np.zeros((n, STATE_DIM, STATE_DIM))  # nearly empty: `np.zeros` takes no memory for the rest
    innovations, contacts, struck = dict[str, list[Array]](), list[Contact](), dict[int, Array]()
    hits, quality, begin, status = list[NDArray[np.int64]](), list[NDArray[np.int8]](), 0, Status.OK
    for part in parts:
        inside = slice(begin, begin + len(part))
        states[inside], covariances[inside], cross[inside] = part.states, part.covariances, part.cross_covariances
        for k in np.flatnonzero(part.other_sides.any(axis=(1, 2))):
            others[begin + k] = part.other_sides[k]
        struck |= {begin + k: share for k, share in part.struck.items()}
        for name, whitened in part.innovations.items():
            innovations.setdefault(name, []).append(whitened)
        contacts += [replace(contact, interval=contact.interval + begin) for contact in part.contacts]
        hits.append(part.hits + begin)
        quality.append(part.quality)
        status = status_after(status, part.status) if begin else part.status
        begin += len(part)
    return replace(
        whole,
        times=times,
        states=states,
        covariances=covariances,
        status=status,
        innovations={name: np.concatenate(pieces) for name, pieces in innovations.items()},
        cross_covariances=cross,
        contacts=tuple(contacts),
        hits=np.concatenate(hits),
        quality=np.concatenate(quality),
        other_sides=others,
        struck=struck,
    )
