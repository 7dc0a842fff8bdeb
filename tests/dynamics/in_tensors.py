"""Motions of arrays, as estimators call them, for tests whose numbers are tensors."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from ballfg.dynamics import BallModel
from ballfg.dynamics.motion import arrays


def in_tensors(function: Callable[..., Any], model: BallModel, state: Tensor, *given: Any) -> tuple[Tensor, ...]:
    """What a function of `arrays` gives for a model's states (n, 9 + p) and what else it takes."""
    plain = [one.numpy() if isinstance(one, Tensor) else one for one in (state.detach(), *given)]
    return tuple(torch.from_numpy(found) for found in function(model, *plain))


def fly_through(model: BallModel, state: Tensor, dt: Tensor, heights: Sequence[float]) -> tuple[Tensor, ...]:
    """`arrays.fly_through`."""
    return in_tensors(arrays.fly_through, model, state, dt, heights)


def fly_through_jacobian(model: BallModel, state: Tensor, dt: Tensor, heights: Sequence[float]) -> tuple[Tensor, ...]:
    """`arrays.fly_through_jacobian`."""
    return in_tensors(arrays.fly_through_jacobian, model, state, dt, heights)
