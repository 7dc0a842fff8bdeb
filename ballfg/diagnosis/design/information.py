"""Predicts the flights of a launcher, and computes the information on coefficients in them and in a dataset."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.design.goal import Goal
from ballfg.diagnosis.fit.effects import with_coefficients
from ballfg.diagnosis.fit.free import Unknowns
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.stretches import LEAST_SAMPLES, MOST_CONTACTS, Stretches
from ballfg.diagnosis.search.refits import with_hypothesis
from ballfg.dynamics import BallModel, Surfaces, rollout
from ballfg.estimation.measurement.as_measured import measured_positions, true_times
from ballfg.state import SPIN, VZ

MARGIN = 0.25
"""Share of the measured extent, along x and y, by which a flight may leave it on each side. A few tracks do not show
the whole view of the cameras."""
LEAST_KICK = 0.3
"""m/s. Least change of the vertical speed in a contact; a ball that rises slower than half of it comes to rest soon."""


@dataclass(frozen=True)
class View:
    """The view of the cameras on a flight."""

    low: Array  # (3,) m, corner of the box in which the ball is visible
    high: Array  # (3,) m, the other one; the box is open above: lobs are visible too
    duration: float  # s, of the longest flight
    interval: float  # s, between usable samples on average: a flight will lose as many
    sigmas: Array  # (3,) m, stated noise of a coordinate
    labelled: bool  # True if the spin at the first sample is measured

    @classmethod
    def of(cls, stretches: Stretches) -> "View":
        """The view of measured stretches."""
        used = stretches.used.numpy()
        positions, sigmas = stretches.positions.numpy()[used], stretches.sigmas.numpy()[used]
        low, high = positions.min(axis=0), positions.max(axis=0)
        margin = MARGIN * (high - low) * (1.0, 1.0, 0.0)
        margin[2], high[2] = 0.01 * (high[2] - low[2]), np.inf
        steps = np.diff(stretches.times.numpy(), axis=1)[used[:, 1:]]
        first = np.unique(stretches.track, return_index=True)[1]
        return cls(
            low - margin,
            high + margin,
            float(stretches.ends.max()),
            float(np.mean(steps)),
            np.median(sigmas, axis=0),
            bool(stretches.labelled[first].mean() > 0.5),
        )


def planned_flights(
    model: BallModel, starts: Array, settings: Array, surfaces: Surfaces, view: View
) -> tuple[Stretches, Mask]:
    """Flights from first states (m, 9) as stretches, until they leave the view.

    Args: settings: (m, s) launcher settings, as in the stretches of the dataset.
    Returns: the flights that are long enough, and (m,) a mask of them.
    """
    stamps = np.arange(0.0, view.duration + 0.5 * view.interval, view.interval)
    times, n, k = true_times(model, stamps), len(starts), len(stamps)
    with torch.no_grad():
        paths = rollout(model, torch.from_numpy(starts), torch.from_numpy(times), surfaces)
        heights = surfaces.level_below(paths, model.surface_offset(paths))
        gaps, labels = model.gap(paths, heights).numpy(), model.labelled(paths[:, 0, SPIN]).numpy()
    measured = measured_positions(model, paths.flatten(0, 1).numpy(), surfaces).reshape(n, k, 3)
    lengths, contacts, levels = np.zeros(n, dtype=np.int64), *(np.full((n, MOST_CONTACTS), np.nan) for _ in range(2))
    for i, path in enumerate(paths.numpy()):
        lengths[i], met = _seen(path, measured[i], gaps[i], np.diff(times), view)
        delay = np.clip(gaps[i, met] / -path[met, VZ], 0.0, np.diff(times)[met])
        contacts[i, : len(met)] = times[met] + delay
        levels[i, : len(met)] = heights.numpy()[i, met]
    index = np.minimum(np.arange(k), lengths[:, None] - 1).clip(0)
    seen = (np.arange(k) < lengths[:, None])[..., None]
    rows = {
        "times": stamps[index],
        "positions": np.take_along_axis(measured, index[..., None], axis=1),
        "sigmas": np.where(seen, view.sigmas, np.inf),
        "starts": starts,
        "heights": levels,
        "contacts": contacts,
        "labels": labels if view.labelled else np.full((n, 3), np.nan),
    }
    tensors = {name: torch.from_numpy(np.ascontiguousarray(row, dtype=np.float64)) for name, row in rows.items()}
    kept = lengths >= LEAST_SAMPLES
    return Stretches(tuple(map(str, range(n))), np.arange(n), settings, **tensors).take(kept), kept


def _seen(path: Array, measured: Array, gaps: Array, steps: Array, view: View) -> tuple[int, Index]:
    """Number of visible samples of a path, and the samples (c,) before contacts.

    Args: path, measured: (k, 9) states and (k, 3) m.  gaps: (k,) m above the surface.  steps: (k - 1,) s between them.
    """
    inside = ((measured >= view.low) & (measured <= view.high)).all(axis=1)
    end = len(path) if inside.all() else int(np.argmin(inside))
    before, after = path[:-1, VZ], path[1:, VZ]
    near = gaps[:-1] < 1.5 * steps * np.abs(before)
    met = np.flatnonzero(((before < 0.0) & (after > 0.0) & (after - before > LEAST_KICK) & near)[: max(end - 1, 0)])
    slow = np.flatnonzero(after[met] < 0.5 * LEAST_KICK)
    last = min([MOST_CONTACTS, *slow.tolist()])
    return (int(met[last]) + 1, met[:last]) if len(met) > last else (end, met)


AT_ONCE = 500  # Number of flights whose derivatives are held at once; a flight takes up to half a megabyte
MISSED = 1e-3
"""m. Difference between a planned flight's samples with given and with found contacts that means other contacts."""


