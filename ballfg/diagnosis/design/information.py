"""Computes the information on coefficients in a dataset's tracks and in each flight of a launcher."""

import copy
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch

from ballfg.arrays import Array, Index, Mask
from ballfg.diagnosis.design.flights import View, planned_flights
from ballfg.diagnosis.design.goal import Goal
from ballfg.diagnosis.fit.problem import Fit, Problem, Unknowns
from ballfg.diagnosis.search.candidates import with_hypothesis
from ballfg.dynamics import AnalyticModel, Surfaces

AT_ONCE = 500
"""Number of flights whose derivatives are held at once; a flight takes up to half a megabyte."""
MISSED = 1e-3
"""m. Difference between a planned flight's samples with given and with found contacts that means other contacts."""


@dataclass(frozen=True)
class Information:
    """Information matrices about q common unknowns, first states eliminated, in units of the priors.

    Attributes:
        names: of the coefficients, which are the first unknowns; launcher settings follow.
        units: (q,) prior standard deviations, the units of the matrices.
        known: (q, q) of priors and dataset.
        shots: (m, q, q) of each candidate.
        kept: (m,) numbers of the candidates with usable flights.
    """

    names: tuple[str, ...]
    units: Array
    known: Array
    shots: Array
    kept: Index

    def columns(self, names: Sequence[str]) -> list[int]:
        """Places of coefficients among the unknowns."""
        return [self.names.index(name) for name in names]


def information_of(fit: Fit, goal: Goal, starts: Array, settings: Array, surfaces: Surfaces) -> Information:
    """Information on the unknowns from the tracks of a fit and from flights with given first states.

    Args:
        fit: of the declared model to all tracks.
        goal: with further unknowns.
        starts: (m, 9) first states.
        settings: (m, s) launcher settings, as in the fit's stretches.
        surfaces: table and floor.
    Raises: ValueError: if no candidate's flight is long enough.
    """
    problem = fit.problem
    for hypothesis in goal.hypotheses:
        problem = with_hypothesis(problem, hypothesis)
    values = problem.declared | {n: v for n, v in fit.unknowns.values.items() if n in problem.free}
    unknowns = replace(fit.unknowns, values=values)
    units = 1.0 / np.sqrt(problem.common_precision)
    known = Fit.at(problem, unknowns, fit.noise).gram.sum(axis=0)[:-1, :-1]
    flights, kept = planned_flights(
        _as_fitted(problem.model, values), starts, settings, surfaces, View.of(problem.stretches)
    )
    parts, usable = [], []
    for first in range(0, len(flights), AT_ONCE):
        own = flights.take(np.arange(first, min(first + AT_ONCE, len(flights))))
        planned = replace(problem, stretches=own)
        at = Fit.at(planned, Unknowns(own.starts.numpy(), values, fit.unknowns.launcher), fit.noise)
        good = _as_planned(at)
        usable.append(good)
        parts.append(_information(at, good))
    chosen = np.concatenate(usable) if usable else np.zeros(0, dtype=np.bool_)
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


def _as_fitted(model: AnalyticModel, values: Mapping[str, float]) -> AnalyticModel:
    moved = copy.deepcopy(model)
    parameters = dict(moved.named_parameters())
    with torch.no_grad():
        for name, value in values.items():
            if name in parameters:
                parameters[name].fill_(value)
    return moved


def _as_planned(at: Fit) -> Mask:
    """(m,) True for flights with exactly the contacts of a rollout."""
    used = at.problem.stretches.used.numpy()[..., None]
    off = np.abs(np.where(used, at.predicted.positions - at.problem.stretches.positions.numpy(), 0.0))
    return np.asarray(np.nan_to_num(off, nan=np.inf).max(axis=(1, 2)) < MISSED)


def _information(at: Fit, good: Mask) -> Array:
    """(m', q, q) of the good flights."""
    if not good.any():
        q = len(at.problem.common_precision)
        return np.zeros((0, q, q))
    problem: Problem = replace(at.problem, stretches=at.problem.stretches.take(good))
    kept = Fit.at(problem, replace(at.unknowns, starts=at.unknowns.starts[good]), at.noise)
    return kept.linearised().eliminated().gram[:, :-1, :-1]
