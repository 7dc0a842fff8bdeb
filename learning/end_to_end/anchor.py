"""How far a model has gone from the analytic model that it started from, also where no track has been.

A few dozen shots tell flight and bounce at the speeds and spins of their launchers and nothing about others, and spin
that nobody measured can trade with what it does to the flight. Counted in the loss, the distance from the start keeps
what tracks do not tell as physics has it.
"""

from __future__ import annotations

import copy
from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.model import BallModel
from ballfg.learning.end_to_end.pretrain import difference, random_states

STATES: Final = 256
"""Flights, and as many bounces, the same in every step: enough for a smooth function of six numbers."""


class Anchor:
    """The mean square difference of a model in training from another one, over random flights and bounces.

    Args:
        model: in training.
        start: as it is now.
        seed: of the states.
    """

    def __init__(self, model: BallModel, start: BallModel, seed: int) -> None:
        self.model = model
        self.flying, self.bouncing = random_states(seed, STATES)
        fixed = copy.deepcopy(start)
        with torch.no_grad():
            self.rates, self.after = fixed.rates(self.flying), fixed.bounce(self.bouncing)

    def __call__(self) -> Tensor:
        """() mean square; one means 1 m/s^2, 0.1 m/s or 10 rad/s (`ballfg.learning.end_to_end.pretrain`)."""
        return difference(self.model, self.flying, self.bouncing, self.rates, self.after)
