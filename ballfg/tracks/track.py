"""A track holds stamps, positions, other observations and labels of one shot."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from typing import Any, Protocol, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array
from ballfg.checks import (
    NAME_RULE,
    TEXT_RULE,
    as_float,
    check_array,
    check_flag,
    check_name,
    is_name,
    is_text,
    shown,
    type_name,
)
from ballfg.tracks.stamps import STAMP_TOLERANCE, elapsed

SPIN_LABELS = ("spin_x", "spin_y", "spin_z")

FASTEST_BALL = 200.0  # m/s. Largest speed of a ball; the record of all sports is a shuttlecock's, 157 m/s.
FASTEST_SPIN = 2000.0  # rad/s. Largest spin of a ball; a golf ball off a wedge reaches 1,200.
Label = float | str
_WHOLE = re.compile(r"([+-]?[0-9]+)(\.0*)?")
MOST_WHOLE = 1e15  # Beyond it not every whole number is a double


def label_text(label: Label) -> str:
    """A label as text; a whole number without a decimal point, as people write it."""
    whole = not isinstance(label, str) and abs(label) < MOST_WHOLE and float(label).is_integer()
    return str(int(label)) if whole else str(label)


def level_of(label: Label, levels: Iterable[str]) -> str | None:
    """The level that a label names: the same text, else the same whole number; None without one.

    A column of numbers that holds one word is text: its "2.0" and the number 2 of another table are one level.
    """
    known, text = list(levels), label_text(label)
    if text in known or (given := _WHOLE.fullmatch(text)) is None:
        return text if text in known else None
    same = (one for one in known if (level := _WHOLE.fullmatch(one)) and int(level[1]) == int(given[1]))
    return next(same, None)


class Measurements(Protocol):
    """The interface of an observation for a track (`ballfg.estimation.Observation`)."""

    @property
    def name(self) -> str:
        """Name of the kind of measurement."""

    def select(self, samples: NDArray[np.bool_]) -> Self:
        """The measurements of the selected samples (n,) bool of the track."""


@dataclass(frozen=True, eq=False)
class Track:
    """A ball's measured positions over time, with all further measurements.

    The arrays are copied and converted to float64; every field is checked when the track is made.
    Two tracks are equal only if they are the same object.

    Raises: ValueError: a wrong shape, a value that is not finite, a stamp that does not increase, a sigma that
        is not positive, or a bad label; the message names the index. TypeError: a name that is not a str, labels that
        are no mapping, or something else in place of an observation.
    """

    times: Array
    """(n,) s, n >= 1, strictly increasing. The origin is the data's own."""
    positions: Array
    """(n, 3) m, world frame, z up."""
    sigmas: Array | None = None
    """(n, 3) m, standard deviation of each coordinate, positive; None if the data do not state it."""
    labels: Mapping[str, Label] = field(default_factory=dict)
    """Labels of the shot: spin_x, spin_y, spin_z (rad/s, at the first sample), group, launcher settings."""
    name: str = "track"
    """The trajectory's name, as in the column `trajectory`: "000" stays "000"."""
    observations: tuple[Any, ...] = ()
    """Measurements other than positions: `ballfg.estimation.Observation`s, one of a name."""
    rough: bool = False
    """True if the positions were computed from the observations: they then serve to find events only."""
    part: bool = False
    """True for a part of a longer track. Its scale was checked with the whole; a few samples do not show it."""
    dataset: Any = None
    """The dataset of the track, with its ball, table and noise. Processes do not get it."""

    def __post_init__(self) -> None:
        check_name("track name", self.name, "Rename the trajectory.")
        where = f"track {shown(self.name)}"
        times = _finite(where, "times", self.times)
        if times.ndim != 1 or len(times) == 0:
            rule = "times must have shape (n,) with n >= 1"
            raise ValueError(f"{where}: {rule}; got {times.shape}. Pass one stamp per sample.")
        wrong = np.flatnonzero(np.diff(times) <= 0)
        if wrong.size:
            i = int(wrong[0]) + 1
            got = f"times[{i}]={times[i]} <= times[{i - 1}]={times[i - 1]}"
            raise ValueError(f"{where}: times must be strictly increasing; {got}. Sort or drop duplicates.")
        positions = _finite(where, "positions", self.positions, (len(times), 3))
        sigmas = self.sigmas
        if sigmas is not None:
            sigmas = _finite(where, "sigmas", sigmas, (len(times), 3))
            if (sigmas <= 0).any():
                i, axis = (int(k) for k in np.argwhere(sigmas <= 0)[0])
                rule = f"{where}: sigmas must be positive; sigmas[{i}, {axis}]={sigmas[i, axis]}"
                raise ValueError(f"{rule}. Give a standard deviation in m, or no sigmas at all.")
        labels = _checked_labels(where, self.labels)
        for key, value in {"times": times, "positions": positions, "sigmas": sigmas, "labels": labels}.items():
            object.__setattr__(self, key, value)
        check_flag("rough", self.rough)
        check_flag("part", self.part)
        observations = _checked_observations(where, self.observations, len(times), self.rough)
        object.__setattr__(self, "observations", observations)

    def __getstate__(self) -> dict[str, Any]:
        return {**self.__dict__, "dataset": None}

    def __len__(self) -> int:
        return len(self.times)

    def __repr__(self) -> str:
        beside = "".join(f", {observation!r}" for observation in self.observations)
        return f"Track({self.name!r}, {len(self)} samples, {self.duration:.3f} s{beside})"

    def observed(self, *observations: Measurements) -> Self:
        """The track with further observations.

        Args: observations: `ballfg.estimation.Observation`s, one of a name.
        Raises: ValueError: if the track has an observation of that name.
        """
        return replace(self, observations=(*self.observations, *observations)) if observations else self

    @property
    def seconds(self) -> Array:
        """(n,) s since the first sample, for computations that must not depend on the clock's origin."""
        return elapsed(self.times, float(self.times[0]))

    @property
    def duration(self) -> float:
        """Time from the first sample to the last, s."""
        return float(self.seconds[-1])

    def since_first(self) -> Self:
        """The same track with stamps counted from its first, for estimators."""
        return self if self.times[0] == 0.0 else replace(self, times=self.seconds)

    def opening(self, seconds: float) -> Self:
        """The samples of the first seconds, including a stamp at their end, as a new track.

        Args: seconds: since the first sample; not negative.
        """
        count = int(np.searchsorted(self.seconds, seconds + STAMP_TOLERANCE, side="right"))
        return self if count == len(self) else self.until(float(self.times[count - 1]))

    @property
    def one_view(self) -> bool:
        """True if one camera alone saw the ball, so that its motion gives the depth."""
        return any(getattr(observation, "one_view", False) for observation in self.observations)

    @property
    def spin_label(self) -> Array | None:
        """(3,) rad/s: the labelled spin at the first sample; None unless all three components are labelled."""
        values = [self.labels[key] for key in SPIN_LABELS if key in self.labels]
        return np.array(values, dtype=np.float64) if len(values) == len(SPIN_LABELS) else None

    def between(self, start: float, end: float) -> Self:
        """The samples with start <= time <= end, as a new track.

        The spin labels belong to the first sample, so a part without that sample does not have them.

        Args: start, end: s, in the track's own time.
        Raises: ValueError: if no sample lies there. TypeError: a start or end that is no number.
        """
        start, end = as_float("start", start, "s"), as_float("end", end, "s")
        for name, time in (("start", start), ("end", end)):
            if np.isnan(time):
                raise ValueError(f"track {shown(self.name)}: {name} must be a time in s; got nan. Correct it.")
        inside = (self.times >= start) & (self.times <= end)
        if not inside.any():
            raise ValueError(
                f"track {shown(self.name)}: between(start, end) must hold a sample; got [{start:g}, {end:g}] s while "
                f"the track covers [{self.times[0]:g}, {self.times[-1]:g}] s. Widen the interval."
            )
        return replace(
            self,
            times=self.times[inside],
            positions=self.positions[inside],
            sigmas=None if self.sigmas is None else self.sigmas[inside],
            labels={key: value for key, value in self.labels.items() if inside[0] or key not in SPIN_LABELS},
            observations=tuple(observation.select(inside) for observation in self.observations),
            part=self.part or not inside.all(),
        )

    def until(self, end: float) -> Self:
        """The samples with time <= end (s, in the track's own time), as a new track.

        Raises: ValueError: if the first sample is later than that.
        """
        return self.between(-np.inf, end)


