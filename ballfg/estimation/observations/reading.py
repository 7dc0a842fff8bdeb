"""A reading compares an instrument's numbers with one torch function of the ball's state."""

from __future__ import annotations

import copy
from abc import abstractmethod
from collections.abc import Hashable, Mapping
from functools import partial
from typing import TYPE_CHECKING, ClassVar, Final, Self

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ballfg.arrays import Array, Index
from ballfg.checks import check_array, check_instance, shown
from ballfg.deferred import torch
from ballfg.estimation.observations.observation import Context, Observation
from ballfg.factors.batch import FactorBatch
from ballfg.factors.loss import Loss
from ballfg.state import SPIN, VELOCITY
from ballfg.tracks import Track
from ballfg.tracks.stamps import elapsed
from ballfg.tracks.track import FASTEST_BALL, FASTEST_SPIN

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.model import BallModel

FARTHEST: Final = 0.05  # s. A reading farther from every sample is refused: the ball may bounce in so long a time
LEAST_SPEED: Final = 1e-6  # m/s. Below it the derivative of the velocity's length is set to zero


class Reading(Observation):
    """Readings of one instrument, with independent Gaussian noise.

    A subclass declares its name and its columns in a file, and implements `predicted`. Jacobians, the gradient of
    learning, the update of filters, innovations, reading and writing follow from that.

    Args:
        state: (m,) index of the sample nearest in time to each reading.
        values: (m, dim), or (m,) where dim is 1, in the units of the columns.
        sigma: standard deviation of each value in the same units; a number, (m,), or (m, dim).
        delay: (m,) s, time of each reading minus the stamp of its sample; None: zero. The state is carried over it in
            free flight.

    Attributes:
        file: name of the table in the folder of a dataset, with the columns `trajectory`, `t`, those of the values,
            and `sigma`.
        columns: of the values in that table; `dim` of them.
        periods: in the units of the columns, of those that wrap, such as `{"azimuth": 2 * pi}`; a residual is the
            shorter way round.
        loss: on the norm of a whitened reading.

    Raises: ValueError: a wrong shape, an index that is no whole number, a value that is not finite, a sigma that is not
        positive.
    """

    file: ClassVar[str | None]
    periods: ClassVar[Mapping[str, float]] = {}
    loss: ClassVar[Loss] = Loss("huber", 3.0)

    def __init_subclass__(cls) -> None:
        """Checks the periods.

        Raises: ValueError: a period of no column, or one that is not positive and finite.
        """
        super().__init_subclass__()
        for column, period in cls.periods.items():
            if column not in cls.columns or not 0.0 < period < np.inf:
                raise ValueError(
                    f"{cls.__name__}.periods must give columns that wrap a positive, finite period; got "
                    f"{shown(column)}: {period}. Its columns are {', '.join(cls.columns)}."
                )

    def __init__(self, state: ArrayLike, values: ArrayLike, sigma: ArrayLike, delay: ArrayLike | None = None) -> None:
        m, dim = np.size(state), len(self.columns)
        index = check_array(f"state of '{self.name}'", state)
        if not np.isfinite(index).all() or (index < 0.0).any() or (index % 1.0).any():
            raise ValueError(
                f"state of '{self.name}' must be indices of samples, whole numbers from 0 on; got "
                f"{shown(index.tolist())}. Make readings with times of their own by the class's method at."
            )
        self.state: Index = index.astype(np.int64).reshape(m)
        given = check_array(f"values of '{self.name}'", values)
        given = given[None] if given.ndim == 0 and np.ndim(state) == 0 else given  # one reading, as a plain number
        if given.shape not in ((m, dim), (m,) if dim == 1 else (m, dim)):
            raise ValueError(f"values of '{self.name}' must have shape ({m}, {dim}); got {given.shape}")
        self.values: Array = given.reshape(m, dim)
        spread = check_array(f"sigma of '{self.name}'", sigma)
        if spread.shape not in ((), (m,), (m, dim)):
            raise ValueError(f"sigma of '{self.name}' must be one number, ({m},) or ({m}, {dim}); got {spread.shape}")
        self.sigma: Array = np.broadcast_to(spread[:, None] if spread.ndim == 1 else spread, (m, dim)).copy()
        self.delay: Array = np.zeros(m) if delay is None else check_array(f"delay of '{self.name}'", delay).reshape(-1)
        if len(self.delay) != m:
            raise ValueError(f"delay of '{self.name}' must have shape ({m},); got ({len(self.delay)},)")
        if not np.isfinite(self.values).all() or not np.isfinite(self.delay).all():
            raise ValueError(f"values of '{self.name}' must be finite; leave out readings that are not")
        if (np.abs(self.values) > self.largest).any():
            raise ValueError(
                f"values of '{self.name}' must be within {self.largest:g}, as of every ball; got "
                f"{np.abs(self.values).max():g}. Correct them, or leave them out."
            )
        if not (np.isfinite(self.sigma).all() and (self.sigma > 0.0).all()):
            raise ValueError(f"sigma of '{self.name}' must be positive and finite; leave out readings without a sigma")
        if (np.diff(self.state) < 0).any():
            raise ValueError(f"state of '{self.name}' must ascend; sort the readings by time")

    @abstractmethod
    def predicted(self, state: Tensor) -> Tensor:
        """(..., dim) noise-free readings of balls in states (..., 9)."""

    @classmethod
    def at(cls, track: Track, times: ArrayLike, values: ArrayLike, sigma: ArrayLike) -> Self:
        """Readings at any times, each with the nearest sample of the track.

        Args:
            track: with its stamps.
            times: (m,) s, in any order.
            values: (m, dim), or (m,) where dim is 1, in the units of the columns.
            sigma: as for the class.
        Raises: ValueError: a reading farther than `FARTHEST` from every sample, or as for the class.
        """
        check_instance("track", track, Track, "Make one with Track(times, positions).")
        when, given = check_array("times", times), check_array("values", values)
        spread = check_array("sigma", sigma)
        if when.ndim != 1 or given.shape[:1] != when.shape or spread.shape[:1] not in ((), when.shape):
            raise ValueError(
                f"times, values and sigma must have one row a reading; got {when.shape}, {given.shape} and "
                f"{spread.shape}. One reading has rows too: at(track, [0.1], [6.2], 0.1)."
            )
        if not np.isfinite(when).all():
            raise ValueError(f"times of '{cls.name}' must be finite; leave out readings without a time")
        order = np.argsort(when, kind="stable")
        when, given = when[order], given[order]
        times, since = track.seconds, elapsed(when, float(track.times[0]))
        after = np.clip(np.searchsorted(times, since), 1 if len(track) > 1 else 0, len(track) - 1)
        before = np.maximum(after - 1, 0)
        state = np.where(since - times[before] < times[after] - since, before, after)
        delay = since - times[state]
        if len(delay) and np.abs(delay).max() > FARTHEST:
            worst = int(np.abs(delay).argmax())
            raise ValueError(
                f"track {shown(track.name)}: readings '{cls.name}' must lie within {FARTHEST:g} s of a sample; the one "
                f"at t={when[worst]:g} s is {abs(delay[worst]):.3g} s away. Check its clock, or leave it out."
            )
        return cls(state, given, spread[order] if spread.ndim else spread, delay)

    @classmethod
    def from_table(cls, track: Track, rows: Array) -> Self:
        """The readings of a track from its rows of the table."""
        return cls.at(track, rows[:, 0], rows[:, 1:-1], rows[:, -1])

    def select(self, samples: NDArray[np.bool_]) -> Self:
        """The readings of some samples, without those beyond the ends of a part: a contact may lie between."""
        kept, found, last = samples[self.state], np.flatnonzero(samples), len(samples) - 1
        if len(found):
            kept &= ~((self.delay < 0.0) & (self.state == found[0]) & (self.state > 0))
            kept &= ~((self.delay > 0.0) & (self.state == found[-1]) & (self.state < last))
        number = np.cumsum(samples) - 1
        return type(self)(number[self.state[kept]], self.values[kept], self.sigma[kept], self.delay[kept])

    def onto(self, old: Track, new: Track) -> Self:
        """The same readings, with the nearest samples of another track."""
        return type(self).at(new, old.times[self.state] + self.delay, self.values, self.sigma)

    def batch(self, context: Context) -> FactorBatch:
        """One factor a reading."""
        return ReadingFactors(self, context.model)

    def beside_contacts(
        self, batch: FactorBatch, track: Track, spans: Mapping[int, tuple[float, float]]
    ) -> FactorBatch:
        """The batch; readings of an unknown side, or too far from a sample on their own side, get an infinite sigma."""
        stamps, times = track.times[self.state] + self.delay, track.times
        interval, at_sample = np.searchsorted(times, stamps, side="right") - 1, self.delay == 0.0
        state, known = self.state.copy(), np.ones(len(self), dtype=bool)
        for between, (begin, end) in spans.items():
            rows = np.flatnonzero((interval == between) & ~at_sample)
            state[rows] = np.where(stamps[rows] > end, between + 1, between)
            known &= at_sample | (stamps < begin) | (stamps > end)
        if ((state == self.state).all() and known.all()) or not isinstance(batch, ReadingFactors):
            return batch
        other, delay = copy.copy(batch), stamps - times[state]
        known &= (state == self.state) | (np.abs(delay) <= FARTHEST)
        other.variables, other.delay = state[:, None], delay
        other.sigma = np.where(known[:, None], self.sigma, np.inf)
        return other

    def left_out(self, batch: FactorBatch) -> int:
        """Number of readings with an infinite sigma."""
        return int(np.isinf(batch.sigma).any(axis=1).sum()) if isinstance(batch, ReadingFactors) else 0

    def filter_rows(self, sample: int, since: float = -np.inf, until: float = np.inf) -> Index:
        """(k,) index of the readings of a sample, of a span of time about it."""
        rows = super().filter_rows(sample)
        return rows[(self.delay[rows] >= since) & (self.delay[rows] <= until)]

    def table(self, track: Track) -> Mapping[str, Array]:
        """Columns of the file, in order, without the trajectory: t (m,) s, the values (m,) and sigma (m,).

        Raises: ValueError: if the values of one reading have different sigmas, which a table cannot hold.
        """
        if (self.sigma != self.sigma[:, :1]).any():
            raise ValueError(f"sigma of '{self.name}' must be one number a reading in a table; got several.")
        values = dict(zip(self.columns, self.values.T, strict=True))
        return {"t": track.times[self.state] + self.delay, **values, "sigma": self.sigma[:, 0]}


