"""A belief: Gaussian states at one time, with the model coefficients that were estimated along with them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from ballfg.dynamics.augmented import AugmentedModel
from ballfg.dynamics.model import BallModel
from ballfg.estimate.result import Estimate
from ballfg.state import STATE_DIM


@dataclass(frozen=True)
class Belief:
    """What is known of n balls, each at its own time.

    Attributes:
        model: the ball; an `AugmentedModel` where coefficients are uncertain.
        time: (n,) s.
        mean: (n, 9 + p) states, then coefficients.
        covariance: (n, 9 + p, 9 + p).
    """

    model: BallModel
    time: Tensor
    mean: Tensor
    covariance: Tensor

    @classmethod
    def last(cls, model: BallModel, estimates: Sequence[Estimate]) -> Belief:
        """The beliefs at the last stamps of some estimates, made with the same model and coefficients.

        Raises: ValueError: if there is no estimate, or their coefficients differ.
        """
        if not estimates:
            raise ValueError("estimates must hold at least one; got none")
        names = estimates[0].coefficient_names
        if any(e.coefficient_names != names for e in estimates):
            raise ValueError("estimates must share their coefficients; make them with the same settings")
        size = STATE_DIM + len(names)
        covariance = np.zeros((len(estimates), size, size))
        for joint, e in zip(covariance, estimates, strict=True):
            joint[:STATE_DIM, :STATE_DIM] = e.covariances[-1]
            joint[:STATE_DIM, STATE_DIM:] = e.cross_covariances[-1]
            joint[STATE_DIM:, :STATE_DIM] = e.cross_covariances[-1].T
            joint[STATE_DIM:, STATE_DIM:] = e.coefficient_covariance
        mean = np.stack([np.concatenate((e.states[-1], e.coefficients)) for e in estimates])
        return cls(
            AugmentedModel(model, names) if names else model,
            torch.tensor([float(e.times[-1]) for e in estimates], dtype=torch.float64),
            torch.from_numpy(mean),
            torch.from_numpy(covariance),
        )

    def __len__(self) -> int:
        return len(self.time)