def _checked_observations(where: str, observations: object, samples: int, rough: bool) -> tuple[Any, ...]:
    found = tuple(observations) if isinstance(observations, Iterable) else (observations,)
    for observation in found:
        if not isinstance(getattr(observation, "name", None), str) or not hasattr(observation, "select"):
            raise TypeError(
                f"{where}: observations must be a tuple of Observations; got {type_name(observation)} "
                f"{shown(observation)}. Give RadarSpeed or another one of ballfg.estimation."
            )
        last = int(np.max(observation.state, initial=0))
        if last >= samples:
            rule = f"{where}: state of {shown(observation.name)} must be the index of a sample, at most {samples - 1}"
            of_any_time = f"Readings with times of their own: {type(observation).__name__}.at."
            remedy = of_any_time if hasattr(observation, "at") else "Count samples from 0."
            raise ValueError(f"{rule}; got {last}. {remedy}")
    names = [observation.name for observation in found]
    if len(set(names)) < len(names):
        raise ValueError(f"{where}: observations must have different names; got {names}. Join those of one name.")
    if rough and not names:
        raise ValueError(f"{where}: rough positions must come with the observations that they were made from.")
    return found


def _finite(where: str, argument: str, value: ArrayLike, shape: tuple[int, ...] | None = None) -> Array:
    array = check_array(f"{where}: {argument}", value, shape, "Pass one row per sample.")
    if not np.isfinite(array).all():
        index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
        got = f"{argument}[{', '.join(map(str, index))}]={array[index]}"
        raise ValueError(f"{where}: {argument} must be finite; {got}. Drop that sample.")
    return array


