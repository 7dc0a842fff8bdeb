"""Measures how much of a track lies outside of the training data of a learned model."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from ballfg.arrays import Array
from ballfg.deferred import torch
from ballfg.dynamics.compiled.kept_model import KeptModel

if TYPE_CHECKING:
    from torch import Tensor

    from ballfg.dynamics.model import BallModel


def out_of_distribution(model: BallModel, states: Array | Tensor) -> Array | None:
    """The distance of states from the training data of a model, as a weight.

    Args:
        model: the ball.
        states: (n, 9) position m, velocity m/s, spin rad/s; or with the coefficients of the model behind them.
    Returns: (n,) from 0 among the training tracks to 1 far from them; None for a model without such data.
    """
    if type(model) is KeptModel:
        return None
    with torch.no_grad():
        inside = model.inside(torch.as_tensor(states, dtype=torch.float64))
    return None if inside is None else 1.0 - inside.numpy()


def out_of_distribution_share(model: BallModel, tracks: Sequence[Array]) -> float | None:
    """Share of flights that lies outside of the training data of a model.

    Args: model: the ball.  tracks: (n, 9) states of each.
    Returns: from 0 to 1, the mean over tracks; None for a model without such data, or without tracks.
    """
    shares = [
        share.mean() for states in tracks if (share := out_of_distribution(model, states)) is not None and len(share)
    ]
    return float(np.mean(shares)) if shares else None