@dataclass(frozen=True)
class Information:
    """Information matrices about q common unknowns, first states eliminated, in units of the priors."""

    names: tuple[str, ...]  # Of the coefficients, which are the first unknowns; launcher settings follow
    units: Array  # (q,) prior standard deviations, the units of the matrices
    known: Array  # (q, q) of priors and dataset
    shots: Array  # (m, q, q) of each candidate
    kept: Index  # (m,) numbers of the candidates with usable flights

    def columns(self, names: Sequence[str]) -> list[int]:
        """Places of coefficients among the unknowns."""
        return [self.names.index(name) for name in names]


def information_of(fit: Fit, goal: Goal, starts: Array, settings: Array, surfaces: Surfaces) -> Information:
    """Information on the unknowns from the tracks of a fit and from flights with given first states.

    Args: fit: of the declared model to all tracks.  starts: (m, 9) first states.  settings: (m, s) of the launcher, as
        in the fit's stretches.
    Raises: ValueError: if no candidate's flight is long enough.
    """
    problem = fit.problem
    for hypothesis in goal.hypotheses:
        problem = with_hypothesis(problem, hypothesis)
    values = problem.declared | {n: v for n, v in fit.unknowns.values.items() if n in problem.free}
    unknowns = replace(fit.unknowns, values=values)
    units = 1.0 / np.sqrt(problem.common_precision)
    known = Fit.at(problem, unknowns, fit.noise).gram.sum(axis=0)[:-1, :-1]
    fitted = with_coefficients(problem.model, values)
    flights, kept = planned_flights(fitted, starts, settings, surfaces, View.of(problem.stretches))
    parts, usable = [np.zeros((0, len(units), len(units)))], [np.zeros(0, dtype=np.bool_)]
    for first in range(0, len(flights), AT_ONCE):
        own = flights.take(np.arange(first, min(first + AT_ONCE, len(flights))))
        planned = replace(problem, stretches=own)
        at = Fit.at(planned, Unknowns(own.starts.numpy(), values, fit.unknowns.launcher), fit.noise)
        off = np.abs(np.where(own.used.numpy()[..., None], at.predicted.positions - own.positions.numpy(), 0.0))
        usable.append(np.nan_to_num(off, nan=np.inf).max(axis=(1, 2)) < MISSED)
        if usable[-1].any():  # those with exactly the contacts of a rollout
            good = replace(problem, stretches=own.take(usable[-1]))
            at = Fit.at(good, replace(at.unknowns, starts=at.unknowns.starts[usable[-1]]), fit.noise)
            parts.append(at.linearised.eliminated().gram[:, :-1, :-1])
    chosen = np.concatenate(usable)
    if not chosen.any():
        raise ValueError(
            "candidates must fly for ten samples or more within the place where the tracks of the dataset were seen; "
            "none does. Choose settings near those that were shot."
        )
    scale = np.outer(units, units)
    return Information(
        tuple(problem.free),
        units,
        known * scale + np.eye(len(units)),
        np.concatenate(parts) * scale,
        np.flatnonzero(kept)[chosen],
    )
