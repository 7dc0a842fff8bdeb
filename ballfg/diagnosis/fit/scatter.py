"""Coefficients that differ from track to track: what the samples of a stretch say of its own ones."""

from collections.abc import Sequence

import numpy as np

from ballfg.arrays import Array
from ballfg.diagnosis.fit.free import OWN_AIR
from ballfg.diagnosis.fit.problem import Fit
from ballfg.state import STATE_DIM


def by_own(fit: Fit, names: Sequence[str]) -> Array:
    """(n, m, c) rows as in the fit's system: derivatives by coefficients of the stretches, also of a wind of their own.

    Args: names: c parameters, free ones of the fit or those of a wind.
    """
    free = list(fit.problem.free)
    air = [name for name in OWN_AIR if name not in free]
    by_air = fit.in_own_air.positions[..., STATE_DIM + len(free) :] if set(names) & set(air) else None
    by_common = fit.linearised.by_common
    columns = np.zeros((*by_common.shape[:2], len(names)))
    for place, name in enumerate(names):
        if name in free:
            columns[..., place] = by_common[..., free.index(name)]
        elif by_air is not None:
            columns[:, :-3, place] = fit.position_rows(by_air[..., [air.index(name)]])[..., 0]
    return columns