def _checked_labels(where: str, labels: Mapping[str, Label]) -> dict[str, Label]:
    if not isinstance(labels, Mapping):
        raise TypeError(
            f"{where}: labels must be a mapping of names to numbers or text; got {type_name(labels)} "
            f"{shown(labels)}. Write them like {{'spin_y': 120.0}}."
        )
    checked: dict[str, Label] = {}
    for key, value in labels.items():
        if not isinstance(key, str) or not is_name(key) or key == "trajectory":
            rule = f"label names must be {NAME_RULE}, other than 'trajectory'"
            raise ValueError(f"{where}: {rule}; got {shown(key)}. Rename it.")
        if isinstance(value, str) and key not in SPIN_LABELS:
            if not is_text(value):
                raise ValueError(f"{where}: label {shown(key)} must be {TEXT_RULE}; got {shown(value)}. Correct it.")
            checked[key] = value
        elif isinstance(value, int | float | np.integer | np.floating) and np.isfinite(value):
            if key in SPIN_LABELS and abs(value) > FASTEST_SPIN:
                rule = f"label {shown(key)} must be within {FASTEST_SPIN:g} rad/s, as the spin of every ball"
                raise ValueError(f"{where}: {rule}; got {value:g}. Correct it, or leave it out if it is unknown.")
            checked[key] = float(value)
        else:
            rule = f"label {shown(key)} must be a finite number{'' if key in SPIN_LABELS else ' or text'}"
            raise ValueError(f"{where}: {rule}; got {shown(value)}. Leave the label out if it is unknown.")
    return checked
