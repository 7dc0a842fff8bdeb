"""Converts between true and recorded stamps, positions and spin labels by a model's measurement effects."""

from __future__ import annotations

import copy
from dataclasses import dataclass
from typing import TYPE_CHECKING, Self

import numpy as np

from ballfg.arrays import Array
from ballfg.deferred import torch
from ballfg.dynamics.surfaces import Surfaces
from ballfg.state import POSITION, STATE_DIM

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.model import BallModel

_MEASUREMENT = "measurement"  # Attribute of an `AnalyticModel` that holds its measurement effects
ROUNDING = 1e-9  # Share by which singular values that are equal may differ
LARGEST_CONDITION = 1e6
"""Largest condition of the map from spins to labels: beyond it a label leaves a component of the spin undetermined."""


def plainly_measured(model: BallModel) -> BallModel:
    """The model without measurement effects; all parameters are shared.

    Raises: TypeError: if the model measures by other means than the effects of an analytic model or of its base.
    """
    plain = _without_effects(model)
    if not plain.measures_plainly:
        raise TypeError(
            f"model must get its measurement from measurement effects; {type(model).__name__} has one of its own. "
            "Write it as a MeasurementEffect of an AnalyticModel."
        )
    return plain


def _without_effects(model: BallModel) -> BallModel:
    if model.measures_plainly:
        return model
    from ballfg.dynamics.model import BallModel

    plain = copy.copy(model)
    plain._modules = {
        name: _without_effects(child) if isinstance(child, BallModel) else child
        for name, child in model._modules.items()
    }
    if isinstance(plain._modules.get(_MEASUREMENT), torch.nn.ModuleDict):
        plain._modules[_MEASUREMENT] = torch.nn.ModuleDict()
    left = dict(plain.named_parameters())
    plain.variations = {name: variation for name, variation in model.variations.items() if name in left}
    return plain


def true_times(model: BallModel, times: Array) -> Array:
    """(n,) s, true times of samples, from all stamps (n,) s of a track; without effects they stay to the bit."""
    if model.measures_plainly:
        return times
    with torch.no_grad():
        return np.asarray(times[0] + model.true_stamps(torch.from_numpy(times - times[0])).numpy())


def written_time(model: BallModel, first: float, time: float) -> float:
    """The recorded stamp of a true time in a track whose first stamp is `first`; both s."""
    with torch.no_grad():
        return first + float(model.stamps(torch.tensor(time - first, dtype=torch.float64)))


def measured_positions(model: BallModel, states: Array, surfaces: Surfaces) -> Array:
    """(n, 3) m, expected measured positions of balls in true states (n, 9 + p), before noise."""
    if model.measures_plainly:
        return states[:, POSITION]

    from ballfg.dynamics.motion.rollout import advance

    def later(delay: Tensor) -> Tensor:
        return advance(model, true, delay.expand(len(true)), surfaces)[:, :STATE_DIM]

    with torch.no_grad():
        true = torch.from_numpy(states)
        return np.asarray(model.measured(true, later).numpy())


@dataclass(frozen=True)
class LabelMap:
    """The affine map from spins to labels: label = matrix (3, 3) spin + offset (3,) rad/s."""

    matrix: Array
    offset: Array

    @classmethod
    def of(cls, model: BallModel) -> Self:
        """The map of a model. Raises: ValueError: if it gives different spins the same label."""
        with torch.no_grad():
            offset = model.labelled(torch.zeros(3, dtype=torch.float64)).numpy()
            columns = model.labelled(torch.eye(3, dtype=torch.float64)).numpy() - offset
        if not np.linalg.cond(columns) < LARGEST_CONDITION:
            raise ValueError(
                "model must give different spins different labels; its effects on spin labels make "
                f"{columns.T.round(3).tolist()} of the unit matrix. Change their coefficients or leave them out."
            )
        return cls(columns.T, offset)

    def spin(self, label: Array, noise: float, prior: float) -> Array:
        """(3,) rad/s, the spin of a label (3,) rad/s, as far as the label tells it.

        A label that hardly shows one direction of the spin would stand for thousands of rad/s along it.

        Args: noise: rad/s, of the label.  prior: rad/s, of any spin, about zero.
        """
        left, sizes, right = np.linalg.svd(self.matrix)
        told = noise / sizes <= self._most(noise, prior)
        return np.asarray(right.T @ np.where(told, left.T @ (label - self.offset) / sizes, 0.0))

    def spread(self, noise: float, prior: float) -> float:
        """Standard deviation of that spin, rad/s, root mean square over all directions.  Args: as of `spin`."""
        sigmas = noise / np.linalg.svd(self.matrix, compute_uv=False)
        return float(np.sqrt((np.minimum(sigmas, self._most(noise, prior)) ** 2).mean()))

    def _most(self, noise: float, prior: float) -> float:
        """Largest standard deviation of a direction that a label tells: the prior's, or its best direction's."""
        return max(prior, noise / float(np.linalg.norm(self.matrix, 2)) * (1.0 + ROUNDING))
