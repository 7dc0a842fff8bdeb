"""An augmented model carries uncertain coefficients along with the state, so that one Jacobian serves both.

Augmented states are (..., 9 + p): the state, then p coefficients that are constant in time. Flight, contacts, rollouts
and their Jacobians work on them as on any `BallModel`.
"""

from collections.abc import Sequence

import torch
from torch import Tensor

from ballfg.dynamics.measurement import Later
from ballfg.dynamics.model import BallModel, Rates, substitute
from ballfg.state import STATE_DIM


class AugmentedModel(BallModel):
    """A model with some of its scalar parameters read from columns 9, 10, ... of the state.

    Args: model: any ball model.  names: parameter names as in `model.named_parameters()`, for instance `flight.drag.k`.

    Attributes: names: of the parameters.

    Raises: ValueError: if a name is not a scalar parameter of the model.
    """

    def __init__(self, model: BallModel, names: Sequence[str]) -> None:
        super().__init__(model.radius, model.inertia_factor)
        for name in names:  # `named_parameters` would walk through all of a correction's numbers for each track
            if not _is_scalar(model, name):
                scalars = ", ".join(n for n, p in model.named_parameters() if p.dim() == 0)
                raise ValueError(f"'{name}' is not a scalar parameter of the model; there are: {scalars}")
        self.model = model
        self.names = tuple(names)
        self._level = model.surface_slope(torch.zeros(STATE_DIM, dtype=torch.float64)) is None

    @property
    def width(self) -> int:
        """Number of columns after the state."""
        return len(self.names)

    def means(self) -> Tensor:
        """(p,) the present values of the model's own parameters."""
        return torch.stack([self.model.get_parameter(name).reshape(()) for name in self.names])

    def bound(self, state: Tensor) -> BallModel:
        """The model with each state's own coefficients."""
        columns = [state[..., STATE_DIM + k : STATE_DIM + k + 1] for k in range(len(self.names))]
        return substitute(self.model, dict(zip(self.names, columns, strict=True)))

    def rates(self, state: Tensor) -> Rates:
        """Acceleration and angular acceleration in free flight."""
        return self.bound(state).rates(state[..., :STATE_DIM])

    def after_bounce(self, state: Tensor) -> Tensor:
        """State and coefficients just after an impact."""
        after = self.bound(state).after_bounce(state[..., :STATE_DIM])
        return torch.cat((after, state[..., STATE_DIM:]), dim=-1)

    def surface_offset(self, state: Tensor) -> Tensor | float:
        """(...) m by which surfaces lie above the heights declared for them."""
        return self.bound(state).surface_offset(state[..., :STATE_DIM])

    def surface_slope(self, state: Tensor) -> Tensor | None:
        """(2,) or (..., 2) slope of the surfaces; None: they are horizontal."""
        return None if self._level else self.bound(state).surface_slope(state[..., :STATE_DIM])

    def inside(self, state: Tensor) -> Tensor | None:
        """(...) weight of the model, which does not depend on the coefficients."""
        return self.model.inside(state[..., :STATE_DIM])

    @property
    def measuring(self) -> BallModel:
        """The model: coefficients that act on stamps and labels do not travel with the state."""
        return self.model

    def measured(self, states: Tensor, later: Later) -> Tensor:
        """(..., 3) m, the positions as they are measured; `later` gives states without coefficients."""
        return self.bound(states).measured(states[..., :STATE_DIM], later)

    def roll(self, state: Tensor) -> Rates:
        """Rates of a ball that rests on a surface."""
        return self.bound(state).roll(state[..., :STATE_DIM])

    def append(self, state: Tensor, coefficients: Tensor) -> Tensor:
        """Augmented states (n, 9 + p) from states (n, 9) and coefficients (p,) or (n, p)."""
        return torch.cat((state, coefficients.expand(*state.shape[:-1], self.width)), dim=-1)


def _is_scalar(model: BallModel, name: str) -> bool:
    try:
        return model.get_parameter(name).dim() == 0
    except AttributeError:
        return False
