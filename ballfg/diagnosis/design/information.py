"""Computes the information on coefficients in a dataset's tracks and in each flight of a launcher."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from ballfg.arrays import Array, Index
from ballfg.diagnosis.design.flights import View, planned_flights
from ballfg.diagnosis.design.goal import Goal
from ballfg.diagnosis.fit.problem import Fit, Unknowns
from ballfg.diagnosis.search.candidates import with_hypothesis
from ballfg.dynamics import Surfaces

AT_ONCE = 500  # Number of flights whose derivatives are held at once; a flight takes up to half a megabyte
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
    Raises: ValueError: if no candidate's flight is long enough.
    """
    problem = fit.problem
    for hypothesis in goal.hypotheses:
        problem = with_hypothesis(problem, hypothesis)
    values = problem.declared | {n: v for n, v in fit.unknowns.values.items() if n in problem.free}
    unknowns = replace(fit.unknowns, values=values)
    units = 1.0 / np.sqrt(problem.common_precision)
    known = Fit.at(problem, unknowns, fit.noise).gram.sum(axis=0)[:-1, :-1]
    fitted = copy.deepcopy(problem.model)
    for name, parameter in fitted.named_parameters():
        if name in values:
            parameter.data.fill_(values[name])
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
