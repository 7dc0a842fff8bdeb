"""The coefficients that are calibrated: looked up in the model, checked against the data, put back into a model."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray

from ballfg.checks import did_you_mean
from ballfg.dynamics import AnalyticModel, load_model, nominal_model

Array = NDArray[np.float64]

NEED_SPIN_LABELS = ("flight.magnus.k", "flight.spin_decay.rate")
"""Act through the spin alone: without measured spin, only its product with the coefficient shows."""


def analytic_model(path: str | None, radius: float) -> AnalyticModel:
    """The analytic model of a file, or the nominal one for None; radius in m.

    Raises: ValueError: if the file's model has a learned part.
    """
    model = nominal_model(radius) if path is None else load_model(path, radius=radius)
    if not isinstance(model, AnalyticModel):
        raise ValueError(f"model must be analytic; {path} has a learned part. Give its base, or leave it out.")
    return model


@dataclass(frozen=True)
class Chosen:
    """The p coefficients that are calibrated.

    Attributes:
        names: as in `model.named_parameters()`.
        units: SI, `1` for none.
        start: (p,) values of the model that the calibration starts from.
        sigma: (p,) standard deviations of their priors.
        low: (p,) least values accepted.  high: (p,) largest.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start: Array
    sigma: Array
    low: Array
    high: Array

    @property
    def needs_spin(self) -> bool:
        """Whether only tracks with a spin label can tell."""
        return any(name in NEED_SPIN_LABELS for name in self.names)


def choose(model: AnalyticModel, names: Sequence[str]) -> Chosen:
    """The coefficients of some names.

    Raises: ValueError: a name that the model does not have, that stands twice, or whose value is as good as known.
    """
    known = model.declared_coefficients()
    for name in names:
        if name not in known:
            hint = did_you_mean(name, known) or f" It has: {', '.join(known) or 'none'}."
            raise ValueError(f"coefficients must be declared by the model; '{name}' is not.{hint}")
        if list(names).count(name) > 1:
            raise ValueError(f"coefficients must differ; '{name}' stands twice. Delete one.")
        if not known[name].sigma > 0.0:
            raise ValueError(
                f"coefficients must be uncertain; '{name}' is taken as known (prior sigma 0). Leave it out."
            )
    specs = [known[name] for name in names]
    return Chosen(
        names=tuple(names),
        units=tuple(c.unit for c in specs),
        start=values_of(model, names),
        sigma=np.array([c.sigma for c in specs]),
        low=np.array([c.low for c in specs]),
        high=np.array([c.high for c in specs]),
    )


def values_of(model: AnalyticModel, names: Sequence[str]) -> Array:
    """(p,) the model's values of some coefficients."""
    parameters = dict(model.named_parameters())
    return np.array([float(parameters[name].detach()) for name in names])


def with_values(model: AnalyticModel, names: Sequence[str], values: Array) -> AnalyticModel:
    """A copy of the model with other values (p,) of some coefficients."""
    changed = copy.deepcopy(model)
    parameters = dict(changed.named_parameters())
    with torch.no_grad():
        for name, value in zip(names, values.tolist(), strict=True):
            parameters[name].fill_(value)
    return changed
