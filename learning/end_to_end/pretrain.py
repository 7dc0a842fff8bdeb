"""A learned model's start: its networks fitted to another model's flight and bounce, without any track.

An untrained network makes the estimate ill-posed, and spin without an effect on the flight cannot be learned from
positions. So training starts from physics that is roughly right; what is wrong in it is what tracks then correct.
"""

from __future__ import annotations

from typing import Final

import torch
from torch import Tensor

from ballfg.dynamics.model import BallModel, Rates
from ballfg.dynamics.networks.learned import LearnedModel
from ballfg.state import SPIN, STATE_DIM, VELOCITY, VZ

SAMPLES: Final = 3000
SPEED: Final = 4.0
"""m/s, standard deviation of each component of the velocities that are fitted."""
SPIN_SPREAD: Final = 120.0
"""rad/s, the same of the spins."""
LEAST_FALL: Final = 0.3
"""m/s, slowest fall of a fitted bounce."""
ACCELERATION_UNIT: Final = 1.0
"""m/s^2 of error that counts as much as one of the following."""
VELOCITY_UNIT: Final = 0.1
"""m/s."""
SPIN_UNIT: Final = 10.0
"""rad/s."""


def pretrain(model: LearnedModel, teacher: BallModel, seed: int, iterations: int) -> float:
    """Fit a model to a teacher on random states; always to the same weights for the same seed.

    Args:
        model: changed in place.
        teacher: gives rates and bounces.
        seed: of the states.
        iterations: of L-BFGS.
    Returns: the root mean square of the errors that are left, in their units.
    """
    flying, bouncing = random_states(seed, SAMPLES)
    with torch.no_grad():
        rates, after = teacher.rates(flying), teacher.bounce(bouncing)
    parameters = [*model.flight.parameters(), *model.contact.parameters()]
    optimizer = torch.optim.LBFGS(parameters, max_iter=iterations, history_size=50, line_search_fn="strong_wolfe")

    def loss() -> Tensor:
        optimizer.zero_grad()
        value = difference(model, flying, bouncing, rates, after)
        value.backward()
        return value

    optimizer.step(loss)
    return float(loss().detach()) ** 0.5


def difference(model: BallModel, flying: Tensor, bouncing: Tensor, rates: Rates, after: Tensor) -> Tensor:
    """() mean squares of what a model's flight and bounce differ by from given ones, in their units, added up.

    Args:
        model: compared.
        flying: (n, 9).  rates: given for them.
        bouncing: (n, 9).  after: (n, 9), given for them.
    """
    acceleration, spin_rate = model.rates(flying)
    bounced = model.bounce(bouncing)
    value = ((acceleration - rates[0]) / ACCELERATION_UNIT).square().mean()
    value = value + ((bounced - after)[:, VELOCITY] / VELOCITY_UNIT).square().mean()
    value = value + ((bounced - after)[:, SPIN] / SPIN_UNIT).square().mean()
    if spin_rate is not None and rates[1] is not None:
        value = value + ((spin_rate - rates[1]) / SPIN_UNIT).square().mean()
    return value


def random_states(seed: int, count: int) -> tuple[Tensor, Tensor]:
    """Flying and falling balls (n, 9): velocities and spins in all directions, slow and fast."""
    generator = torch.Generator().manual_seed(seed)
    flying, falling = _states(generator, count), _states(generator, count)
    falling[:, VZ] = -LEAST_FALL - falling[:, VZ].abs()
    return flying, falling


def _states(generator: torch.Generator, count: int) -> Tensor:
    state = torch.zeros((count, STATE_DIM), dtype=torch.float64)
    state[:, VELOCITY] = SPEED * torch.randn((count, 3), generator=generator, dtype=torch.float64)
    state[:, SPIN] = SPIN_SPREAD * torch.randn((count, 3), generator=generator, dtype=torch.float64)
    return state