class RadarSpeed(Reading):
    """The speed of the ball, m/s, from a radar beside the flight or a speed gun at a known angle."""

    name: ClassVar[str] = "speed"
    file: ClassVar[str | None] = "speeds.csv"
    columns: ClassVar[tuple[str, ...]] = ("speed",)
    largest: ClassVar[float] = FASTEST_BALL

    def predicted(self, state: Tensor) -> Tensor:
        """(..., 1) m/s, length of the velocity."""
        return state[..., VELOCITY].square().sum(-1, keepdim=True).clamp_min(LEAST_SPEED**2).sqrt()

    def turned(self, rotation: Tensor, shift: Tensor) -> Self:
        """A speed is the same in every frame."""
        return self


class SpinReading(Reading):
    """The spin of the ball, rad/s, from a camera that reads its marks in mid-flight."""

    name: ClassVar[str] = "spin"
    file: ClassVar[str | None] = "spins.csv"
    columns: ClassVar[tuple[str, ...]] = ("wx", "wy", "wz")
    loss: ClassVar[Loss] = Loss("cauchy", 3.0)
    largest: ClassVar[float] = FASTEST_SPIN

    def predicted(self, state: Tensor) -> Tensor:
        """(..., 3) rad/s."""
        return state[..., SPIN]

    def turned(self, rotation: Tensor, shift: Tensor) -> Self:
        """The spins turn along.

        Raises: ValueError: if sigma differs between x and y.
        """
        if (self.sigma[:, 0] != self.sigma[:, 1]).any():
            raise ValueError("sigma of 'spin' must be the same along x and y for a turned track. Give one number each.")
        return type(self)(self.state, self.values @ rotation.numpy().T, self.sigma, self.delay)


