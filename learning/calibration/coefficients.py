"""Looks up the calibrated coefficients in the model, checks them against the data, and puts them back."""

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
import torch

from ballfg.arrays import Array, Index
from ballfg.checks import did_you_mean
from ballfg.dynamics import AnalyticModel

NEED_SPIN_LABELS = ("flight.magnus.k", "flight.spin_decay.rate")
"""Coefficients that act through the spin alone: without measured spin only their product with it is observable."""

USUAL: Final = ("flight.drag.k", "bounce.restitution.e", "bounce.table_height.offset")
"""Coefficients that are calibrated if none are chosen, as far as the model has them."""
ONE_VIEW: Final = ("flight.drag.k",)
"""The same where one camera saw the ball: others take on errors of laws, which there pass for a depth."""


@dataclass(frozen=True)
class Chosen:
    """The p coefficients that are calibrated, by their names as in `model.named_parameters()`.

    Units are SI, `1` for none. Values in the first model, standard deviations of the priors and bounds have shape (p,).
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    start: Array
    sigma: Array
    low: Array
    high: Array
    shared: tuple[str, ...] = ()
    """Those that all tracks share, without spread between them: the weights of a correction."""
    steady: tuple[str, ...] = ()
    """Others without a spread, which reports list: the slope of the restitution beside a correction."""

    @property
    def alike(self) -> Index:
        """Numbers of the shared ones."""
        return np.array([self.names.index(name) for name in self.shared], dtype=np.int64)

    @property
    def without_spread(self) -> Index:
        """Numbers of the shared and of the steady ones."""
        return np.array([k for k, name in enumerate(self.names) if name in self.shared + self.steady], dtype=np.int64)

    @property
    def listed(self) -> list[tuple[int, str]]:
        """Number and name of those that are not shared, which reports list."""
        return [(k, name) for k, name in enumerate(self.names) if name not in self.shared]

    @property
    def needs_spin(self) -> bool:
        """True if only tracks with a spin label are informative."""
        return any(name in NEED_SPIN_LABELS for name in self.names)


def choose(model: AnalyticModel, names: Sequence[str] | None, usual: Sequence[str] = USUAL) -> Chosen:
    """The coefficients of some names; None: the usual ones that the model has.

    Raises: ValueError: a model without any of the usual ones, a name that the model does not have, that stands twice,
        or whose prior sigma is 0.
    """
    known = model.declared_coefficients()
    if names is None:
        names = [name for name in usual if name in known and known[name].sigma > 0.0]
        if not names:
            raise ValueError(
                f"coefficients must be chosen for a model without {', '.join(usual)}; got none. List some."
            )
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
