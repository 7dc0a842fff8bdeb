"""Linearises tracks about their estimates, so that another noise needs no new estimate.

Near an estimate the motion is linear: a deviation d_k of state and coefficients moves on as F_k d_k + o_k, where o_k is
the offset of the estimate itself from the model. F and o come from the dynamics factors of the solved graph,
contacts with their saltation included. A Kalman filter over deviations then gives forecasts for any noise.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from ballfg.arrays import Array
from ballfg.estimation.batch import map_tracks
from ballfg.estimation.segmentation.result import Quality
from ballfg.estimation.settings import sample_sigmas
from ballfg.estimation.smoother.problem import START_POSITION_SIGMA, TrackProblem, coefficient_means
from ballfg.estimation.smoother.settle import Solution
from ballfg.estimation.smoother.smoother import Smoother
from ballfg.factors.dynamics import DynamicsFactors
from ballfg.factors.noise import PROCESS_NOISE, Kicks
from ballfg.progress import Watch, unwatched
from ballfg.state import POSITION, SPIN, STATE_DIM, VELOCITY
from ballfg.tracks import Track

LEAST_SAMPLES = 6
"""Least number of samples: the fit of a shorter track absorbs all of its noise."""


@dataclass(frozen=True)
class LinearTracks:
    """Linearised tracks side by side; shorter ones are padded with unused samples.

    With t tracks of up to n samples, and d = 9 + p numbers for state and coefficients:

    Attributes:
        numbers: (t,) indices of the used tracks.
        times: (t, n) s since the first used sample.
        errors: (t, n, 3) m, measured minus estimated positions.
        white: (t, n, 3) m, standard deviations of the samples' white errors.
        velocities: (t, n, 3) m/s.
        used: (t, n) bool, good samples.
        transitions: (t, n - 1, d, d) F, in the units of state and coefficients.
        offsets: (t, n - 1, d) o, in the units of state and coefficients.
        kicks: (t, n - 1, 7, 9, 9) covariance for a unit of each number of `PROCESS_NOISE`.
        starts: (t, d) mean of the prior at the first sample, as a deviation from the estimate.
        labelled: (t,) bool, True if a label gives the spin at the first sample.
        group_sigmas: (t, 3) rad/s, prior standard deviations of the first spin along the axes of its population; NaN
            where none gives it. The first state's spin counts along these axes.
        label_spreads: (t,) standard deviation of a spin that a label gives, for 1 rad/s of the label's own.
        coefficient_sigmas: (p,) prior standard deviations, in the coefficients' own units.
    """

    numbers: Array
    times: Array
    errors: Array
    white: Array
    velocities: Array
    used: NDArray[np.bool_]
    transitions: Array
    offsets: Array
    kicks: Array
    starts: Array
    labelled: NDArray[np.bool_]
    group_sigmas: Array
    label_spreads: Array
    coefficient_sigmas: Array

    def __len__(self) -> int:
        return len(self.times)

    def prior_variances(self, spin: Array, label: Array, coefficients: Array, velocity: float) -> Array:
        """(t, d) of the first state and the coefficients.

        Args:
            spin: (r,) rad/s, standard deviation per axis of spins without a label; one row for all tracks or for each.
            label: (r,) rad/s, of a label.
            coefficients: (r, p) multiples of `coefficient_sigmas`.
            velocity: m/s, standard deviation per axis.
        """
        spins = np.where(np.isnan(self.group_sigmas), self._own_spins(spin, label)[:, None], self.group_sigmas)
        fixed = np.tile([START_POSITION_SIGMA**2] * 3 + [velocity**2] * 3, (len(self), 1))
        own = np.tile((coefficients * self.coefficient_sigmas) ** 2, (len(self) // len(coefficients), 1))
        return np.concatenate((fixed, spins**2, own), axis=1)

    def prior_slopes(self, spin: Array, label: Array, coefficients: Array, by: Array) -> tuple[Array, Array, Array]:
        """Derivatives (t,) by spin and label and (t, p) by coefficients, from those by `prior_variances`, (t, d)."""
        own = np.where(np.isnan(self.group_sigmas), 2.0 * by[:, SPIN], 0.0).sum(axis=1) * self._own_spins(spin, label)
        multiples = 2.0 * coefficients * self.coefficient_sigmas**2 * by[:, STATE_DIM:]
        if coefficients.shape[1] == 1:  # one for all
            multiples = multiples.sum(axis=1, keepdims=True)
        return np.where(self.labelled, 0.0, own), np.where(self.labelled, self.label_spreads * own, 0.0), multiples

    def _own_spins(self, spin: Array, label: Array) -> Array:
        """(t,) rad/s, standard deviation of each first spin by its label, or without one."""
        return np.asarray(np.where(self.labelled, self.label_spreads * label, spin))


_Piece = dict[str, Array]
"""One linearised track: the fields of `LinearTracks` without the first dimension, by name."""
LINEAR: Final = ("errors", "transitions", "offsets", "kicks", "starts")
"""Fields that are finite where the motion about an estimate is linear; about a contact that never comes it is not."""


def linearise(
    smoother: Smoother, tracks: Sequence[Track], watch: Watch = unwatched, *, jobs: int = 1
) -> LinearTracks | None:
    """The tracks linearised about a smoother's estimates, each in its longest time between hits; None if all are short.

    Args:
        smoother: model, surfaces and the noise to linearise with.
        tracks: measured.
        watch: called for each track.
        jobs: processes.
    """
    pieces, numbers = [], []
    made = map_tracks(partial(_piece, smoother), tracks, len(tracks), jobs)
    for number, piece in enumerate(watch(made, len(tracks), "linearising tracks")):
        if len(piece["times"]) >= LEAST_SAMPLES and all(np.isfinite(piece[name]).all() for name in LINEAR):
            pieces.append(piece)
            numbers.append(number)
    if not pieces:
        return None
    sigmas = np.array(list(smoother.settings.coefficients.values()))
    return _side_by_side(pieces, np.array(numbers), sigmas)


def _piece(smoother: Smoother, track: Track) -> _Piece:
    model = smoother.model.for_track(smoother.settings.grouped(track))
    own = smoother if model is smoother.model else Smoother(model, smoother.surfaces, smoother.settings)
    return _linearised(*own.solved(track))


def _linearised(problem: TrackProblem, solution: Solution) -> _Piece:
    track, values, width = problem.track, solution.minimum.values, problem.width
    intervals = len(track) - 1
    transitions = np.tile(np.eye(STATE_DIM + width), (intervals, 1, 1))
    offsets = np.zeros((intervals, STATE_DIM + width))
    kicks = np.zeros((intervals, len(PROCESS_NOISE), STATE_DIM, STATE_DIM))
    linked = np.zeros(intervals, dtype=bool)
    for batch in solution.graph.batches:
        if isinstance(batch, DynamicsFactors):
            rows, where = batch.linearize(values), batch.variables[:, 0]
            spread = -np.linalg.inv(batch.whitening)
            transitions[where, :STATE_DIM, :STATE_DIM] = (spread @ rows.jacobians[0])[..., :STATE_DIM]
            if width:
                transitions[where, :STATE_DIM, STATE_DIM:] = (spread @ rows.jacobians[2])[..., :width]
            offsets[where, :STATE_DIM] = (spread @ rows.residual[..., None])[..., 0]
            kicks[where] = Kicks(batch.kick_times, batch.hit).basis(batch.dt)
            linked[where] = True
    breaks = np.union1d(np.flatnonzero(~linked), solution.events.segmentation.hits).astype(np.int64)
    first, end = _longest_stretch(track.times, breaks)
    label = problem.settings.spin_label(track) if first == 0 else None
    start = np.zeros(STATE_DIM + width)
    start[POSITION] = track.positions[first] - values.states[first, POSITION]
    start[VELOCITY] = -values.states[first, VELOCITY]
    start[SPIN] = (np.zeros(3) if label is None else label.spin) - values.states[first, SPIN]
    group_sigmas = np.full(3, np.nan)
    if label is not None and not label.measured:  # the first spin along the axes of its prior
        group_sigmas, start[SPIN] = label.sigmas, label.axes @ start[SPIN]
        transitions[first, :, SPIN] = transitions[first, :, SPIN] @ label.axes.T
    start[STATE_DIM:] = coefficient_means(problem.model, problem.settings) - values.coefficients[:width]
    samples, intervals_within = slice(first, end), slice(first, end - 1)
    return {
        "times": track.times[samples] - track.times[first],
        "errors": (track.positions - values.states[:, POSITION])[samples],
        "white": sample_sigmas(problem.settings, len(track), track.sigmas)[samples],
        "velocities": values.states[samples, VELOCITY],
        "used": solution.events.segmentation.quality[samples] == Quality.GOOD,
        "transitions": transitions[intervals_within],
        "offsets": offsets[intervals_within],
        "kicks": kicks[intervals_within],
        "starts": start,
        "labelled": np.array(label is not None and label.measured),
        "group_sigmas": group_sigmas,
        "label_spreads": np.array(1.0),
    }


def _longest_stretch(times: Array, breaks: NDArray[np.int64]) -> tuple[int, int]:
    """First sample, and the one after the last, of the longest time without a break between two samples.

    Args: times: (n,) s.  breaks: intervals, between samples i and i + 1, with unknown motion.
    """
    firsts = np.concatenate(([0], breaks + 1))
    ends = np.concatenate((breaks + 1, [len(times)]))
    longest = int(np.argmax(times[ends - 1] - times[firsts]))
    return int(firsts[longest]), int(ends[longest])


PADDED: Final = {
    **dict.fromkeys(("times", "white", "velocities", "transitions"), "edge"),
    **dict.fromkeys(("errors", "used", "offsets", "kicks"), "zero"),
}
"""Fields with a row for each sample or interval, and what fills those of shorter tracks."""


def _side_by_side(pieces: Sequence[_Piece], numbers: Array, coefficient_sigmas: Array) -> LinearTracks:
    longest = max(len(piece["times"]) for piece in pieces)

    def padded(piece: _Piece, name: str) -> Array:
        array = piece[name]
        if name not in PADDED:
            return array
        filling = array[-1:] if PADDED[name] == "edge" else np.zeros_like(array[:1])
        return np.concatenate((array, np.repeat(filling, longest - len(piece["times"]), axis=0)))

    fields: dict[str, Any] = {name: np.stack([padded(piece, name) for piece in pieces]) for name in pieces[0]}
    return LinearTracks(numbers=numbers, coefficient_sigmas=coefficient_sigmas, **fields)