class ReadingFactors(FactorBatch):
    """r = (h(x_i carried over the delay, in free flight) - z_i) / sigma_i, the shorter way round where z wraps."""

    row_arrays: ClassVar[tuple[str, ...]] = ("variables", "values", "sigma", "delay")

    def __init__(self, reading: Reading, model: BallModel) -> None:
        super().__init__(reading.state[:, None], len(reading.columns), reading.loss)
        self.predicted = reading.predicted
        self.sort = type(reading)
        self.model = model
        self.values, self.sigma, self.delay = reading.values, reading.sigma, reading.delay

    @property
    def group(self) -> Hashable:
        """Further entries of the group: the kind of the reading and the model."""
        return (*super().group, self.sort, id(self.model))  # type: ignore[misc]

    def compute(self, rows: Index | slice, inputs: tuple[Array, ...]) -> tuple[Array, tuple[Array, ...]]:
        """Whitened residuals (k, dim) and Jacobians (k, dim, 9)."""
        from ballfg.dynamics.motion.integrate import batch_jacobian

        function = partial(self._whitened, rows)
        residual, jacobian = batch_jacobian(function, torch.from_numpy(inputs[0]), outputs=self.dim)
        return residual.numpy(), (jacobian.numpy(),)

    def residual(self, inputs: tuple[Tensor, ...]) -> Tensor:
        """(m, dim) whitened residuals in torch."""
        return self._whitened(slice(None), inputs[0])

    def _whitened(self, rows: Index | slice, state: Tensor) -> Tensor:
        values, sigma, delay = (torch.from_numpy(a[rows]) for a in (self.values, self.sigma, self.delay))
        if bool(delay.any()):
            from ballfg.dynamics.motion.flight_step import rk4_step

            state = rk4_step(self.model.rates, state, delay.unsqueeze(-1))
        found, shape = self.predicted(state), (*state.shape[:-1], self.dim)
        if found.shape != shape:  # torch would repeat a single column for all, without a word
            raise ValueError(
                f"{self.sort.__name__}.predicted must return (..., {self.dim}), one number a column; got "
                f"{tuple(found.shape)} of states {tuple(state.shape)}. Keep the last axis: sum(-1, keepdim=True)."
            )
        period = torch.tensor([self.sort.periods.get(column, 0.0) for column in self.sort.columns], dtype=found.dtype)
        turns = ((found - values) / torch.where(period > 0.0, period, 1.0)).round()
        return (found - values - period * turns) / sigma
