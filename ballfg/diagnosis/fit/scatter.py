"""Coefficients that differ from track to track: what the samples of a stretch say of its own ones."""

from collections.abc import Sequence

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.problem import Fit
from ballfg.diagnosis.fit.sensitivity import sensitivity
from ballfg.state import STATE_DIM


def by_own(fit: Fit, names: Sequence[str]) -> Array:
    """(n, m, c) rows as in the fit's system: derivatives by coefficients of the stretches, also of a wind of their own.

    Args: names: c parameters, free ones of the fit or those of a wind.
    """
    problem, system, free = fit.problem, fit.linearised, list(fit.problem.free)
    further = [name for name in names if name not in free]
    columns = np.zeros((*system.by_common.shape[:2], len(names)))
    if further:
        parameters = dict(problem.in_own_air.named_parameters())
        known = {name: float(parameters[name]) for name in further} | fit.values
        found = sensitivity(problem.in_own_air, problem.stretches, fit.unknowns.starts, known, further)
        columns[:, :-3, [name in further for name in names]] = fit.position_rows(found.positions[..., STATE_DIM:])
    for place, name in enumerate(names):
        if name in free:
            columns[..., place] = system.by_common[..., free.index(name)]
    return columns
